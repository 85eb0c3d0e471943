"""Keyframes and corrections of an odometry that runs in a simulated room."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import chi2
from synthetic import random_covariance, transform, two_pair_rig

from graphvio import Config, ConfigError, Estimate, FrameSet, Odometry, Prediction, Status, open_source
from graphvio.arrays import AnyArray, Float, Image
from graphvio.backend.smoother import Smoother
from graphvio.backend.window import WindowError
from graphvio.frontend.depth.stereo import triangulate
from graphvio.frontend.depth.tracks import TrackedFrame, common_rows
from graphvio.geometry import se3, se3_inverse, se3_log
from graphvio.measurements.sensors import Measurement
from graphvio.odometry.step import NewKeyframe, Step
from graphvio.rig import Rig
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.simulation.simulator import make_simulator
from graphvio.slam import FrontEnd
from graphvio.slam.keyframe import Keyframe
from graphvio.slam.landmarks import describer, landmarks_of
from graphvio.slam.map_frame import MapFrame
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

SOON_S = 30.0  # until then a thread is waited for; only a test that fails takes so long
TIGHT = np.diag(np.repeat([1e-3, 1e-2], 3) ** 2)


@dataclass
class Run:
    """Results of a run."""

    odometry: Odometry
    estimates: list[Estimate]
    keyframes: list[Keyframe]
    steps: list[Step]


@pytest.fixture(scope="module")
def measurements(vga_walk: Path) -> list[Measurement]:
    return list(open_source(vga_walk))


@pytest.fixture(scope="module")
def rig(vga_walk: Path) -> Rig:
    return open_source(vga_walk).rig


@pytest.fixture(scope="module")
def truth(vga_walk: Path) -> Trajectory:
    return load_trajectory(vga_walk / "mav0/state_groundtruth_estimate0/data.csv")


@pytest.fixture(scope="module")
def run(rig: Rig, measurements: list[Measurement]) -> Run:
    """The whole recording, with images."""
    return run_of(rig, measurements, "keyframes: {images: true}")


def run_of(rig: Rig, measurements: Sequence[Measurement], config: str = "{}") -> Run:
    steps, keyframes = list[Step](), list[Keyframe]()
    odometry = Odometry(rig, Config.from_yaml(config))
    odometry.subscribe(steps.append)
    FrontEnd(odometry).on_keyframe(keyframes.append)
    return Run(odometry, feed(odometry, measurements), keyframes, steps)


def feed(odometry: Odometry, measurements: Sequence[Measurement]) -> list[Estimate]:
    estimates = [estimate for measurement in measurements if (estimate := odometry.process(measurement)) is not None]
    return estimates + odometry.finish()


def world_T_body(truth: Trajectory, stamp_ns: int) -> Float:
    at, _ = truth.at(np.array([stamp_ns]), 0.1)
    return se3(at.rotations[0].copy(), at.positions[0].copy())


def squared_error(measured: Float, true: Float, covariance: Float) -> float:
    error = se3_log(se3_inverse(true) @ measured)
    return float(error @ np.linalg.solve(covariance, error))


def until(measurements: list[Measurement], framesets: int) -> list[Measurement]:
    """Measurements up to a number of framesets."""
    ends = [i for i, measurement in enumerate(measurements) if isinstance(measurement, FrameSet)]
    return measurements[: ends[framesets - 1] + 1]


# ------------------------------------------------------------------ when they come, and their poses


def test_each_reference_is_a_keyframe_with_the_next_id(run: Run) -> None:
    references = [step.estimate for step in run.steps if step.estimate.stamp_ns in step.references]
    assert [k.stamp_ns for k in run.keyframes] == [e.stamp_ns for e in references]
    assert len(run.keyframes) >= 8
    assert [k.id for k in run.keyframes] == list(range(len(run.keyframes)))
    assert [k.previous_id for k in run.keyframes] == [None, *range(len(run.keyframes) - 1)]
    for keyframe, estimate in zip(run.keyframes, references, strict=True):
        assert (keyframe.epoch, keyframe.status) == (0, Status.TRACKING)
        np.testing.assert_array_equal(keyframe.odom_T_body, estimate.nav_T_body)
        np.testing.assert_array_equal(keyframe.covariance, estimate.covariance)
        assert set(np.unique(keyframe.landmarks.pair)) == {0, 1}


def test_landmarks_are_those_of_the_calibration_in_force(run: Run, rig: Rig, measurements: list[Measurement]) -> None:
    error = CalibrationErrorSizes.of_level(3, ["left-right-rotation", "principal-point", "pair-transform"])
    wrong = draw(rig, error, seed=1).written_rig
    newest = run_of(wrong, until(measurements, 80)).keyframes[-1]
    assert run.keyframes[-1].calibrated_rig is None  # the file is exact
    assert newest.calibrated_rig is not None
    in_force = newest.calibrated_rig

    def error_px(used: Rig) -> float:
        """How far landmarks are from where the right cameras see them."""
        errors = []
        for j, pair in enumerate(used.pairs):
            of_pair, right_T_body = newest.landmarks.pair == j, pair.right.cam_T_body
            pixels, _ = pair.right.project(
                newest.landmarks.points_body[of_pair] @ right_T_body[:3, :3].T + right_T_body[:3, 3]
            )
            errors.append(np.median(np.abs(pixels - newest.landmarks.right_px[of_pair])))
        return float(max(errors))

    assert error_px(in_force) < 0.2 < error_px(wrong)


@pytest.mark.parametrize("kind", ["imu", "vision", "filter", "in_turns"])
def test_motions_between_keyframes_are_within_their_covariance(
    kind: str, run: Run, rig: Rig, measurements: list[Measurement], truth: Trajectory
) -> None:
    if kind == "vision":
        run = run_of(rig.without_imu(), [e for e in measurements if isinstance(e, FrameSet)])
        assert run.keyframes[0].stamp_ns == run.estimates[0].stamp_ns  # though it is initialising
    elif kind == "filter":
        config = "{motion: {reference: previous}, fusion: {estimator: filter}}"
        run = run_of(rig, until(measurements, 60), config)
        assert len(run.keyframes) == len(run.estimates)
    elif kind == "in_turns":
        run = run_of(rig, in_turns(measurements))
        assert {len(np.unique(k.landmarks.pair)) for k in run.keyframes} == {1}
    squares = []
    for before, now in zip(run.keyframes[:-1], run.keyframes[1:], strict=True):
        assert now.previous_T_body is not None
        assert now.relative_covariance is not None
        assert np.linalg.eigvalsh(now.relative_covariance)[0] > 0.0
        true = se3_inverse(world_T_body(truth, before.stamp_ns)) @ world_T_body(truth, now.stamp_ns)
        squares.append(squared_error(now.previous_T_body, true, now.relative_covariance))
    # 6 where errors are consistent; the room's are smaller, since noise is sharper than `pixel_sigma_px`.
    assert 0.05 < np.mean(squares) < 10.0
    assert max(squares) < 30.0


def in_turns(measurements: list[Measurement]) -> list[Measurement]:
    """Return measurements whose framesets have front and back images in turn."""
    made, count = list[Measurement](), 0
    for measurement in measurements:
        if isinstance(measurement, FrameSet):
            measurement, count = replace(measurement, images={count % 2: measurement.images[count % 2]}), count + 1
        made.append(measurement)
    return made


def test_drift_of_the_map_frame_covers_that_of_the_odometry(run: Run, truth: Trajectory) -> None:
    """After one exact correction, the odometry's errors are consistent with the expected drift."""
    exact, squares = 1e-12 * np.eye(6), list[float]()
    first = run.keyframes[0]
    for keyframe in run.keyframes[1:]:
        frame = MapFrame(0.999)
        for each in run.keyframes:
            frame.add(each)
        frame.correct(first.id, world_T_body(truth, first.stamp_ns), exact)
        result = frame.correct(keyframe.id, world_T_body(truth, keyframe.stamp_ns), exact)
        assert result.accepted, result.reason
        assert result.statistic is not None
        squares.append(result.statistic)
    assert 0.05 < np.mean(squares) < 10.0


def test_keyframe_without_a_motion_has_the_covariance_of_its_pose(rig: Rig) -> None:
    front_end = FrontEnd(Odometry(rig))
    made: list[Keyframe] = []
    front_end.on_keyframe(made.append)
    spread, known = random_covariance(np.random.default_rng(0), 6, 0.1), np.eye(6)
    poses = [transform([0, 0, 0.1 * k], [float(k), 0, 0]) for k in range(6)]
    statuses = [Status.TRACKING] * 4 + [Status.LOST, Status.TRACKING]
    for k, (pose, status) in enumerate(zip(poses, statuses, strict=True)):
        is_lost = status is Status.LOST
        estimate = Estimate(k, status, None if is_lost else pose, None if is_lost else spread, epoch=int(k == 5))
        motion = (poses[1], known) if k in (1, 3, 5) else (None, None)
        keyframe = NewKeyframe({}, {}, np.stack([np.eye(4)] * 2), k - 1 if k else None, *motion)
        front_end._on_step(Step(estimate, None, False, None, False, frozenset({k}), {}, keyframe))
    assert [(k.id, k.epoch, k.previous_id) for k in made] == [
        (0, 0, None),
        (1, 0, 0),
        (2, 0, 1),
        (3, 0, 2),
        (4, 1, None),
    ]
    assert [None if k.relative_covariance is None else k.relative_covariance is spread for k in made] == [
        None, False, True, False, None,
    ]  # fmt: skip
    assert made[2].previous_T_body is not None
    np.testing.assert_allclose(poses[1] @ made[2].previous_T_body, poses[2], atol=1e-12)
    assert all(len(k.landmarks) == 0 for k in made)


def test_rebuilt_window_begins_with_a_keyframe(
    rig: Rig, measurements: list[Measurement], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Later motions are measured from it, as steps report."""

    def fail(*_: object) -> None:
        patch.undo()
        raise WindowError("made to fail")

    steps, keyframes = list[Step](), list[Keyframe]()
    odometry = Odometry(rig)
    odometry.subscribe(steps.append)
    FrontEnd(odometry).on_keyframe(keyframes.append)
    begun = until(measurements, 30)
    for measurement in begun:
        odometry.process(measurement)
    count = len(steps)
    with monkeypatch.context() as patch:
        patch.setattr(Smoother, "update", fail)
        for measurement in measurements[len(begun) : len(until(measurements, 35))]:
            odometry.process(measurement)
    odometry.finish()
    assert "window_rebuilt" in {i.kind for i in odometry.take_events()}
    rebuilt = steps[count].estimate
    assert steps[count].references == {rebuilt.stamp_ns}
    assert [k.stamp_ns for k in keyframes] == [steps[0].estimate.stamp_ns, rebuilt.stamp_ns]
    np.testing.assert_array_equal(keyframes[1].relative_covariance, rebuilt.covariance)


def test_no_keyframe_while_initialising_in_motion(rig: Rig, measurements: list[Measurement]) -> None:
    began = next(e.stamp_ns for e in measurements if isinstance(e, FrameSet)) + 2_000_000_000
    run = run_of(rig, [e for e in measurements if e.stamp_ns > began])
    statuses = [e.status for e in run.estimates]
    assert statuses[0] is Status.INITIALISING
    assert statuses[-1] is Status.TRACKING
    known_ns = run.estimates[statuses.index(Status.TRACKING)].stamp_ns
    assert run.keyframes
    assert run.keyframes[0].stamp_ns >= known_ns
    assert (run.keyframes[0].id, run.keyframes[0].previous_id) == (0, None)


def test_new_epoch_begins_a_chain_and_resets_the_map(rig: Rig, measurements: list[Measurement]) -> None:
    begun, remaining = until(measurements, 50), measurements[len(until(measurements, 50)) :]
    odometry, keyframes, before = Odometry(rig), list[Keyframe](), list[Estimate]()
    front_end = FrontEnd(odometry)
    front_end.on_keyframe(keyframes.append)
    for measurement in begun:
        estimate = odometry.process(measurement)
        before += [] if estimate is None else [estimate]
    old = keyframes[-1].id
    assert front_end.map_T_body(before[-1].stamp_ns) is None
    assert front_end.correct(old, transform([0, 0, 1.0], [5.0, 0, 0]), TIGHT).accepted
    assert front_end.map_T_body(before[-1].stamp_ns) is not None
    estimates = []
    for measurement in until(remaining, 15):
        estimate = odometry.process(replace(measurement, stamp_ns=measurement.stamp_ns + 10**13))
        if estimate is not None:
            estimates.append(estimate)
            assert front_end.map_T_body(estimate.stamp_ns) is None or estimate.epoch == 0
    assert estimates[-1].epoch == 1
    first = next(k for k in keyframes if k.epoch == 1)
    assert (first.previous_id, first.previous_T_body, first.relative_covariance) == (None, None, None)
    assert [k.id for k in keyframes] == list(range(len(keyframes)))
    odometry.take_events()
    result = front_end.correct(old, np.eye(4), TIGHT)
    assert (result.accepted, result.map_T_odom) == (False, None)
    event = odometry.take_events()[-1]
    assert (event.kind, event.stamp_ns) == ("correction_refused", estimates[-1].stamp_ns)
    assert "not of the newest epoch" in event.detail
    assert front_end.correct(keyframes[-1].id, np.eye(4), TIGHT).accepted
    assert front_end.map_T_body(estimates[-1].stamp_ns) is not None
    odometry.finish()


def test_lost_state_has_no_keyframe(rig: Rig, measurements: list[Measurement]) -> None:
    black = np.zeros((480, 640), dtype=np.uint8)
    framesets = [e for e in measurements if isinstance(e, FrameSet)][30:70]
    for k in range(10, 30):
        framesets[k] = replace(framesets[k], images=dict.fromkeys((0, 1), (black, black)))
    run = run_of(rig.without_imu(), framesets, "smoother: {lost_position_sigma_m: 0.2}")
    lost = {e.stamp_ns for e in run.estimates if e.status is Status.LOST}
    assert lost
    assert not lost & {k.stamp_ns for k in run.keyframes}
    assert {k.epoch for k in run.keyframes} == {0, 1}
    assert next(k for k in run.keyframes if k.epoch == 1).previous_id is None


# ------------------------------------------------------------------ what is seen there


def test_landmarks_are_at_their_true_positions(run: Run, rig: Rig) -> None:
    simulator = make_simulator("room", duration_s=5.0, seed=3)
    stamps, errors = simulator.stamps_ns.tolist(), list[Float]()
    for keyframe in (run.keyframes[0], run.keyframes[-1]):
        index = stamps.index(keyframe.stamp_ns)
        surfaces = simulator.surfaces(index)
        for j, pair in enumerate(rig.pairs):
            depth = simulator.view(index, 2 * j, surfaces).depth
            marks, of = keyframe.landmarks, keyframe.landmarks.pair == j
            left_T_body = se3_inverse(pair.left.body_T_cam)
            points = marks.points_body[of] @ left_T_body[:3, :3].T + left_T_body[:3, 3]
            variances = np.einsum("i,nij,j->n", left_T_body[2, :3], marks.covariances[of], left_T_body[2, :3])
            x, y = np.rint(marks.left_px[of]).astype(int).T
            around = np.stack(
                [depth[np.clip(y + v, 0, 479), np.clip(x + u, 0, 639)] for u in (-9, 0, 9) for v in (-9, 0, 9)]
            )
            is_smooth = np.ptp(around, axis=0) < 0.1 * around[4]  # no edge of a thing, which has no one depth
            errors.append(((points[:, 2] - depth[y, x]) / np.sqrt(variances))[is_smooth])
            pixels, _ = pair.left.project(points)
            assert np.linalg.norm(pixels - marks.left_px[of], axis=1).max() < 1.0
    squares = np.concatenate(errors) ** 2
    assert len(squares) > 400
    assert np.mean(squares < chi2.ppf(0.99, 1)) > 0.95
    assert np.median(squares) < 1.0


def test_covariances_of_landmarks_are_consistent() -> None:
    """Random points, seen with noise by both cameras of a pair, and triangulated."""
    rng, sigma_px, count, squares = np.random.default_rng(1), 0.3, 2000, list[Float]()
    rig = two_pair_rig()
    for j, pair in enumerate(rig.pairs):
        rays = np.column_stack([rng.uniform(-0.6, 0.6, count), rng.uniform(-0.4, 0.4, count), np.ones(count)])
        points = rays * rng.uniform(1.0, 6.0, (count, 1))
        seen, focal = [], [pair.left.focal_px, pair.right.focal_px]
        for side_T_left, f in zip((np.eye(4), pair.right_T_left), focal, strict=True):
            moved = points @ side_T_left[:3, :3].T + side_T_left[:3, 3]
            seen.append(moved[:, :2] / moved[:, 2:] + sigma_px / f * rng.standard_normal((count, 2)))
        held, covariances, _ = triangulate(seen[0], seen[1], pair.right_T_left, float(focal[0]), float(focal[1]))
        whole = np.arange(count)
        frame = TrackedFrame(
            0, whole, whole, seen[0], seen[0], seen[1], seen[1], held, covariances, np.zeros((count, 2)),
            np.ones(count, dtype=bool), whole,
        )  # fmt: skip
        black = np.zeros((480, 640), dtype=np.uint8)
        body_T_left = np.stack([each.left.body_T_cam for each in rig.pairs])
        keyframe = NewKeyframe({j: frame}, {j: (black, black)}, body_T_left, None, None, None)
        marks = landmarks_of(rig, keyframe, sigma_px, None)
        assert (marks.pair == j).all()
        true = points @ pair.left.body_T_cam[:3, :3].T + pair.left.body_T_cam[:3, 3]
        errors = marks.points_body - true[marks.track_id]
        squares.append(np.einsum("ni,nij,nj->n", errors, np.linalg.inv(marks.covariances), errors))
        assert len(marks) == count
    assert np.mean(np.concatenate(squares)) == pytest.approx(3.0, rel=0.05)


def test_uncertain_depth_makes_no_landmark(run: Run) -> None:
    for keyframe in run.keyframes:
        spread = np.sqrt(np.linalg.eigvalsh(keyframe.landmarks.covariances)[:, -1])
        assert (spread < 0.4 * np.linalg.norm(keyframe.landmarks.points_body, axis=1)).all()


def test_landmarks_project_to_their_pixels_in_the_right_images(run: Run, rig: Rig) -> None:
    for keyframe in run.keyframes:
        marks = keyframe.landmarks
        assert len(marks) > 100
        assert len(marks.points_body) == len(marks.right_px) == len(marks.descriptors) == len(marks)
        for j, pair in enumerate(rig.pairs):
            of = marks.pair == j
            assert (np.diff(marks.track_id[of]) > 0).all()
            right_T_body = se3_inverse(pair.right.body_T_cam)
            pixels, inside = pair.right.project(marks.points_body[of] @ right_T_body[:3, :3].T + right_T_body[:3, 3])
            assert inside.mean() > 0.99
            distances = np.linalg.norm(pixels - marks.right_px[of], axis=1)
            assert distances.max() < 1.0  # `max_epipolar_px`
            assert np.median(distances) < 0.2


@pytest.mark.parametrize("kind", ["orb", "sift"])
def test_descriptors_match_their_track_in_the_next_keyframe(kind: str, run: Run) -> None:
    describe, found, total = describer(kind), 0, 0  # type: ignore[arg-type]
    assert describe is not None
    for before, now in zip(run.keyframes[:-1], run.keyframes[1:], strict=True):
        for j in (0, 1):
            first, second = (
                (k.landmarks.track_id[k.landmarks.pair == j], k.landmarks.descriptors[k.landmarks.pair == j])
                if kind == "orb"
                else (k.landmarks.track_id[k.landmarks.pair == j],
                      describe(k.images[j][0], k.landmarks.left_px[k.landmarks.pair == j]))
                for k in (before, now)
            )  # fmt: skip
            at_first, at_second = common_rows(first[0], second[0])
            apart = distances(first[1][at_first], second[1], kind)
            found += int(np.sum(apart.argmin(axis=1) == at_second))
            total += len(at_first)
    assert total > 1000
    assert found > 0.65 * total  # of more than 200 that it might be taken for, up to 2.5 s later


@pytest.mark.parametrize(("kind", "width"), [("orb", 32), ("sift", 128)])
def test_descriptors_are_invariant_to_rotation(kind: str, width: int, run: Run) -> None:
    describe = describer(kind)  # type: ignore[arg-type]
    assert describe is not None
    keyframe = run.keyframes[-1]
    image, pixels = keyframe.images[0][0], keyframe.landmarks.left_px[keyframe.landmarks.pair == 0]
    height, length = image.shape
    centre = np.array([0.5 * (length - 1), 0.5 * (height - 1)])
    pixels = pixels[np.linalg.norm(pixels - centre, axis=1) < 0.5 * height - 40]
    upright = describe(image, pixels)
    assert upright.shape == (len(pixels), width)
    assert upright.dtype == np.uint8
    for angle_deg in (25.0, 90.0, 170.0):
        turn = cv2.getRotationMatrix2D((float(centre[0]), float(centre[1])), angle_deg, 1.0)
        turned = describe(cv2.warpAffine(image, turn, (length, height)), pixels @ turn[:, :2].T + turn[:, 2])  # type: ignore[arg-type]
        right = distances(turned, upright, kind).argmin(axis=1) == np.arange(len(pixels))
        assert len(pixels) > 50
        assert right.mean() > 0.8


def distances(one: AnyArray, other: AnyArray, kind: str) -> Float:
    """Return the distances (N, M) of descriptors (N, D) from others (M, D)."""
    if kind == "orb":
        return np.asarray(
            np.unpackbits(np.bitwise_xor(one[:, None], other[None]), axis=2).sum(axis=2), dtype=np.float64
        )
    return np.asarray(np.linalg.norm(one[:, None].astype(np.float64) - other[None], axis=2))


def test_corners_at_the_edge_have_descriptors() -> None:
    image: Image = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
    corners = np.array([[0.0, 0.0], [79.0, 0.0], [0.0, 59.0], [79.0, 59.0]])
    for kind in ("orb", "sift"):
        describe = describer(kind)
        assert describe is not None
        assert describe(image, corners).any(axis=1).all()
        assert describe(image, corners[:0]).shape[0] == 0
    assert describer("none") is None


def test_keyframes_have_images_on_request_only(run: Run, rig: Rig, measurements: list[Measurement]) -> None:
    of = {e.stamp_ns: e.images for e in measurements if isinstance(e, FrameSet)}
    for keyframe in run.keyframes:
        assert set(keyframe.images) == {0, 1}
        for j, images in keyframe.images.items():
            for copied, image in zip(images, of[keyframe.stamp_ns][j], strict=True):
                np.testing.assert_array_equal(copied, image)
                assert not np.shares_memory(copied, image)
    plain = run_of(rig, until(measurements, 20), "keyframes: {descriptors: none}").keyframes
    assert plain
    assert not plain[0].images
    assert plain[0].landmarks.descriptors.shape == (len(plain[0].landmarks), 0)


# ------------------------------------------------------------------ threads, and what does not change


def test_subscribers_and_corrections_do_not_change_estimates(rig: Rig, measurements: list[Measurement]) -> None:
    """With other threads that read, correct and predict at the same time."""
    measurements = until(measurements, 60)
    config = "motion: {keyframe_overlap: 0.9}\n"  # has many keyframes
    alone = Odometry(rig, Config.from_yaml(config))
    expected = feed(alone, measurements)

    odometry = Odometry(rig, Config.from_yaml(config + "keyframes: {descriptors: sift, images: true}"))
    called, read, positions = list[Keyframe](), list[Keyframe](), list[Float]()
    front_end = FrontEnd(odometry)
    front_end.on_keyframe(called.append)
    is_over, failures, moved = threading.Event(), list[BaseException](), list[bool]()

    def correct_all() -> None:
        """Correct all keyframes at once and again later, neighbours by ten metres apart."""
        for keyframe in front_end.keyframes():
            read.append(keyframe)
            for k in range(keyframe.id + 1):
                candidate = transform([0, 0, 0], [10.0 * (keyframe.id % 2), 0, 0]) @ read[k].odom_T_body
                moved.append(front_end.correct(k, candidate, TIGHT).accepted)

    def ask() -> None:
        while not is_over.is_set():
            at_ns = newest[0]
            found = front_end.map_T_body(at_ns)
            if found is not None:
                positions.append(found[:3, 3])

    def guarded(work: Callable[[], None]) -> threading.Thread:
        def run() -> None:
            try:
                work()
            except BaseException as error:
                failures.append(error)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        return thread

    newest, estimates = [0], list[Estimate]()
    threads = [guarded(correct_all), guarded(ask)]
    for measurement in measurements:
        estimate = odometry.process(measurement)
        if estimate is not None:
            estimates.append(estimate)
            newest[0] = estimate.stamp_ns
    estimates += odometry.finish()
    is_over.set()
    for thread in threads:
        thread.join(SOON_S)
        assert not thread.is_alive()
    assert not failures
    assert [k.id for k in read] == [k.id for k in called] == list(range(len(called)))
    assert moved.count(True) > 3
    assert moved.count(False) > 3
    assert {i.kind for i in odometry.take_events()} >= {"correction_refused"}
    assert len(estimates) == len(expected)
    for one, other in zip(estimates, expected, strict=True):
        np.testing.assert_array_equal(one.nav_T_body, other.nav_T_body)
        np.testing.assert_array_equal(one.covariance, other.covariance)
    for (ns, pose), (other_ns, other_pose) in zip(odometry.take_smoothed(), alone.take_smoothed(), strict=True):
        assert ns == other_ns
        np.testing.assert_array_equal(pose, other_pose)


def test_correction_moves_map_and_not_odom(rig: Rig, measurements: list[Measurement]) -> None:
    predictions = list[Prediction]()
    config = Config.from_yaml("motion: {keyframe_overlap: 0.9}")
    odometry = Odometry(rig, config, on_prediction=predictions.append)
    keyframes, in_map = list[Keyframe](), list[Float]()
    front_end = FrontEnd(odometry)
    front_end.on_keyframe(keyframes.append)
    for measurement in until(measurements, 70):
        count = len(keyframes)
        estimate = odometry.process(measurement)
        if len(keyframes) > count:
            newest = keyframes[-1]
            side = transform([0, 0, 0], [8.0 if newest.stamp_ns - keyframes[0].stamp_ns > 1.5e9 else 0.0, 0, 0])
            front_end.correct(newest.id, side @ newest.odom_T_body, TIGHT)
        if estimate is not None:
            found, prediction = front_end.map_T_body(estimate.stamp_ns), odometry.predict(estimate.stamp_ns)
            assert found is not None
            assert prediction is not None
            assert front_end.map_T_odom is not None
            np.testing.assert_array_equal(found, front_end.map_T_odom @ prediction.nav_T_body)
            in_map.append(found[:3, 3])
    odometry.finish()
    assert "map_moved" in {i.kind for i in odometry.take_events()}
    assert np.linalg.norm(np.diff(in_map, axis=0), axis=1).max() > 7.0
    steps = np.diff([p.nav_T_body[:3, 3] for p in predictions], axis=0)
    assert np.linalg.norm(steps, axis=1).max() < 0.02  # 1 cm a sample at twice the walking speed, and small corrections


def test_late_iterator_gets_the_kept_keyframes_and_ends(rig: Rig, measurements: list[Measurement]) -> None:
    odometry, keyframes = Odometry(rig), list[Keyframe]()
    front_end = FrontEnd(odometry)
    measurements = until(measurements, 90)
    for measurement in measurements[: len(measurements) // 2]:
        odometry.process(measurement)
    early = front_end.keyframes()
    front_end.on_keyframe(keyframes.append)
    for measurement in measurements[len(measurements) // 2 :]:
        odometry.process(measurement)
    odometry.finish()
    assert keyframes
    assert [k.id for k in early] == list(range(len(keyframes)))
    assert keyframes[0].previous_id is None
    assert [k.id for k in front_end.keyframes(1)] == list(range(1, len(keyframes)))


def test_number_of_corners_can_be_reduced_and_restored(rig: Rig, measurements: list[Measurement]) -> None:
    odometry, counts, shares = Odometry(rig), list[int](), {20: 0.25, 45: 1.0}
    for measurement in until(measurements, 70):
        estimate = odometry.process(measurement)
        if estimate is not None:
            counts.append(sum(len(report.pixels) for report in estimate.pairs.values()))
            if len(counts) in shares:
                odometry.limit_corners(shares[len(counts)])
    odometry.finish()
    assert max(counts[25:45]) < 0.75 * min(counts[:20])  # at first up to two in each of the larger cells
    assert counts[-1] > 0.8 * counts[19]
    for share in (0.0, -1.0, 1.1, np.nan):
        with pytest.raises(ConfigError, match="give more than 0"):
            odometry.limit_corners(share)
