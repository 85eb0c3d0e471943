"""The odometry as a Python user calls it: what is held, what is refused, what each estimate promises."""

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from delayed_tasks import DelayedExecutor

from graphvio import (
    Config,
    Estimate,
    FrameSet,
    ImuSample,
    MeasurementError,
    Odometry,
    Prediction,
    RigError,
    Status,
    open_source,
)
from graphvio.arrays import Image
from graphvio.backend.smoother import Smoother
from graphvio.backend.window import GraphWindow, WindowError
from graphvio.evaluation import evaluate
from graphvio.geometry import so3_log
from graphvio.measurements.motion import Quality
from graphvio.measurements.sensors import GRAVITY_M_S2, Measurement
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

TRUTH = "mav0/state_groundtruth_estimate0/data.csv"


@pytest.fixture(scope="module")
def measurements(room_walk: Path) -> list[Measurement]:
    return list(open_source(room_walk, to_s=2.5))


@pytest.fixture(scope="module")
def truth(room_walk: Path) -> Trajectory:
    return load_trajectory(room_walk / TRUTH)


@pytest.fixture
def odometry(room_walk: Path) -> Iterator[Odometry]:
    made = Odometry(open_source(room_walk).rig)
    yield made
    made.finish()


def framesets(measurements: list[Measurement]) -> list[FrameSet]:
    return [measurement for measurement in measurements if isinstance(measurement, FrameSet)]


def feed(odometry: Odometry, measurements: list[Measurement]) -> list[Estimate]:
    estimates = [estimate for measurement in measurements if (estimate := odometry.process(measurement)) is not None]
    return estimates + odometry.finish()


def kinds(odometry: Odometry) -> list[str]:
    return [event.kind for event in odometry.take_events()]


def test_every_frameset_has_one_estimate_in_order(odometry: Odometry, measurements: list[Measurement]) -> None:
    estimates = feed(odometry, measurements)
    assert [e.stamp_ns for e in estimates] == [f.stamp_ns for f in framesets(measurements)]
    assert kinds(odometry) == []
    for estimate in estimates:
        assert estimate.status is Status.TRACKING
        assert estimate.nav_T_body is not None
        assert estimate.covariance is not None
        assert np.linalg.eigvalsh(estimate.covariance)[0] > 0
        assert set(estimate.pairs) == {0, 1}
    np.testing.assert_allclose(estimates[0].nav_T_body[:3, 3], 0, atol=1e-3)  # type: ignore[index]


def test_the_threads_timing_changes_nothing(room_walk: Path, measurements: list[Measurement]) -> None:
    rig, runs = open_source(room_walk).rig, []
    for seed in range(3):
        odometry = Odometry(rig)
        frontend = odometry._frontend
        if seed:
            frontend._workers.shutdown()
            frontend._n_threads, frontend._workers = 2, DelayedExecutor(len(rig.pairs), seed)
        runs.append(feed(odometry, measurements))
        assert not seed or len(frontend._workers.delays_ms) > 50  # type: ignore[attr-defined]
    for again in runs[1:]:
        for one, other in zip(runs[0], again, strict=True):
            assert one.nav_T_body is not None
            np.testing.assert_array_equal(one.nav_T_body, other.nav_T_body)
            np.testing.assert_array_equal(one.covariance, other.covariance)
            for j, report in one.pairs.items():
                np.testing.assert_array_equal(report.pixels, other.pairs[j].pixels)
                np.testing.assert_array_equal(report.is_inlier, other.pairs[j].is_inlier)


def test_smoothed_poses_cover_every_frameset_once(odometry: Odometry, measurements: list[Measurement]) -> None:
    feed(odometry, measurements)
    smoothed = sorted(stamp for stamp, _ in odometry.take_smoothed())
    assert smoothed == [f.stamp_ns for f in framesets(measurements)]
    assert odometry.take_smoothed() == []


def test_gravity_points_down_and_scale_is_metric(
    odometry: Odometry, measurements: list[Measurement], truth: Trajectory
) -> None:
    estimate = feed(odometry, measurements)[-1]
    assert estimate.nav_T_body is not None
    true, _ = truth.at(np.array([framesets(measurements)[0].stamp_ns, estimate.stamp_ns]), 0.1)
    assert estimate.gravity_nav is not None
    assert estimate.tilt_covariance is not None
    up = -estimate.nav_T_body[:3, :3].T @ estimate.gravity_nav / np.linalg.norm(estimate.gravity_nav)
    up_error = np.arccos(min(1.0, up @ true.rotations[1][2]))
    assert np.rad2deg(up_error) < 0.5
    assert up_error < 4.0 * np.sqrt(np.linalg.eigvalsh(estimate.tilt_covariance)[-1])
    walked = np.linalg.norm(true.positions[1] - true.positions[0])
    assert np.linalg.norm(estimate.nav_T_body[:3, 3]) == pytest.approx(walked, abs=0.01)


def test_a_frameset_is_held_until_its_imu_samples_have_come(
    odometry: Odometry, measurements: list[Measurement]
) -> None:
    feed_until = next(i for i, e in enumerate(measurements) if isinstance(e, FrameSet) and i > 300)
    late = [e for e in measurements[feed_until - 8 : feed_until] if isinstance(e, ImuSample)]
    for measurement in measurements[: feed_until - 8]:
        odometry.process(measurement)
    frameset = measurements[feed_until]
    assert odometry.process(frameset) is None
    results = [odometry.process(sample) for sample in late]
    assert results[:-1] == [None] * (len(late) - 1)
    assert results[-1] is not None
    assert results[-1].stamp_ns == frameset.stamp_ns


def test_framesets_are_not_held_for_ever(odometry: Odometry, measurements: list[Measurement]) -> None:
    cut = 400
    begun = [odometry.process(measurement) for measurement in measurements[:cut]]
    assert any(begun)
    remaining = framesets(measurements[cut:])
    estimates = [e for f in remaining if (e := odometry.process(f)) is not None]
    wait_ns = Config().timing.max_imu_wait_ms * 1e6
    assert len(estimates) >= len(remaining) - wait_ns // 50_000_000 - 1
    assert all(e.status is Status.TRACKING for e in estimates)
    assert "imu_not_covering" in kinds(odometry)


def test_framesets_before_the_imu_have_no_pose_and_start_nothing(
    odometry: Odometry, measurements: list[Measurement]
) -> None:
    first = framesets(measurements)[0].stamp_ns
    estimates = feed(odometry, [kept for e in measurements if (kept := _without_early_imu(e, first)) is not None])
    assert [e.stamp_ns for e in estimates] == [f.stamp_ns for f in framesets(measurements)]
    assert all(e.status is Status.INITIALISING and e.nav_T_body is None for e in estimates[:20])
    assert (estimates[0].vision, estimates[0].vision_reason) == (Quality.FAILED, "first images")
    assert all(e.vision is not Quality.FAILED for e in estimates[1:20])
    assert all(e.nav_T_body is not None and e.epoch == 0 for e in estimates[20:])
    assert kinds(odometry) == []


@pytest.mark.parametrize(("estimator", "epochs"), [("smoother", {0}), ("filter", {0, 1})])
def test_an_imu_that_comes_after_a_start_without_is_used(
    long_room_walk: Path, estimator: str, epochs: set[int]
) -> None:
    source = open_source(long_room_walk, to_s=4.0)
    config = Config.from_yaml(
        f"{{timing: {{max_imu_start_wait_s: 0.5}}, fusion: {{estimator: {estimator}}}, motion: {{reference: "
        f"{'keyframe' if estimator == 'smoother' else 'previous'}}}}}"
    )
    odometry = Odometry(source.rig, config)
    early = [kept for e in source if (kept := _without_early_imu(e, source.start_ns, 2.0)) is not None]
    estimates = feed(odometry, early)
    assert [e.nav_T_body is None for e in estimates] == [True] * 10 + [False] * (len(estimates) - 10)
    assert {e.epoch for e in estimates} == epochs
    assert [kind for kind in kinds(odometry) if "imu" in kind] == ["started_without_imu", "imu_came"]
    assert estimates[-1].gyro_bias is not None


def test_an_imu_that_comes_in_motion_shows_gravity_and_moves_no_pose(long_room_walk: Path) -> None:
    source, truth = open_source(long_room_walk, to_s=5.0), load_trajectory(long_room_walk / TRUTH)
    odometry = Odometry(source.rig, Config.from_yaml("timing: {max_imu_start_wait_s: 0.5}"))
    early = [kept for e in source if (kept := _without_early_imu(e, source.start_ns, 3.0)) is not None]
    estimates = [e for e in feed(odometry, early) if e.nav_T_body is not None]
    path = Trajectory(np.array([e.stamp_ns for e in estimates]), np.array([e.nav_T_body for e in estimates]))
    assert evaluate(path, truth).ate_position_m.rmse < 0.003
    last = estimates[-1]
    assert last.nav_T_body is not None
    assert last.gravity_nav is not None
    down = last.nav_T_body[:3, :3].T @ last.gravity_nav
    true_down = -GRAVITY_M_S2 * truth.nav_T_body[np.searchsorted(truth.stamps_ns, last.stamp_ns), 2, :3]
    np.testing.assert_allclose(down, true_down, atol=0.1)


def _without_early_imu(measurement: Measurement, first_ns: int, until_s: float = 1.0) -> Measurement | None:
    is_early = isinstance(measurement, ImuSample) and measurement.stamp_ns < first_ns + until_s * 1e9
    return None if is_early else measurement


@pytest.mark.parametrize(
    "wrong", [np.zeros((120, 160), np.uint8), np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320))]
)
def test_images_that_are_not_the_rigs_are_refused(room_walk: Path, wrong: Image) -> None:
    odometry = Odometry(open_source(room_walk).rig.without_imu())
    with pytest.raises(RigError, match="cam0: image has shape"):
        odometry.process(FrameSet(1, {0: (wrong, wrong)}))


def test_time_never_goes_back(odometry: Odometry, measurements: list[Measurement]) -> None:
    estimates = [e for measurement in measurements[:600] if (e := odometry.process(measurement)) is not None]
    old = framesets(measurements)[5]
    assert odometry.process(old) is None
    assert odometry.process(framesets(measurements[:600])[-1]) is None
    assert kinds(odometry) == ["frameset_backward_stamp", "frameset_duplicate_stamp"]
    stamps = [e.stamp_ns for e in estimates]
    assert stamps == sorted(set(stamps))


def test_unusable_samples_are_left_out_and_reported(odometry: Odometry, measurements: list[Measurement]) -> None:
    for measurement in measurements[:300]:
        odometry.process(measurement)
    last = next(e for e in reversed(measurements[:300]) if isinstance(e, ImuSample))
    nan = ImuSample(last.stamp_ns + 1_000_000, np.array([np.nan, 0, 0]), np.zeros(3))
    for bad in (last, replace(last, stamp_ns=last.stamp_ns - 7), nan):
        odometry.process(bad)
    assert kinds(odometry) == ["imu_duplicate_stamp", "imu_backward_stamp", "imu_not_finite"]


def test_a_clock_jump_breaks_no_run(odometry: Odometry, measurements: list[Measurement]) -> None:
    jump_ns = 10_000_000_000_000
    cut = len(measurements) // 2
    later = [replace(measurement, stamp_ns=measurement.stamp_ns + jump_ns) for measurement in measurements[cut:]]
    estimates = feed(odometry, measurements[:cut] + later)
    assert len(estimates) == len(framesets(measurements))
    assert estimates[-1].nav_T_body is not None
    assert estimates[-1].epoch == 1


def test_a_pair_that_drops_out_is_not_missed(
    odometry: Odometry, measurements: list[Measurement], truth: Trajectory
) -> None:
    def without_back(measurement: Measurement) -> Measurement:
        return (
            replace(measurement, images={0: measurement.images[0]})
            if isinstance(measurement, FrameSet)
            else measurement
        )

    third = len(measurements) // 3
    broken = [*measurements[:third], *map(without_back, measurements[third : 2 * third]), *measurements[2 * third :]]
    estimates = feed(odometry, broken)
    assert all(e.status is Status.TRACKING for e in estimates)
    assert estimates[-1].nav_T_body is not None
    true, _ = truth.at(np.array([estimates[0].stamp_ns, estimates[-1].stamp_ns]), 0.1)
    walked = np.linalg.norm(true.positions[1] - true.positions[0])
    assert np.linalg.norm(estimates[-1].nav_T_body[:3, 3]) == pytest.approx(walked, abs=0.015)


def test_pairs_that_are_not_triggered_together(
    odometry: Odometry, measurements: list[Measurement], truth: Trajectory
) -> None:
    """Front and back images alternate, each at its own time."""
    alternating: list[Measurement] = []
    count = 0
    for measurement in measurements:
        if isinstance(measurement, FrameSet):
            alternating.append(replace(measurement, images={count % 2: measurement.images[count % 2]}))
            count += 1
        else:
            alternating.append(measurement)
    estimates = feed(odometry, alternating)
    assert len(estimates) == count
    assert all(e.status is Status.TRACKING for e in estimates[2:])
    assert estimates[-1].nav_T_body is not None
    true, _ = truth.at(np.array([estimates[0].stamp_ns, estimates[-1].stamp_ns]), 0.1)
    walked = np.linalg.norm(true.positions[1] - true.positions[0])
    assert np.linalg.norm(estimates[-1].nav_T_body[:3, 3]) == pytest.approx(walked, abs=0.03)


def test_a_blackout_coasts_on_the_imu_with_growing_covariance(
    odometry: Odometry, measurements: list[Measurement]
) -> None:
    def darkened(measurement: Measurement) -> Measurement:
        black = np.zeros((240, 320), dtype=np.uint8)
        begin, end = framesets(measurements)[30].stamp_ns, framesets(measurements)[44].stamp_ns
        if not isinstance(measurement, FrameSet) or not begin <= measurement.stamp_ns <= end:
            return measurement
        return replace(measurement, images={0: (black, black), 1: (black, black)})

    estimates = feed(odometry, list(map(darkened, measurements)))
    assert [e.status for e in estimates[30:45]] == [Status.COASTING] * 15
    sigmas = [np.trace(e.covariance[3:, 3:]) for e in estimates[29:45] if e.covariance is not None]
    assert (np.diff(sigmas) > 0).all()
    assert estimates[-1].status is Status.TRACKING
    steps = np.diff([e.nav_T_body[:3, 3] for e in estimates if e.nav_T_body is not None], axis=0)
    assert np.linalg.norm(steps, axis=1).max() < 0.12  # walking speed: at most 6 cm a frameset, and no jump


def test_predictions_come_at_the_imus_rate(room_walk: Path, measurements: list[Measurement], truth: Trajectory) -> None:
    predictions: list[Prediction] = []
    odometry = Odometry(open_source(room_walk).rig, on_prediction=predictions.append)
    assert odometry.predict(measurements[0].stamp_ns) is None  # there is no pose yet
    estimates = feed(odometry, measurements)
    rate_hz = len(predictions) / (1e-9 * (predictions[-1].stamp_ns - predictions[0].stamp_ns))
    assert rate_hz == pytest.approx(200.0, rel=0.01)
    assert (np.diff([each.stamp_ns for each in predictions]) > 0).all()
    true, _ = truth.at(np.array([each.stamp_ns for each in predictions]), 0.1)
    assert estimates[0].nav_T_body is not None
    first, _ = truth.at(np.array([estimates[0].stamp_ns]), 0.1)
    true_T_nav_heading = first.rotations[0] @ estimates[0].nav_T_body[:3, :3].T
    placed = np.array([true_T_nav_heading @ each.nav_T_body[:3, 3] for each in predictions]) + first.positions[0]
    assert np.linalg.norm(placed - true.positions, axis=1).max() < 0.02
    newest = estimates[-1]
    again = odometry.predict(newest.stamp_ns)
    assert again is not None
    np.testing.assert_array_equal(again.nav_T_body, newest.nav_T_body)
    assert odometry.predict(newest.stamp_ns - 1) is None


def test_nothing_is_predicted_while_lost(room_walk: Path, measurements: list[Measurement]) -> None:
    without_imu = [measurement for measurement in measurements if isinstance(measurement, FrameSet)]
    black = np.zeros((240, 320), dtype=np.uint8)
    dark = [replace(each, images=dict.fromkeys(each.images, (black, black))) for each in without_imu[10:]]
    config = Config.from_yaml("smoother: {lost_position_sigma_m: 0.2}")
    odometry, status = Odometry(open_source(room_walk).rig.without_imu(), config), Status.TRACKING
    for frameset in [*without_imu[:10], *dark]:
        estimate = odometry.process(frameset)
        assert estimate is not None
        status = estimate.status
        assert (odometry.predict(estimate.stamp_ns) is None) == (status is Status.LOST)
    assert status is Status.LOST
    odometry.finish()


def test_importing_the_package_and_its_command_line_loads_nothing_heavy() -> None:
    code = "import sys, graphvio, graphvio.cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert not {"numba", "gtsam", "cv2", "rerun", "matplotlib", "numpy"} & set(loaded)


def test_numpys_integers_are_stamps_and_floats_are_not(odometry: Odometry, measurements: list[Measurement]) -> None:
    for measurement in measurements[:400]:
        for kind in (np.int64, np.uint64):
            estimate = odometry.process(replace(measurement, stamp_ns=kind(measurement.stamp_ns)))  # type: ignore[arg-type]
            assert estimate is None or type(estimate.stamp_ns) is int
    with pytest.raises(MeasurementError, match="whole nanoseconds"):
        odometry.process(replace(measurements[400], stamp_ns=measurements[400].stamp_ns * 1e-9))  # type: ignore[arg-type]


def test_malformed_measurements_are_refused(odometry: Odometry) -> None:
    with pytest.raises(MeasurementError, match="three components"):
        odometry.process(ImuSample(1, np.zeros(2), np.zeros(3)))
    with pytest.raises(MeasurementError, match=r"\(left, right\)"):
        odometry.process(FrameSet(1, {0: (np.zeros((240, 320), np.uint8),) * 3}))
    image = np.zeros((240, 320), dtype=np.uint8)
    odometry.process(FrameSet(0, {0: np.stack([image, image])}))  # type: ignore[dict-item]
    for images, message in (
        ([(image, image)], "images is a list"),
        ({0: None}, "not one or two images"),
        ({"front": (image, image)}, "'front' is no index"),
        ({0: (image, [[1, 2], [3, 4]])}, "something else than arrays"),
    ):
        with pytest.raises(MeasurementError, match=message):
            odometry.process(FrameSet(0, images))  # type: ignore[arg-type]
    with pytest.raises(MeasurementError, match="all be numbers"):
        odometry.process(ImuSample(0, "fast", np.zeros(3)))  # type: ignore[arg-type]
    with pytest.raises(MeasurementError, match="not NoneType"):
        odometry.process(None)  # type: ignore[arg-type]


def test_finishing_twice_adds_nothing_and_ends_it(odometry: Odometry, measurements: list[Measurement]) -> None:
    feed(odometry, measurements[:300])
    assert len(odometry.take_smoothed()) > 0
    assert odometry.finish() == []
    assert odometry.take_smoothed() == []
    with pytest.raises(MeasurementError, match="finished"):
        odometry.process(measurements[300])


def test_one_stamp_far_ahead_stops_nothing(odometry: Odometry, measurements: list[Measurement]) -> None:
    ahead_ns = 10_000_000_000
    spoilt: list[Measurement] = []
    for i, measurement in enumerate(measurements):
        spoilt.append(measurement)
        if i in (200, 500):
            sample = next(e for e in measurements if isinstance(e, ImuSample))
            spoilt.append(replace(sample, stamp_ns=measurement.stamp_ns + ahead_ns))
            spoilt.append(replace(framesets(measurements)[0], stamp_ns=measurement.stamp_ns + ahead_ns))
    estimates = feed(odometry, spoilt)
    assert [e.stamp_ns for e in estimates] == [f.stamp_ns for f in framesets(measurements)]
    assert all(e.status is Status.TRACKING for e in estimates)
    assert sorted(set(kinds(odometry))) == ["frameset_future_stamp", "imu_future_stamp"]


def test_a_rig_whose_imu_never_speaks_goes_on_without_it_and_without_delay(
    odometry: Odometry, measurements: list[Measurement]
) -> None:
    estimates = [odometry.process(frameset) for frameset in framesets(measurements)]
    assert [e.stamp_ns for e in estimates if e is not None] == [f.stamp_ns for f in framesets(measurements)]
    assert estimates[-1] is not None
    assert estimates[-1].status is Status.TRACKING
    assert kinds(odometry) == ["started_without_imu"]


@pytest.mark.parametrize("glitch", ["linear_acceleration", "angular_velocity"])
def test_two_wild_imu_samples_leave_an_error_that_the_covariance_admits(
    odometry: Odometry, room_walk: Path, truth: Trajectory, glitch: str
) -> None:
    measurements = list(open_source(room_walk, to_s=4.0))
    later = range(len(measurements) // 2, len(measurements))
    for at in [i for i in later if isinstance(measurements[i], ImuSample)][:2]:
        off = np.array([0.0, 50.0 if glitch == "linear_acceleration" else 4.0, 0.0])
        measurements[at] = replace(measurements[at], **{glitch: getattr(measurements[at], glitch) + off})
    estimates = feed(odometry, measurements)
    assert "gate_reset" in kinds(odometry)
    first, last = estimates[0], estimates[-1]
    assert last.status is Status.TRACKING
    assert first.nav_T_body is not None
    assert last.nav_T_body is not None
    assert last.covariance is not None
    true, _ = truth.at(np.array([first.stamp_ns, last.stamp_ns]), 0.1)
    true_turn = true.nav_T_body[0, :3, :3].T @ true.nav_T_body[1, :3, :3]
    off_rad = np.linalg.norm(so3_log(true_turn.T @ first.nav_T_body[:3, :3].T @ last.nav_T_body[:3, :3]))
    assert off_rad < 3.0 * np.sqrt(np.linalg.eigvalsh(last.covariance[:3, :3])[-1])
    walked = np.linalg.norm(true.positions[1] - true.positions[0])
    error = abs(np.linalg.norm(last.nav_T_body[:3, 3] - first.nav_T_body[:3, 3]) - walked)
    assert error < 0.05
    assert error < 3.0 * np.sqrt(np.linalg.eigvalsh(last.covariance[3:, 3:])[-1])


@pytest.mark.parametrize(
    ("owner", "method", "kind"),
    [
        (GraphWindow, "optimize", WindowError),
        (GraphWindow, "optimize", RuntimeError),
        (GraphWindow, "optimize", np.linalg.LinAlgError),
        (GraphWindow, "advance", WindowError),
        (GraphWindow, "joint_covariance", RuntimeError),
        (GraphWindow, "marginalise", np.linalg.LinAlgError),
        (GraphWindow, "add", RuntimeError),
        (Smoother, "extend", RuntimeError),
        (Smoother, "gate", np.linalg.LinAlgError),
        (Smoother, "state_covariance", RuntimeError),
    ],
)
def test_a_window_that_fails_is_rebuilt(
    odometry: Odometry,
    measurements: list[Measurement],
    monkeypatch: pytest.MonkeyPatch,
    owner: type,
    method: str,
    kind: type[Exception],
) -> None:
    def fail(*_: object) -> None:
        patch.undo()  # fails once, or the window could not be rebuilt either
        raise kind("made to fail")

    half = len(measurements) - 150
    estimates = [e for measurement in measurements[:half] if (e := odometry.process(measurement)) is not None]
    before = len(estimates)
    with monkeypatch.context() as patch:
        patch.setattr(owner, method, fail)
        while "window_rebuilt" not in kinds(odometry):
            assert len(estimates) - before < 3, "every one of these is called for each third frameset"
            estimates += [
                e for measurement in measurements[half : half + 1] if (e := odometry.process(measurement)) is not None
            ]
            half += 1
    rebuilt, known = estimates[-1], estimates[-2]
    assert rebuilt.covariance is not None
    assert known.covariance is not None
    assert rebuilt.covariance.trace() > known.covariance.trace()
    assert rebuilt.velocity_covariance is not None
    estimates += [e for measurement in measurements[half:] if (e := odometry.process(measurement)) is not None]
    assert [e.stamp_ns for e in estimates] == [f.stamp_ns for f in framesets(measurements)]
    assert estimates[-1].status is Status.TRACKING
    steps = np.diff([e.nav_T_body[:3, 3] for e in estimates if e.nav_T_body is not None], axis=0)
    assert np.linalg.norm(steps, axis=1).max() < 0.12


def test_an_imus_matrices_are_applied_to_its_samples(room_walk: Path, measurements: list[Measurement]) -> None:
    rig, gyro, accel = open_source(room_walk).rig, np.diag([1.01, 0.98, 1.02]), np.eye(3) + 0.01 * np.eye(3, k=1)
    assert rig.imu is not None
    imu = replace(rig.imu, gyro_matrix=tuple(gyro.ravel().tolist()), accel_matrix=tuple(accel.ravel().tolist()))
    skewed = [
        each
        if isinstance(each, FrameSet)
        else replace(
            each,
            angular_velocity=np.asarray(np.linalg.inv(gyro) @ each.angular_velocity),
            linear_acceleration=np.asarray(np.linalg.inv(accel) @ each.linear_acceleration),
        )
        for each in measurements[:250]
    ]
    expected = feed(Odometry(rig), measurements[:250])
    found = feed(Odometry(replace(rig, imu=imu)), skewed)
    assert any(estimate.nav_T_body is not None for estimate in expected)
    for one, other in zip(found, expected, strict=True):
        if other.nav_T_body is not None:
            assert one.nav_T_body == pytest.approx(other.nav_T_body, abs=1e-6)
