"""Single IMU samples that are far from both neighbours are left out, and nothing else is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from real_clip import CLIP, half_size_clip

from graphvio import FrameSet, ImuSample, Odometry, open_source
from graphvio.arrays import Float
from graphvio.evaluation import evaluate
from graphvio.measurements.events import EventKind
from graphvio.odometry import spike_filter
from graphvio.odometry.spike_filter import SpikeFilter
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

DATA = Path(__file__).parents[2] / "shared" / "data"
STEP_NS = 5_000_000


def samples_of(readings: Float, step_ns: int = STEP_NS) -> list[ImuSample]:
    return [ImuSample(k * step_ns, values[:3], values[3:]) for k, values in enumerate(readings)]


def standing(n: int) -> Float:
    noise = np.repeat([2e-3, 2e-2], 3) * np.random.default_rng(0).standard_normal((n, 6))
    return np.asarray(noise + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81]))


def filtered(samples: list[ImuSample], step_ns: int = STEP_NS) -> tuple[list[int], list[int]]:
    """Return the stamps of the samples that pass, and of those that are left out, in steps."""
    left_out: list[int] = []
    spikes = SpikeFilter(lambda stamp_ns, kind, _: left_out.append(stamp_ns) if kind is EventKind.IMU_SPIKE else None)
    passed = [each.stamp_ns for sample in samples for each in spikes.confirm(sample)]
    passed += [each.stamp_ns for each in spikes.end()]
    return [stamp // step_ns for stamp in passed], [stamp // step_ns for stamp in left_out]


@pytest.mark.parametrize("axis", range(6))
def test_single_sample_far_from_its_neighbours_is_left_out(axis: int) -> None:
    readings = standing(80)
    readings[[40, 60], axis] += [3.0, -3.0]
    passed, left_out = filtered(samples_of(readings))
    assert left_out == [40, 60]
    assert passed == [k for k in range(80) if k not in left_out]


def test_suspect_is_held_until_the_next_sample_and_passed_in_time_order() -> None:
    readings = standing(80)
    readings[50:, 3] += 5.0  # it goes on
    spikes = SpikeFilter(lambda *_: pytest.fail("no spike"))
    passed = [[each.stamp_ns // STEP_NS for each in spikes.confirm(sample)] for sample in samples_of(readings)]
    assert passed[49:53] == [[49], [], [50, 51], [52]]


def test_spike_before_a_sample_that_no_sensor_reads_is_judged_by_the_next_one() -> None:
    readings, step_ns = standing(80), STEP_NS // 2
    readings[50, 3], readings[51, 0] = 5.0, np.nan
    passed, left_out = filtered(samples_of(readings, step_ns), step_ns)
    assert left_out == [50]
    assert passed == [k for k in range(80) if k != 50]


def test_last_sample_is_passed_though_none_judges_it() -> None:
    readings = standing(80)
    readings[79, 3] = 5.0
    assert filtered(samples_of(readings)) == (list(range(80)), [])


@pytest.mark.parametrize("rate_hz", [66.0, 80.0, 99.0, 99.9, 100.0])
def test_sudden_vibration_passes(rate_hz: float) -> None:
    readings, times = standing(2000), 5e-3 * np.arange(2000)
    readings[100:, 3] += 8.0 * np.cos(2.0 * np.pi * rate_hz * times[100:])
    passed, left_out = filtered(samples_of(readings))
    assert not left_out
    assert passed == list(range(2000))


@pytest.mark.parametrize("duration_ms", [20.0, 30.0, 40.0])
def test_shocks_of_several_samples_pass(duration_ms: float) -> None:
    """The peak of a shock is far from both neighbours, which are alike."""
    readings, times = standing(3500), 5.0 * np.arange(3500)
    for k in range(35):
        phase = (times - (500.0 * k + 117.0 + 0.3 * k)) / duration_ms
        readings[:, 3] += np.where((phase > 0.0) & (phase < 1.0), 25.0 * np.sin(np.pi * phase), 0.0)
    assert not filtered(samples_of(readings))[1]


@pytest.mark.parametrize("every", [2, 3, 4])
def test_what_comes_often_is_measured(every: int) -> None:
    readings = standing(1000)
    readings[100::every, 3] += 5.0
    left_out = filtered(samples_of(readings))[1]
    assert len(left_out) < 15
    assert max(left_out, default=0) < 200


def test_shocks_of_one_sample_of_a_slow_imu_pass() -> None:
    readings, step_ns = standing(500), 20_000_000
    readings[50::50, 3] += 25.0
    assert filtered(samples_of(readings, step_ns), step_ns) == (list(range(500)), [])


def test_repeated_older_samples_judge_nothing() -> None:
    readings = standing(80)
    readings[50:, 3] += 5.0  # it goes on
    samples = samples_of(readings)
    for repeated in (45, 49, 50):  # after the step, and the step itself twice
        passed, left_out = filtered([*samples[:51], samples[repeated], *samples[51:]])
        assert not left_out
        assert [k for k in passed if k not in (45, 49)] == [k for k in range(80) if k not in (45, 49)]


def test_samples_that_no_sensor_reads_are_left_to_others() -> None:
    readings = standing(80)
    readings[[0, 45, 46], 2] = np.nan
    readings[60, 5] = np.inf
    passed, left_out = filtered(samples_of(readings))
    assert not left_out
    assert passed == list(range(80))


@pytest.mark.parametrize(
    ("later_ns", "kind"), [(0, EventKind.IMU_DUPLICATE_STAMP), (-STEP_NS // 2, EventKind.IMU_BACKWARD_STAMP)]
)
def test_sample_not_after_the_one_that_is_held_is_refused_by_its_kind(later_ns: int, kind: EventKind) -> None:
    readings = standing(80)
    readings[50:, 3] += 5.0  # sample 50 is held
    samples, kinds = samples_of(readings), list[str]()
    spikes = SpikeFilter(lambda _, kind, __: kinds.append(kind))
    for sample in samples[:51]:
        spikes.confirm(sample)
    assert spikes.confirm(replace(samples[50], stamp_ns=50 * STEP_NS + later_ns)) == []
    assert kinds == [kind]
    assert [each.stamp_ns for each in spikes.confirm(samples[51])] == [50 * STEP_NS, 51 * STEP_NS]


@pytest.mark.skipif(not DATA.exists(), reason="the real recordings are not here")
@pytest.mark.parametrize("recording", ["euroc_mh01_clip", "euroc_v101_imu"])
def test_real_flights_have_no_spikes_with_half_the_limits(recording: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_OVER_MEAN", "_OVER_NEIGHBOURS", "_MIN_RATE", "_MIN_FORCE"):
        monkeypatch.setattr(spike_filter, name, 0.5 * getattr(spike_filter, name))
    rows = np.genfromtxt(DATA / recording / "mav0" / "imu0" / "data.csv", delimiter=",", comments="#")
    passed, left_out = filtered(samples_of(rows[:, 1:7]))
    assert not left_out
    assert len(passed) == len(rows)


@pytest.mark.skipif(not CLIP.exists(), reason="the real recording is not here")
def test_odometry_with_spikes_is_as_good_as_without() -> None:
    """One sample a second is off: the path was wrong by decimetres, and vision was refused."""
    source, rng = open_source(half_size_clip()), np.random.default_rng(5)
    odometry, estimates, framesets = Odometry(source.rig), [], 0
    for measurement in open_source(half_size_clip(), to_s=10.0):
        each = measurement
        if isinstance(each, ImuSample) and rng.random() < 0.005:
            wrong_rate, wrong_force = 20.0 * rng.standard_normal(3), 100.0 * rng.standard_normal(3)
            each = ImuSample(each.stamp_ns, each.angular_velocity + wrong_rate, each.linear_acceleration + wrong_force)
        framesets += isinstance(each, FrameSet)
        estimates.append(odometry.process(each))
    poses = [
        (each.stamp_ns, each.nav_T_body)
        for each in (*estimates, *odometry.finish())
        if each is not None and each.nav_T_body is not None
    ]
    assert len(poses) == framesets
    kinds = {event.kind for event in odometry.take_events()}
    assert EventKind.IMU_SPIKE in kinds
    assert not kinds & {EventKind.VISION_GATED, EventKind.IMU_LEFT_OUT, EventKind.LOST}
    assert source.truth is not None
    estimated = Trajectory(np.array([stamp_ns for stamp_ns, _ in poses]), np.array([pose for _, pose in poses]))
    assert evaluate(estimated, load_trajectory(source.truth)).ate_position_m.rmse < 0.006
