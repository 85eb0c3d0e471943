"""Blackouts and faults of the data on a rendered walk: what is promised in them, and how it ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from graphvio import Config, Estimate, FrameSet, ImuSample, Odometry, Status, open_source
from graphvio.arrays import Float
from graphvio.backend.window import GraphWindow, WindowError
from graphvio.geometry import se3_inverse, se3_log
from graphvio.measurements.sensors import Measurement
from graphvio.rig import Rig
from graphvio.trajectory_files import load_trajectory

START_S = 3.0  # of what goes wrong
END_S = 7.0  # of most walks
PERIOD_S = 0.05
MS = 1_000_000


@pytest.fixture(scope="module")
def walk_folder(long_room_walk: Path) -> Path:
    return long_room_walk


@pytest.fixture(scope="module")
def long_measurements(walk_folder: Path) -> list[Measurement]:
    """Of ten seconds, for faults that last for several."""
    return list(open_source(walk_folder))


@pytest.fixture(scope="module")
def measurements(long_measurements: list[Measurement]) -> list[Measurement]:
    """Of the first seven seconds: a fault of up to two seconds, and as long after it."""
    return until(long_measurements, END_S)


@dataclass
class Outcome:
    """One run.

    Attributes:
        estimates: of all framesets that were given.
        given: number of framesets.
        kinds: of events.
        truth: (4, 4) by stamp.
        start_ns: of the recording.
    """

    estimates: list[Estimate]
    given: int
    kinds: list[str]
    truth: dict[int, Float]
    start_ns: int

    def at(self, time_s: float) -> Estimate:
        return min(self.estimates, key=lambda e: abs(e.stamp_ns - self.start_ns - time_s * 1e9))

    def between(self, start_s: float, end_s: float) -> list[Estimate]:
        return [e for e in self.estimates if start_s - 1e-3 <= (e.stamp_ns - self.start_ns) * 1e-9 < end_s - 1e-3]

    @property
    def completion(self) -> float:
        return sum(e.nav_T_body is not None for e in self.estimates) / self.given

    def recovery_s(self, end_s: float) -> float:
        """From the end of what went wrong until vision is used again."""
        after = [e for e in self.estimates if (e.stamp_ns - self.start_ns) * 1e-9 >= end_s - 1e-3]
        return next((e.stamp_ns - self.start_ns) * 1e-9 - end_s for e in after if e.status is Status.TRACKING)

    def largest_jump_m(self) -> float:
        """The most by which a step of one epoch is off the true one."""
        jumps = []
        for before, after in zip(self.estimates, self.estimates[1:], strict=False):
            if before.epoch == after.epoch and before.nav_T_body is not None and after.nav_T_body is not None:
                step = se3_inverse(before.nav_T_body) @ after.nav_T_body
                true = np.linalg.inv(self.truth[before.stamp_ns]) @ self.truth[after.stamp_ns]
                jumps.append(np.linalg.norm(se3_log(np.ascontiguousarray(np.linalg.inv(true) @ step))[3:]))
        return float(max(jumps))

    def error_m(self, start_s: float, end_s: float) -> float:
        """Of the motion between two times of one epoch."""
        start, end = self.at(start_s), self.at(end_s)
        assert start.nav_T_body is not None
        assert end.nav_T_body is not None
        assert start.epoch == end.epoch
        motion = se3_inverse(start.nav_T_body) @ end.nav_T_body
        true = np.linalg.inv(self.truth[start.stamp_ns]) @ self.truth[end.stamp_ns]
        return float(np.linalg.norm(se3_log(np.ascontiguousarray(np.linalg.inv(true) @ motion))[3:]))


def outcome(
    folder: Path, measurements: list[Measurement], config: Config | None = None, rig: Rig | None = None
) -> Outcome:
    source = open_source(folder)
    odometry = Odometry(source.rig if rig is None else rig, config)
    estimates = [estimate for measurement in measurements if (estimate := odometry.process(measurement)) is not None]
    estimates += odometry.finish()
    stamps = [e.stamp_ns for e in estimates]
    assert stamps == sorted(set(stamps))  # time never goes back
    assert source.truth is not None
    truth = load_trajectory(source.truth)
    poses = dict(zip(truth.stamps_ns.tolist(), truth.nav_T_body, strict=True))
    given = sum(isinstance(measurement, FrameSet) for measurement in measurements)
    return Outcome(estimates, given, [i.kind for i in odometry.take_events()], poses, source.start_ns)


def altered(
    measurements: list[Measurement],
    start_s: float,
    end_s: float,
    frameset: Callable[[FrameSet], FrameSet | None] | None = None,
    sample: Callable[[ImuSample], ImuSample | None] | None = None,
) -> list[Measurement]:
    """The measurements, those between two times as given functions make them; None leaves one out."""
    start_ns = next(e.stamp_ns for e in measurements if isinstance(e, FrameSet))
    made: list[Measurement] = []
    for measurement in measurements:
        inside = start_s - 1e-3 <= (measurement.stamp_ns - start_ns) * 1e-9 < end_s - 1e-3
        changed: Measurement | None = measurement
        if inside and isinstance(measurement, FrameSet) and frameset is not None:
            changed = frameset(measurement)
        elif inside and isinstance(measurement, ImuSample) and sample is not None:
            changed = sample(measurement)
        if changed is not None:
            made.append(changed)
    return made


def until(measurements: list[Measurement], end_s: float) -> list[Measurement]:
    """Those of the first seconds."""
    end_ns = next(e.stamp_ns for e in measurements if isinstance(e, FrameSet)) + round(end_s * 1e9)
    return [e for e in measurements if e.stamp_ns < end_ns]


@pytest.fixture(scope="module")
def early(measurements: list[Measurement]) -> list[Measurement]:
    """Of the first five seconds, for runs whose estimates are to be those of the same walk without a fault."""
    return until(measurements, 5.0)


@pytest.fixture(scope="module")
def clean(walk_folder: Path, early: list[Measurement]) -> Outcome:
    """Of these five seconds without any fault."""
    return outcome(walk_folder, early)


def blackened(frameset: FrameSet) -> FrameSet:
    black = np.zeros((240, 320), dtype=np.uint8)
    return replace(frameset, images=dict.fromkeys(frameset.images, (black, black)))


# ------------------------------------------------------------------ blackouts


@pytest.mark.parametrize(("dark_s", "most_jump_m"), [(0.3, 0.01), (1.0, 0.03), (3.0, 0.3), (5.0, 0.8)])
def test_a_blackout_is_coasted_through(
    walk_folder: Path, long_measurements: list[Measurement], dark_s: float, most_jump_m: float
) -> None:
    end_s = START_S + dark_s
    measurements = until(long_measurements, end_s + 1.5)
    done = outcome(walk_folder, altered(measurements, START_S, end_s, blackened))
    assert done.completion == 1.0
    dark = done.between(START_S, end_s)
    assert len(dark) == round(dark_s / PERIOD_S)
    assert {e.status for e in dark} == {Status.COASTING}
    sigmas = [float(np.trace(e.covariance[3:, 3:])) for e in dark if e.covariance is not None]
    assert (np.diff(sigmas) > 0.0).all()
    # No freeze: the path through the dark is that of the IMU, within its covariance. On return a keyframe of
    # before may be in view again, and puts it right at once.
    coasted, sigma = done.error_m(START_S - PERIOD_S, end_s - PERIOD_S), np.sqrt(sigmas[-1])
    assert coasted < 3.0 * sigma
    assert done.recovery_s(end_s) <= 0.15
    assert done.largest_jump_m() < min(most_jump_m, 3.0 * sigma)
    assert not {"lost", "new_epoch", "gate_reset", "window_rebuilt"} & set(done.kinds)


@pytest.mark.parametrize("frameset", [blackened, lambda _: None], ids=["dark", "cable"])
def test_an_imu_that_led_off_in_the_dark_is_corrected_and_kept(
    walk_folder: Path, long_measurements: list[Measurement], frameset: Callable[[FrameSet], FrameSet | None]
) -> None:
    """Its force is off by more than its noise explains, as of a wrong scale and axes; then images are back."""
    off, end_s = np.array([0.4, 0.2, 0.0]), START_S + 1.7

    def misled(sample: ImuSample) -> ImuSample:
        return replace(sample, linear_acceleration=sample.linear_acceleration + off)

    done = outcome(walk_folder, altered(until(long_measurements, end_s + 2.5), START_S, end_s, frameset, misled))
    assert "gate_reset" in done.kinds
    assert not {"imu_left_out", "lost", "new_epoch"} & set(done.kinds)
    assert done.recovery_s(end_s) <= 0.3
    after = done.at(end_s + 2.0)
    assert after.status is Status.TRACKING
    assert after.covariance is not None
    sigma = np.sqrt(np.trace(after.covariance[3:, 3:]))
    assert 0.1 < done.error_m(START_S - PERIOD_S, end_s + 2.0) < 3.0 * sigma
    assert done.error_m(end_s + 0.5, end_s + 2.0) < 0.02  # what follows is as good as before


def test_beyond_what_is_useful_a_new_epoch_begins(walk_folder: Path, long_measurements: list[Measurement]) -> None:
    """Lost is reported, no pose meanwhile, and the next epoch begins at the prediction with its covariance."""
    config = Config.from_yaml("smoother: {lost_position_sigma_m: 0.05}")
    done = outcome(walk_folder, altered(long_measurements, START_S, START_S + 3.0, blackened), config)
    lost = [e for e in done.estimates if e.status is Status.LOST]
    assert lost
    assert all(e.nav_T_body is None and e.covariance is None and e.velocity_nav is None for e in lost)
    before, after = done.at(lost[0].stamp_ns * 1e-9 - done.start_ns * 1e-9 - PERIOD_S), done.at(8.0)
    assert (before.epoch, after.epoch) == (0, 1)
    first = next(e for e in done.estimates if e.epoch == 1)
    assert first.status in (Status.TRACKING, Status.INITIALISING)
    assert first.covariance is not None
    assert np.sqrt(np.trace(first.covariance[3:, 3:])) > 0.05
    assert [done.kinds.count(kind) for kind in ("lost", "new_epoch")] == [1, 1]
    assert done.error_m(7.0, 9.0) < 0.03


def test_a_window_that_fails_while_lost_glues_nothing(
    walk_folder: Path, measurements: list[Measurement], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the dark and at the first images after it: lost stays lost, and what follows is another epoch."""
    config = Config.from_yaml("smoother: {lost_position_sigma_m: 0.05}")
    optimise, start_ns = GraphWindow.optimize, next(e.stamp_ns for e in measurements if isinstance(e, FrameSet))

    def fails_now_and_then(window: GraphWindow, followed: Sequence[int] = ()) -> None:
        if failing:
            failing.pop()
            raise WindowError("made to fail")
        optimise(window, followed)

    failing: list[int] = []
    monkeypatch.setattr(GraphWindow, "optimize", fails_now_and_then)
    # Else it depends on the solver which framesets optimise.
    monkeypatch.setattr(GraphWindow, "advance", lambda *_: False)
    odometry, estimates = Odometry(open_source(walk_folder).rig, config), []
    for measurement in altered(measurements, START_S, START_S + 3.0, blackened):
        if isinstance(measurement, FrameSet) and (measurement.stamp_ns - start_ns) // MS in (5500, 6000, 6050):
            failing.append(0)
        estimates.append(odometry.process(measurement))
    estimates += odometry.finish()
    found_estimates = [e for e in estimates if e is not None]
    assert [i.kind for i in odometry.take_events()].count("window_rebuilt") == 3
    lost = [k for k, e in enumerate(found_estimates) if e.status is Status.LOST]
    assert lost == list(range(lost[0], lost[-1] + 1))
    assert all(found_estimates[k].nav_T_body is None for k in lost)
    assert (found_estimates[lost[0]].stamp_ns - start_ns) // MS < 5500
    assert [e.epoch for e in found_estimates[lost[-1] + 1 :]] == [1] * (len(found_estimates) - lost[-1] - 1)
    assert found_estimates[-1].status is Status.TRACKING


# ------------------------------------------------------------------ the IMU's data


def left_out(_: ImuSample) -> None:
    return None


@pytest.mark.parametrize("gap_s", [0.2, 2.0])
def test_a_gap_of_the_imu_is_bridged_by_vision(
    walk_folder: Path, measurements: list[Measurement], gap_s: float
) -> None:
    done = outcome(walk_folder, altered(measurements, START_S, START_S + gap_s, sample=left_out))
    assert done.completion == 1.0
    assert {e.status for e in done.between(1.0, END_S)} == {Status.TRACKING}
    assert done.largest_jump_m() < 0.01
    assert done.error_m(2.0, 6.5) < 0.03
    assert "imu_not_covering" in done.kinds


def test_duplicates_and_backward_stamps_change_nothing(
    walk_folder: Path, early: list[Measurement], clean: Outcome
) -> None:
    muddled: list[Measurement] = []
    for measurement in early:
        muddled.append(measurement)
        if isinstance(measurement, ImuSample):
            muddled += [measurement, replace(measurement, stamp_ns=measurement.stamp_ns - 20 * MS)]
        else:
            muddled += [measurement, replace(measurement, stamp_ns=measurement.stamp_ns - 200 * MS)]
    done = outcome(walk_folder, muddled)
    assert len(done.estimates) == clean.given
    for one, other in zip(clean.estimates, done.estimates, strict=True):
        np.testing.assert_array_equal(one.nav_T_body, other.nav_T_body)
    assert {"imu_duplicate_stamp", "imu_backward_stamp", "frameset_duplicate_stamp", "frameset_backward_stamp"} <= set(
        done.kinds
    )


def test_nan_costs_only_its_samples(walk_folder: Path, measurements: list[Measurement]) -> None:
    numbers = iter(range(100_000))

    def spoiled(sample: ImuSample) -> ImuSample:
        bad = np.array([np.nan, 0.0, 0.0])
        return replace(sample, linear_acceleration=bad) if next(numbers) % 4 == 0 else sample

    done = outcome(walk_folder, altered(measurements, START_S, 6.0, sample=spoiled))
    assert done.completion == 1.0
    assert {e.status for e in done.between(1.0, END_S)} == {Status.TRACKING}
    assert done.error_m(2.0, 6.5) < 0.03
    assert done.kinds.count("imu_not_finite") == 150


def stuck(sample: ImuSample, axis: int) -> ImuSample:
    rate, force = sample.angular_velocity.copy(), sample.linear_acceleration.copy()
    rate[axis], force[axis] = 0.1, 0.5
    return ImuSample(sample.stamp_ns, rate, force)


def test_an_axis_that_sticks_is_left_to_vision(walk_folder: Path, measurements: list[Measurement]) -> None:
    assert_left_to_vision(walk_folder, altered(measurements, START_S, START_S + 2.0, sample=lambda s: stuck(s, 0)))


def test_an_imu_that_repeats_itself_is_left_to_vision(walk_folder: Path, measurements: list[Measurement]) -> None:
    seen: list[ImuSample] = []

    def frozen(sample: ImuSample) -> ImuSample:
        seen.append(sample)
        return replace(seen[0], stamp_ns=sample.stamp_ns)

    assert_left_to_vision(walk_folder, altered(measurements, START_S, START_S + 2.0, sample=frozen))


def assert_left_to_vision(folder: Path, measurements: list[Measurement]) -> None:
    """Of an IMU that is stuck for 400 samples: they are left out, and nothing else happens."""
    done = outcome(folder, measurements)
    assert done.completion == 1.0
    assert done.kinds.count("imu_stuck") > 380
    assert {e.status for e in done.between(1.0, END_S)} == {Status.TRACKING}
    assert done.largest_jump_m() < 0.01
    assert done.error_m(2.0, 6.5) < 0.03


def test_an_axis_that_sticks_in_the_dark_is_not_believed(walk_folder: Path, measurements: list[Measurement]) -> None:
    """Nothing but the last velocity is left to go on by, and the doubt is that of it."""
    end_s = START_S + 0.5
    done = outcome(walk_folder, altered(measurements, START_S, end_s, blackened, lambda s: stuck(s, 2)))
    assert done.completion == 1.0
    dark = done.between(START_S, end_s)
    assert {e.status for e in dark} == {Status.COASTING}
    assert dark[-1].covariance is not None
    sigma_m = float(np.sqrt(np.trace(dark[-1].covariance[3:, 3:])))
    assert done.error_m(START_S - PERIOD_S, end_s - PERIOD_S) < 3.0 * sigma_m
    assert done.recovery_s(end_s) <= 0.15
    assert done.largest_jump_m() < min(0.1, 3.0 * sigma_m)
    assert not {"gate_reset", "lost"} & set(done.kinds)


def test_a_gyro_at_the_end_of_its_range(walk_folder: Path, measurements: list[Measurement]) -> None:
    """Cut off at less than the walk's turns: vision is not refused for long, and the path stays right."""

    def cut(sample: ImuSample) -> ImuSample:
        return replace(sample, angular_velocity=np.clip(sample.angular_velocity, -0.15, 0.15))

    done = outcome(walk_folder, altered(measurements, START_S, 6.0, sample=cut))
    assert done.completion == 1.0
    assert sum(e.status is not Status.TRACKING for e in done.between(1.0, END_S)) < 10
    assert done.error_m(2.0, 6.5) < 0.03
    assert done.largest_jump_m() < 0.02


@pytest.mark.parametrize("jump_s", [7.0, 10_000.0])
def test_a_jump_of_the_clock_opens_an_epoch(walk_folder: Path, measurements: list[Measurement], jump_s: float) -> None:
    jump_ns = round(jump_s * 1e9)
    jumped = altered(
        measurements, START_S, 1e9,
        lambda frameset: replace(frameset, stamp_ns=frameset.stamp_ns + jump_ns),
        lambda sample: replace(sample, stamp_ns=sample.stamp_ns + jump_ns),
    )  # fmt: skip
    done = outcome(walk_folder, jumped)
    assert len(done.estimates) == done.given
    assert done.kinds.count("time_jump") == 1
    assert [e.epoch for e in (done.estimates[0], done.estimates[-1])] == [0, 1]
    assert done.estimates[-1].status is Status.TRACKING
    start, end = (e for e in (done.at(jump_s + 3.5), done.at(jump_s + 6.5)))
    assert start.nav_T_body is not None
    assert end.nav_T_body is not None
    motion = se3_inverse(start.nav_T_body) @ end.nav_T_body
    true = np.linalg.inv(done.truth[start.stamp_ns - jump_ns]) @ done.truth[end.stamp_ns - jump_ns]
    assert np.linalg.norm(se3_log(np.ascontiguousarray(np.linalg.inv(true) @ motion))[3:]) < 0.03


@pytest.mark.parametrize("offset_ms", [-10, 25])
def test_an_unknown_time_offset_is_found(
    walk_folder: Path, long_measurements: list[Measurement], offset_ms: int
) -> None:
    """Of an IMU that stamps late or early. The first second is at a standstill, without information."""
    shifted = [
        replace(e, stamp_ns=e.stamp_ns + offset_ms * MS) if isinstance(e, ImuSample) else e
        for e in until(long_measurements, 8.0)
    ]
    shifted.sort(key=lambda e: (e.stamp_ns, isinstance(e, FrameSet)))
    config = Config.from_yaml("fusion: {estimate_time_offset: true}")
    as_written = Config.from_yaml("calibration: {online: false}")
    ignored, found = outcome(walk_folder, until(shifted, 5.0), as_written), outcome(walk_folder, shifted, config)
    assert all(e.time_offset_s is None for e in ignored.estimates)
    found_estimates = [(e.time_offset_s, e.time_offset_sigma_s) for e in found.between(6.0, 8.0)]
    for offset_s, sigma_s in found_estimates:
        assert offset_s is not None
        assert sigma_s is not None
        assert sigma_s < 1e-3
        assert abs(offset_s - 1e-3 * offset_ms) < 4.0 * sigma_s
    assert found.kinds.count("time_offset_off") == 1
    assert found.error_m(6.0, 7.9) < 0.03
    assert "imu_left_out" in ignored.kinds  # which is what an offset comes to that nobody estimates
    assert {e.status for e in found.between(6.0, 8.0)} == {Status.TRACKING}


@pytest.mark.parametrize("offset_ms", [-10, 25])
def test_the_rigs_time_offset_is_taken_from_the_imus_stamps(
    walk_folder: Path, early: list[Measurement], clean: Outcome, offset_ms: int
) -> None:
    """The same poses come of an IMU that stamps late, where the rig says so."""
    shifted = [replace(e, stamp_ns=e.stamp_ns + offset_ms * MS) if isinstance(e, ImuSample) else e for e in early]
    rig = open_source(walk_folder).rig
    assert rig.imu is not None
    late = replace(rig, imu=replace(rig.imu, time_offset_s=1e-3 * offset_ms))
    done = outcome(walk_folder, shifted, rig=late)
    assert len(done.estimates) == clean.given
    for one, other in zip(clean.estimates, done.estimates, strict=True):
        assert one.nav_T_body is not None
        assert other.nav_T_body is not None
        np.testing.assert_allclose(one.nav_T_body, other.nav_T_body, atol=1e-9)


def test_a_time_offset_that_the_rig_has_is_confirmed(walk_folder: Path, measurements: list[Measurement]) -> None:
    done = outcome(walk_folder, measurements, Config.from_yaml("fusion: {estimate_time_offset: true}"))
    assert "time_offset_off" not in done.kinds
    last = done.estimates[-1]
    assert last.time_offset_s is not None
    assert last.time_offset_sigma_s is not None
    assert abs(last.time_offset_s) < 4.0 * last.time_offset_sigma_s < 4e-3


# ------------------------------------------------------------------ vision's data


def test_vision_that_comes_late_is_used_at_its_time(
    walk_folder: Path, early: list[Measurement], clean: Outcome
) -> None:
    """Framesets that arrive 200 ms after the IMU of their instant give the same poses as those in time."""
    late = sorted(early, key=lambda e: e.stamp_ns + (200 * MS if isinstance(e, FrameSet) else 0))
    done = outcome(walk_folder, late)
    assert len(done.estimates) == clean.given
    for one, other in zip(clean.estimates, done.estimates, strict=True):
        assert one.nav_T_body is not None
        assert other.nav_T_body is not None
        np.testing.assert_allclose(one.nav_T_body, other.nav_T_body, atol=1e-9)


def test_half_of_the_framesets_are_enough(walk_folder: Path, measurements: list[Measurement]) -> None:
    rng = np.random.default_rng(0)
    done = outcome(walk_folder, altered(measurements, 0.5, 1e9, lambda f: f if rng.random() < 0.5 else None))
    assert done.completion == 1.0
    assert {e.status for e in done.between(1.0, END_S)} == {Status.TRACKING}
    assert done.error_m(2.0, 6.5) < 0.03


# ------------------------------------------------------------------ standing still


def test_images_alone_do_not_make_a_standstill(walk_folder: Path, measurements: list[Measurement]) -> None:
    """In a lift, or before a screen that moves with it, the images do not move, but the IMU shows a motion."""
    source = open_source(walk_folder)
    start_ns, rng = source.start_ns, np.random.default_rng(0)
    still = [e for e in measurements if isinstance(e, FrameSet) and e.stamp_ns < start_ns + 900 * MS]
    for shaking, is_stationary in ((0.0, True), (1.0, False)):
        odometry = Odometry(source.rig)
        estimates = []
        for measurement in measurements:
            if measurement.stamp_ns > still[-1].stamp_ns + 10 * MS:
                break
            if isinstance(measurement, ImuSample):
                moving = shaking * rng.standard_normal(3) if measurement.stamp_ns > start_ns + 300 * MS else np.zeros(3)
                measurement = replace(measurement, linear_acceleration=measurement.linear_acceleration + moving)
            estimates.append(odometry.process(measurement))
        estimates += odometry.finish()
        last = [e for e in estimates if e is not None][-1]
        assert last.is_stationary is is_stationary
        assert ("zero_velocity" in last.innovations) is is_stationary


def test_ten_minutes_of_standing_drift_less_than_a_centimetre(
    walk_folder: Path, measurements: list[Measurement]
) -> None:
    """Images of the first second, at a standstill, in random order, one a second; a synthetic IMU."""
    source = open_source(walk_folder)
    rng, start_ns, rate_hz = np.random.default_rng(0), source.start_ns, 50
    assert source.rig.imu is not None
    imu = replace(source.rig.imu, rate_hz=float(rate_hz))
    still = [e for e in measurements if isinstance(e, FrameSet) and e.stamp_ns < start_ns + 900 * MS]
    noise = [np.sqrt(rate_hz) * density for density in (imu.gyro_noise_density, imu.accel_noise_density)]
    gyro_bias, force = np.array([3e-3, -2e-3, 1e-3]), np.array([0.03, 0.02, 9.81])
    odometry, estimates, last = Odometry(replace(source.rig, imu=imu)), [], 0
    for i in range(-rate_hz, 600 * rate_hz):
        stamp_ns = start_ns + 1000 * MS // rate_hz * i
        rate = gyro_bias + noise[0] * rng.standard_normal(3)
        found_estimates = [odometry.process(ImuSample(stamp_ns, rate, force + noise[1] * rng.standard_normal(3)))]
        if i >= 0 and i % rate_hz == 0:
            last = (last + 1 + int(rng.integers(len(still) - 1))) % len(still)  # never the same twice running
            found_estimates.append(odometry.process(replace(still[last], stamp_ns=stamp_ns)))
        estimates += [estimate for estimate in found_estimates if estimate is not None]
    odometry.finish()
    assert len(estimates) >= 599
    assert np.mean([e.is_stationary for e in estimates]) > 0.9
    positions = np.array([e.nav_T_body[:3, 3] for e in estimates if e.nav_T_body is not None])
    assert len(positions) == len(estimates)
    assert np.linalg.norm(positions, axis=1).max() < 0.01
    newest = estimates[-1]
    assert newest.gyro_bias is not None
    assert newest.gyro_bias_covariance is not None
    np.testing.assert_allclose(newest.gyro_bias, gyro_bias, atol=3e-4)
    assert not [i.kind for i in odometry.take_events() if i.kind != "vision_weak"]
