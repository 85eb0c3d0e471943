"""Single cameras with rolling shutters beside a stereo pair: their compensation depends on depths that motion shows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import half_size
from rendered import rendered_once
from synthetic import seen_points, transform, two_pair_rig

from graphvio import Odometry, Rig, Trajectory, load_trajectory, open_source
from graphvio.arrays import Float
from graphvio.config.stages import MotionConfig
from graphvio.evaluation import evaluate
from graphvio.frontend.depth.motion_stereo import PRIOR_INVERSE_DEPTH, FirstSights, MotionHistory
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.imaging.frozen import Frozen
from graphvio.frontend.motion.observations import Observations, RigArrays, correspond
from graphvio.frontend.motion.selection import searched_and_refined
from graphvio.frontend.pairs.agreement import agree
from graphvio.frontend.readouts import Readouts, readout_sigma_px
from graphvio.frontend.tracking.rolling_shutter import ReadoutMotion, as_at_stamp, pixels_at_stamp, rays_by_depth
from graphvio.frontend.tracking_frontend import TrackedFrameset
from graphvio.geometry import se3_inverse, so3_exp
from graphvio.rig import Camera, SingleCamera
from graphvio.simulation import Simulator, build_scene, write_recording
from graphvio.simulation.named_rigs import stereo_and_back

READOUT_S, SIGMA_PX = 20e-3, 0.3
THEN = ReadoutMotion(np.array([0.4, -0.6, 0.3]), np.array([0.3, 1.2, -0.4]))
NOW = ReadoutMotion(np.array([-0.3, 0.2, 0.5]), np.array([-0.2, 1.5, 0.6]))


def rolling(camera: Camera) -> Camera:
    return replace(camera, line_time_us=1e6 * READOUT_S / camera.size_px[1])


RIG = stereo_and_back().with_cameras(half_size).with_cameras(rolling)
CAMERA, SINGLE = RIG.singles[0].left, len(RIG.pairs)
CUR_T_REF = transform([0.03, -0.05, 0.02], [0.04, -0.3, 0.05])


def body_after(seconds: float, motion: ReadoutMotion) -> Float:
    """The pose of body some time after the stamp, in body at the stamp."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = so3_exp(seconds * motion.angular_velocity), seconds * motion.velocity
    return pose


def seen(points: Float, motion: ReadoutMotion) -> Float:
    """Pixels (N, 2) of points (N, 3) of body at the stamp, each seen at its line's instant."""
    pixels = np.zeros((len(points), 2))
    for i, point in enumerate(points):
        for _ in range(10):
            cam_T_stamp = se3_inverse(body_after(1e-6 * CAMERA.line_time_us * pixels[i, 1], motion) @ CAMERA.body_T_cam)
            pixels[i] = CAMERA.project((cam_T_stamp[:3, :3] @ point + cam_T_stamp[:3, 3])[None])[0][0]
    return pixels


def scene(n: int = 60) -> tuple[Float, Float]:
    """Points (N, 3) of body in front of the single camera, and ``[x, y, 1/Z]`` (N, 3) in it."""
    random = np.random.default_rng(3)
    rays, depths = random.uniform([-0.35, -0.25], [0.35, 0.25], (n, 2)), random.uniform(0.8, 3.0, n)
    in_cam = np.column_stack([rays, np.ones(n)]) * depths[:, None]
    return in_cam @ CAMERA.body_T_cam[:3, :3].T + CAMERA.body_T_cam[:3, 3], np.column_stack([rays, 1.0 / depths])


def moved(points: Float, cur_T_ref: Float) -> Float:
    return np.asarray(points @ cur_T_ref[:3, :3].T + cur_T_ref[:3, 3])


def in_camera(points: Float) -> Float:
    """``[x, y, 1/Z]`` (N, 3) of points (N, 3) of body."""
    in_cam = moved(points, CAMERA.cam_T_body)
    return np.column_stack([in_cam[:, :2] / in_cam[:, 2:], 1.0 / in_cam[:, 2]])


def tracks(pixels: Float, inverse_depths: Float, motion: ReadoutMotion, variance: float = 1e3) -> TrackedFrame:
    """Tracks of the single camera that are compensated with inverse depths (N,) of a variance."""
    n, whole = len(pixels), np.arange(len(pixels))
    rays, none = CAMERA.unproject(pixels)[0], np.zeros((n, 2))
    covariances = np.tile(np.diag([1.0 / CAMERA.focal_px**2, 1.0 / CAMERA.focal_px**2, variance]), (n, 1, 1))
    frame = TrackedFrame(
        0, whole, whole, pixels, rays, none, none, np.column_stack([rays, inverse_depths]), covariances, none,
        np.ones(n, dtype=bool), whole, is_single=True,
    )  # fmt: skip
    return as_at_stamp(frame, SingleCamera(CAMERA), motion)


def test_rays_by_depth_are_those_at_the_stamp_for_any_depth() -> None:
    points, true = scene()
    pixels = seen(points, THEN)
    rays, slopes = rays_by_depth(CAMERA, pixels, THEN)
    np.testing.assert_allclose(rays + true[:, 2:] * slopes, true[:, :2], atol=1e-9)
    assert CAMERA.focal_px * np.abs(slopes).max() > 3.0  # depth matters
    at_stamp = CAMERA.unproject(pixels_at_stamp(CAMERA, pixels, np.zeros(len(pixels)), THEN)[0])[0]
    np.testing.assert_allclose(rays, at_stamp, atol=1e-9)


@pytest.mark.parametrize("is_compensated", [True, False])
def test_locate_with_rolling_shutters_returns_exact_points(is_compensated: bool) -> None:
    points, _ = scene()
    now = moved(points, CUR_T_REF)
    first, history, ids = FirstSights(), MotionHistory(), np.arange(len(points))
    history.restart(0)
    for pixels, motion in ((seen(points, THEN), THEN), (seen(now, NOW), NOW)):
        rays, slopes = rays_by_depth(CAMERA, pixels, motion)
        found, _ = first.locate(
            ids, rays, history, CAMERA.body_T_cam, CAMERA.focal_px, SIGMA_PX, slopes if is_compensated else None
        )
        history.advance(0, 1, CUR_T_REF, 1e-12 * np.eye(6))
    errors = np.abs(found - in_camera(now)).max(axis=0)
    assert (errors < [1e-4, 1e-4, 1e-3]).all() == is_compensated


def test_first_sights_that_are_compensated_again_are_those_of_the_other_motion() -> None:
    points, _ = scene()
    now, ids = moved(points, CUR_T_REF), np.arange(len(points))
    first, history = FirstSights(), MotionHistory()
    history.restart(0)
    unmoving = replace(THEN, velocity=np.zeros(3))
    for motion in (unmoving, THEN):
        rays, slopes = rays_by_depth(CAMERA, seen(points, THEN), motion)
        if motion is unmoving:
            first.locate(ids, rays, history, CAMERA.body_T_cam, CAMERA.focal_px, SIGMA_PX, slopes)
        else:
            first.see_again(0, ids[::2], rays[::2], slopes[::2])
            first.see_again(5, ids, np.zeros_like(rays), np.zeros_like(slopes))  # of another keyframe
    history.advance(0, 1, CUR_T_REF, 1e-12 * np.eye(6))
    rays, slopes = rays_by_depth(CAMERA, seen(now, NOW), NOW)
    found, _ = first.locate(ids, rays, history, CAMERA.body_T_cam, CAMERA.focal_px, SIGMA_PX, slopes)
    errors = np.abs(found - in_camera(now))[:, 2]
    assert errors[::2].max() < 1e-3
    assert np.median(errors[1::2]) > 1e-2


def test_unknown_depths_are_in_the_covariance_of_points() -> None:
    """Where both framesets are compensated with a depth that is wrong, the points move by what the covariance has."""
    points, true = scene()
    wrong = np.full(len(points), PRIOR_INVERSE_DEPTH)
    reference, frame = tracks(seen(points, THEN), wrong, THEN), tracks(seen(moved(points, CUR_T_REF), NOW), wrong, NOW)
    frameset = TrackedFrameset(
        50_000_000, Frozen(frozenset(), None, ""), {SINGLE: frame}, {SINGLE: reference},
        correspond({SINGLE: reference}, {SINGLE: frame}), NOW,
    )  # fmt: skip
    arrays = RigArrays.of(RIG)
    allowed = Readouts(RIG).with_unknown_depths(frameset, arrays, CUR_T_REF).correspondences.observations

    def distances(observations: Observations) -> Float:
        """Squared errors (N,) of the true motion, whitened."""
        cam_T_cam = arrays.cam_T_body[SINGLE, 0] @ CUR_T_REF @ arrays.body_T_left[SINGLE]
        now = np.column_stack([observations.points[:, :2], np.ones(len(true))]) @ cam_T_cam[:3, :3].T
        now += observations.points[:, 2:] * cam_T_cam[:3, 3]
        predicted, z = now[:, :2] / now[:, 2:], now[:, 2:]
        by_point = np.stack(
            [(cam_T_cam[:2, k] - predicted * cam_T_cam[2, k]) / z for k in (0, 1, 3)], axis=2
        )  # with respect to x, y and the inverse depth
        covariances = by_point @ observations.covariances @ by_point.transpose(0, 2, 1)
        covariances += np.eye(2) / CAMERA.focal_px**2
        errors = observations.left - predicted
        return np.asarray(np.einsum("ni,nij,nj->n", errors, np.linalg.inv(SIGMA_PX**2 * covariances), errors))

    assert np.median(distances(frameset.correspondences.observations)) > 1.0
    assert np.median(distances(allowed)) < 0.1


def test_readout_error_is_that_of_the_depth_and_unlimited_without_reference() -> None:
    points, true = scene()
    pixels, sigma = seen(points, THEN), 0.05
    frame = tracks(pixels, true[:, 2], THEN)
    reference = tracks(pixels, true[:, 2], THEN, sigma**2).keep(np.arange(len(pixels)) % 2 == 0)
    found = readout_sigma_px(frame, reference, CAMERA.focal_px)
    assert np.isinf(found[1::2]).all()
    assert np.isinf(readout_sigma_px(frame, None, CAMERA.focal_px)).all()
    moved_px = np.linalg.norm(
        pixels_at_stamp(CAMERA, pixels, true[:, 2] + sigma, THEN)[0] - frame.pixels_at_stamp, axis=1
    )
    np.testing.assert_allclose(found[::2], moved_px[::2], rtol=0.3)  # the lens is not quite linear


def test_points_of_unknown_depth_are_no_second_motion() -> None:
    """Nearly any motion explains them, so that they outnumber the points of a pair."""
    pairs = two_pair_rig()
    rig = Rig(pairs.pairs[:1], pairs.imu, "", pairs.calibration_sigmas, (SingleCamera(pairs.pairs[1].left),))
    arrays, config = RigArrays.of(rig), MotionConfig()
    truth, other = transform([0.01, -0.03, 0.02], [0.05, -0.02, 0.03]), transform([0.0, 0.05, 0.0], [0.08, 0.04, 0.0])
    of_pair = seen_points(pairs, truth, 60, np.random.default_rng(1), sigma_px=0.2).of_pair(0)
    of_single = seen_points(pairs, other, 100, np.random.default_rng(2), sigma_px=0.2).of_pair(1)
    for variance, motions in ((1e3, 1), (0.0, 2)):
        covariances = of_single.covariances.copy()
        covariances[:, :, 2] = covariances[:, 2] = 0.0
        covariances[:, 2, 2] = variance
        alone = of_single._replace(
            covariances=covariances,
            right=np.zeros_like(of_single.right),
            has_right=np.zeros(len(of_single.pair), dtype=bool),
        )
        everything = Observations(*(np.concatenate(both) for both in zip(of_pair, alone, strict=True)))
        joint = searched_and_refined(arrays, of_pair, np.eye(4), config, np.random.default_rng(0))
        n = len(alone.pair)
        joint = replace(
            joint,
            inlier=np.concatenate([joint.inlier, np.zeros(n, dtype=bool)]),
            errors_px=np.concatenate([joint.errors_px, np.full(n, 50.0)]),
        )
        agreement = agree(arrays, everything, joint, config, np.random.default_rng(0))
        assert len(agreement.hypotheses) == motions


@pytest.fixture(scope="module")
def walk() -> Path:
    """The walk through the room, in motion from the first image on."""

    def write(folder: Path) -> None:
        write_recording(Simulator(build_scene("room", 5.0, 0.0), RIG, 1, rate_hz=10.0), folder)

    return rendered_once("room-rolling-single", write, "320x240", 5.0)


def test_run_with_a_rolling_single_camera_doubts_no_exact_calibration(walk: Path) -> None:
    source = open_source(walk)
    odometry = Odometry(source.rig)
    estimates = []
    for measurement in source:
        estimate = odometry.process(measurement)
        estimates += [] if estimate is None else [estimate]
    estimates += odometry.finish()
    assert odometry.take_events() == []  # no motion is weak, and no camera is elsewhere than in the rig file
    posed = [estimate for estimate in estimates if estimate.nav_T_body is not None]
    assert len(posed) == len(estimates)
    assert source.truth is not None
    reference = odometry._frontend._references.of(SINGLE)
    assert reference is not None
    sigmas = SIGMA_PX * np.sqrt(reference.covariances[:, 2, 2])
    assert np.mean(sigmas < 0.1 * reference.points[:, 2]) > 0.4  # by the points' motion through several keyframes
    poses = np.array([estimate.nav_T_body for estimate in posed])
    found = evaluate(Trajectory(np.array([e.stamp_ns for e in posed]), poses), load_trajectory(source.truth))
    assert found.ate_position_m.rmse < 1e-3
