"""Rolling shutters: rendered line by line, compensated in the front-end, and what that is worth."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from recordings import half_size, half_size_rig, small_rig
from rendered import rendered_once

from graphvio import Odometry, Rig, RigError, Trajectory, load_trajectory, open_source
from graphvio.arrays import Float
from graphvio.backend.readout_factor import readout_factor
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.config import Config
from graphvio.evaluation import evaluate
from graphvio.frontend.depth.stereo import triangulate
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.imaging.frozen import Frozen
from graphvio.frontend.motion.observations import Observations, RigArrays, correspond
from graphvio.frontend.motion.readout_errors import derivatives_by_readout
from graphvio.frontend.motion.refinement import refine
from graphvio.frontend.readouts import Readouts
from graphvio.frontend.tracking.measured_readouts import MeasuredReadouts
from graphvio.frontend.tracking.rolling_shutter import (
    ReadoutMotion,
    as_at_stamp,
    pixels_at_lines,
    pixels_at_stamp,
    turned_rays,
)
from graphvio.frontend.tracking_frontend import TrackedFrameset
from graphvio.frontend.visual import VisualFrontend
from graphvio.geometry import se3, se3_inverse, se3_log, so3_exp
from graphvio.measurements.events import EventKind
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.inertial_state import InertialState
from graphvio.measurements.motion import ByVelocities, Quality, RelativeMotion
from graphvio.measurements.sensors import FrameSet, ImuSample
from graphvio.monocular.equations import visual_equations
from graphvio.monocular.reprojection import Cameras
from graphvio.monocular.structure import Eliminated, Structure
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Camera, SingleCamera
from graphvio.self_calibration.online import SelfCalibration
from graphvio.simulation import Simulator, build_scene, default_rig, write_recording
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.simulation.named_rigs import phone, stereo

DURATION_S, READOUT_US = 5.0, 20e3
MOTION = ReadoutMotion(
    np.array([0.8, -1.5, 1.1]), np.array([0.9, -0.4, 0.3]), np.array([4.0, 2.0, -3.0]), np.array([-2.0, 3.0, 1.0])
)


def rolling(camera: Camera) -> Camera:
    return replace(camera, line_time_us=READOUT_US / camera.size_px[1])


def body_at(seconds: float) -> Float:
    """The pose of body after the stamp, in body at the stamp."""
    turn = seconds * MOTION.angular_velocity + 0.5 * seconds**2 * MOTION.angular_acceleration
    return se3(so3_exp(turn), seconds * MOTION.velocity + 0.5 * seconds**2 * MOTION.acceleration)


def seen(camera: Camera, points: Float) -> tuple[Float, Float]:
    """Pixels (N, 2) and inverse depths (N,) of points (N, 3) of body at the stamp, each seen at its line's instant."""
    pixels, depths = np.zeros((len(points), 2)), np.zeros(len(points))
    for i, point in enumerate(points):
        line = 0.0
        for _ in range(10):
            cam_T_stamp = se3_inverse(body_at(1e-6 * camera.line_time_us * line) @ camera.body_T_cam)
            in_cam = cam_T_stamp[:3, :3] @ point + cam_T_stamp[:3, 3]
            pixels[i] = camera.project(in_cam[None])[0][0]
            depths[i], line = 1.0 / in_cam[2], pixels[i, 1]
    return pixels, depths


def scene(rig: Rig) -> Float:
    """Points (N, 3) of body that both cameras of the first pair see."""
    body_T_left = rig.pairs[0].left.body_T_cam
    rays = np.random.default_rng(0).uniform([-0.4, -0.3, 1.0], [0.4, 0.3, 1.0], (60, 3))
    points = rays * np.random.default_rng(1).uniform(1.0, 6.0, (60, 1))
    return np.asarray(points @ body_T_left[:3, :3].T + body_T_left[:3, 3])


@pytest.mark.parametrize("side", [0, 1])
def test_pixels_at_stamp_are_those_of_a_global_shutter(side: int) -> None:
    rig = half_size_rig().with_cameras(rolling)
    camera, points = rig.cameras[side], scene(rig)
    pixels, inverse_depths = seen(camera, points)
    in_cam = points @ camera.cam_T_body[:3, :3].T + camera.cam_T_body[:3, 3]
    expected, _ = camera.project(in_cam)
    assert np.abs(expected - pixels).max() > 3.0  # the motion matters
    found, depths = pixels_at_stamp(camera, pixels, inverse_depths, MOTION)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(depths, 1.0 / in_cam[:, 2], atol=1e-9)
    again, depths = pixels_at_lines(camera, expected, 1.0 / in_cam[:, 2], MOTION)
    np.testing.assert_allclose(again, pixels, atol=1e-3)
    np.testing.assert_allclose(depths, inverse_depths, atol=1e-5)


def test_points_of_a_pair_are_triangulated_at_the_stamp() -> None:
    rig = half_size_rig().with_cameras(rolling)
    pair, points = rig.pairs[0], scene(rig)
    (left_px, _), (right_px, _) = seen(pair.left, points), seen(pair.right, points)
    left, right = pair.left.unproject(left_px)[0], pair.right.unproject(right_px)[0]
    found, covariances, _ = triangulate(left, right, pair.right_T_left, pair.left.focal_px, pair.right.focal_px)
    n, whole = len(points), np.arange(len(points))
    frame = TrackedFrame(
        0,
        whole,
        whole,
        left_px,
        left,
        right,
        right_px,
        found,
        covariances,
        np.zeros((n, 2)),
        np.ones(n, dtype=bool),
        whole,
    )
    compensated = as_at_stamp(frame, pair, MOTION)
    in_left = points @ pair.left.cam_T_body[:3, :3].T + pair.left.cam_T_body[:3, 3]
    expected = np.column_stack([in_left[:, :2] / in_left[:, 2:], 1.0 / in_left[:, 2]])
    assert np.abs(found - expected)[:, :2].max() > 0.01
    np.testing.assert_allclose(compensated.points[:, :2], expected[:, :2], atol=2e-4)
    np.testing.assert_allclose(compensated.points[:, 2], expected[:, 2], atol=2e-3)
    np.testing.assert_array_equal(compensated.pixels, left_px)
    again = compensated.recalibrated(pair)
    np.testing.assert_array_equal(again.points, compensated.points)
    alone = as_at_stamp(frame, SingleCamera(pair.left), MOTION)
    np.testing.assert_allclose(alone.points[:, :2], expected[:, :2], atol=2e-4)


def test_readout_motion_of_rate_and_force_that_change() -> None:
    """The IMU of a motion whose accelerations change, in a body that turns against gravity."""
    motion, gravity = replace(MOTION, angular_jerk=np.array([90.0, -60.0, 40.0])), np.array([1.0, -2.0, -9.0])
    gyro_bias, accel_bias, duration_s = np.full(3, 0.1), np.full(3, -0.05), 0.04
    middles, steps_s = np.arange(0.5, 8.0) * 0.005, np.full(8, 0.005)
    rates = motion.angular_velocity + np.outer(middles, motion.angular_acceleration)
    rates += np.outer(0.5 * (middles**2 + 0.005**2 / 12.0), motion.angular_jerk)
    turns = np.outer(middles, motion.angular_velocity) + np.outer(0.5 * middles**2, motion.angular_acceleration)
    turns += np.outer(middles**3 / 6.0, motion.angular_jerk)
    forces = np.array([so3_exp(turn).T @ (motion.acceleration - gravity) for turn in turns])
    interval = ImuInterval(steps_s, rates + gyro_bias, forces + accel_bias)
    found = ReadoutMotion.by_imu(interval, gyro_bias, accel_bias).falling(motion.velocity, gravity)
    np.testing.assert_allclose(found.angular_velocity, motion.angular_velocity, atol=1e-9)
    np.testing.assert_allclose(found.angular_acceleration, motion.angular_acceleration, atol=1e-6)
    np.testing.assert_allclose(found.angular_jerk, motion.angular_jerk, atol=1e-4)
    np.testing.assert_allclose(found.acceleration, motion.acceleration, atol=1e-6)
    np.testing.assert_allclose(found.jerk, np.zeros(3), atol=1e-4)
    one = ReadoutMotion.by_imu(ImuInterval(np.array([duration_s]), rates[:1], forces[:1]), np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(one.angular_velocity, rates[0])
    np.testing.assert_array_equal(one.angular_acceleration, np.zeros(3))


@pytest.mark.parametrize("readout_s", [0.005, 0.01, 0.02, 0.033])
@pytest.mark.parametrize(
    "spacing_s", [[5e-3], [20e-3], [1e-3], [15e-3, 5e-5, 5e-5, 5e-5], [9.95e-3, 5e-5], [5e-3, 1e-8]]
)
def test_readout_motion_by_samples_in_bursts_is_not_far_off(readout_s: float, spacing_s: list[float]) -> None:
    """Stamps of arrival come in bursts: between them no parabola of the rate is known."""
    random = np.random.default_rng(6)
    steps_s = np.resize(spacing_s, 100)
    first = int(random.integers(len(spacing_s)))
    steps_s = steps_s[first:]
    ends_s = np.minimum(np.cumsum(steps_s), readout_s)
    steps_s = np.diff(ends_s, prepend=0.0)[: int(np.searchsorted(ends_s, readout_s)) + 1]
    noisy = MOTION.angular_velocity + 2e-3 * random.normal(size=(len(steps_s), 3))
    found = ReadoutMotion.by_imu(ImuInterval(steps_s, noisy, np.zeros((len(steps_s), 3))), np.zeros(3), np.zeros(3))
    times = np.linspace(0.0, readout_s, 50)[:, None]
    turns = times * found.angular_velocity + 0.5 * times**2 * found.angular_acceleration
    turns += times**3 / 6.0 * found.angular_jerk
    assert np.abs(turns - times * MOTION.angular_velocity).max() < 4e-3 * readout_s + 3e-5


def test_readout_motion_goes_on_as_before() -> None:
    motion = ReadoutMotion(MOTION.angular_velocity, np.zeros(3))
    prev_T_cur = se3(so3_exp(0.05 * motion.angular_velocity), 0.05 * np.array([1.0, 0.0, 0.0]))
    found = ReadoutMotion.steady(se3_inverse(prev_T_cur), 0.05)
    np.testing.assert_allclose(found.angular_velocity, motion.angular_velocity, atol=1e-9)
    np.testing.assert_allclose(prev_T_cur[:3, :3] @ found.velocity, [1.0, 0.0, 0.0], atol=1e-9)


def test_lines_are_rendered_from_where_the_camera_is_then() -> None:
    simulator = Simulator(build_scene("room", 4.0), stereo().with_cameras(half_size).with_cameras(rolling))
    index, at = 60, simulator.scene.motion.at
    surfaces, camera = simulator.surfaces(index), simulator.rig.cameras[0]
    view = simulator.view(index, 0, surfaces)
    still = Simulator(simulator.scene, stereo().with_cameras(half_size))
    for line in (0, 100, 239):
        seconds = 3.0 + 1e-6 * camera.line_time_us * line
        rays = still._rays_of(0)[0]
        then = rays.render(surfaces, still._prepared.atlas, at(np.array([seconds])).world_T_body[0] @ camera.body_T_cam)
        np.testing.assert_allclose(view.depth[line], then.depth[line], rtol=1e-9)
        inner = np.abs(np.diff(then.depth[line], prepend=0.0)) < 0.01  # borders are averaged with lines beside
        assert np.median(np.abs(view.radiance[line] - then.radiance[line])[inner]) < 1e-6
    assert np.abs(view.depth[239] - still.view(index, 0, surfaces).depth[239]).max() > 0.005


def test_framesets_wait_for_the_imu_of_their_last_line() -> None:
    rig = small_rig(1).with_cameras(rolling)
    synchroniser = Synchroniser(rig, Config(), lambda *_: None)
    for stamp_ns in range(0, 101_000_000, 5_000_000):
        synchroniser.add_sample(ImuSample(stamp_ns, np.zeros(3), np.array([0.0, 0.0, 9.81])))
    synchroniser.add_frameset(FrameSet(90_000_000, {}))
    assert synchroniser.next_due(initialised=True) is None
    for stamp_ns in (105_000_000, 110_000_000):
        synchroniser.add_sample(ImuSample(stamp_ns, np.zeros(3), np.array([0.0, 0.0, 9.81])))
    assert synchroniser.next_due(initialised=True) is not None


def test_the_first_frameset_waits_for_the_imu_of_its_last_line() -> None:
    """Though there are samples enough from before it, to initialise by."""
    synchroniser = Synchroniser(small_rig(1).with_cameras(rolling), Config(), lambda *_: None)
    for stamp_ns in range(0, 1_010_000_000, 5_000_000):
        synchroniser.add_sample(ImuSample(stamp_ns, np.zeros(3), np.array([0.0, 0.0, 9.81])))
    synchroniser.add_frameset(FrameSet(1_000_000_000, {}))
    assert synchroniser.next_due(initialised=False) is None
    for stamp_ns in (1_010_000_000, 1_015_000_000, 1_020_000_000):
        synchroniser.add_sample(ImuSample(stamp_ns, np.zeros(3), np.array([0.0, 0.0, 9.81])))
    assert synchroniser.next_due(initialised=False) is not None


def test_line_times_that_make_no_sense_are_refused() -> None:
    rig = small_rig(1)
    with pytest.raises(RigError, match=r"camera cam0: line_time_us is 41000\.0; it must be in microseconds"):
        rig.with_cameras(lambda camera: replace(camera, line_time_us=41e3))
    with pytest.raises(RigError, match=r"read their lines out in 0\.0 and 19\.6 ms; a pair needs the same"):
        replace(rig.pairs[0], right=rolling(rig.pairs[0].right))


def test_velocities_are_those_of_measured_motions() -> None:
    """Between two framesets a quadratic motion's are exact; at the newest one with the IMU's acceleration."""
    step_ns = 50_000_000
    poses = [body_at(1e-9 * step_ns * k) for k in (-1, 0, 1)]
    now = poses[2][:3, :3]
    by_imu = replace(MOTION, velocity=np.zeros(3), acceleration=now.T @ MOTION.acceleration, is_by_imu=True)
    true = now.T @ (MOTION.velocity + 1e-9 * step_ns * MOTION.acceleration)
    for known, is_newest_exact in ((by_imu, True), (None, False)):
        readouts = MeasuredReadouts(20_000_000)
        assert readouts.at(0) is None
        readouts.note(-step_ns, 0, se3_inverse(poses[0]) @ poses[1], (None, None))
        readouts.note(0, step_ns, poses[2], (known, None))
        between, newest = readouts.at(0), readouts.at(step_ns)
        assert between is not None
        assert newest is not None
        np.testing.assert_allclose(between.velocity, MOTION.velocity, atol=1e-9)
        np.testing.assert_allclose(between.angular_velocity, MOTION.angular_velocity, atol=5e-3)
        assert (np.abs(newest.velocity - true).max() < 1e-9) == is_newest_exact
        assert newest.is_by_imu == is_newest_exact
        assert newest.velocity_covariance is not None
        assert np.linalg.norm(newest.velocity - true) < 3.0 * np.sqrt(np.trace(newest.velocity_covariance))


def test_velocities_are_not_those_of_framesets_within_two_readouts() -> None:
    readouts = MeasuredReadouts(30_000_000)
    readouts.note(0, 33_000_000, body_at(0.033), (None, None))
    assert readouts.at(33_000_000) is None
    readouts.note(0, 66_000_000, body_at(0.066), (None, None))
    assert readouts.at(66_000_000) is not None


@pytest.mark.parametrize("peak", [0.1, 4.0], ids=["walk", "shaken"])
def test_errors_of_velocities_by_vision_are_within_their_covariances(peak: float) -> None:
    """Sinusoids of 1.5 Hz, of a walk and of a shaken head, whose phases are random."""
    random, step_ns, wave = np.random.default_rng(8), 50_000_000, 2.0 * np.pi * 1.5
    squares: dict[bool, list[Float]] = {False: [], True: []}
    for phase in random.uniform(0.0, 2.0 * np.pi, 60):
        axes = np.linalg.qr(random.normal(size=(3, 3)))[0][:2]

        def pose(k: int, phase: float = phase, axes: Float = axes) -> Float:
            swing = peak / wave * np.sin(wave * 1e-9 * step_ns * k + phase)
            return se3(so3_exp(swing * axes[0]), swing * axes[1])

        readouts = MeasuredReadouts(20_000_000)
        for k in range(1, 12):
            readouts.note(step_ns * (k - 1), step_ns * k, se3_inverse(pose(k - 1)) @ pose(k), (None, None))
        for k in 10, 11:
            assert readouts.knows_both_sides_of(step_ns * k) == (k == 10)
            found, rate = readouts.at(step_ns * k), peak * np.cos(wave * 1e-9 * step_ns * k + phase)
            assert found is not None
            assert found.velocity_covariance is not None
            turn = pose(k)[:3, :3]
            true = np.concatenate([rate * axes[0], rate * turn.T @ axes[1]])
            sigmas = np.repeat([found.angular_velocity_sigma, np.sqrt(found.velocity_covariance[0, 0])], 3)
            squares[k == 10].append(((np.concatenate([found.angular_velocity, found.velocity]) - true) / sigmas) ** 2)
    for each in squares.values():
        angular, linear = np.mean(each, axis=0).reshape(2, 3).mean(axis=1)
        assert angular < 1.5
        assert linear < 1.5
        assert peak < 1.0 or min(angular, linear) > 0.05


def test_frameset_is_compensated_by_both_sides_only_after_a_later_one() -> None:
    rig = half_size_rig().with_cameras(rolling).without_imu()
    points, pair, readouts, step_ns = scene(rig), rig.pairs[0], Readouts(rig), 50_000_000
    (left_px, _), (right_px, _) = seen(pair.left, points), seen(pair.right, points)
    left, right = pair.left.unproject(left_px)[0], pair.right.unproject(right_px)[0]
    found, covariances, _ = triangulate(left, right, pair.right_T_left, pair.left.focal_px, pair.right.focal_px)
    frame = replace(
        tracked(found, left_px, left_px[:, 1]), left_rays=left, right_rays=right, right_pixels=right_px,
        covariances=covariances,
    )  # fmt: skip
    poses = [body_at(1e-9 * step_ns * k) for k in (-1, 0, 1)]
    readouts._measured.note(-step_ns, 0, se3_inverse(poses[0]) @ poses[1], (None, None))
    assert readouts.compensated_by_both_sides(0, {0: frame}, rig) is None
    readouts._measured.note(0, step_ns, se3_inverse(poses[1]) @ poses[2], (None, None))
    again = readouts.compensated_by_both_sides(0, {0: frame}, rig)
    assert again is not None
    by_truth = as_at_stamp(frame, pair, MOTION)
    np.testing.assert_allclose(again[0].pixels_at_stamp, by_truth.pixels_at_stamp, atol=0.02)
    assert np.abs(by_truth.pixels_at_stamp - left_px).max() > 1.0
    assert readouts.compensated_by_both_sides(step_ns, {0: frame}, rig) is None


def test_framesets_of_a_long_keyframe_are_forgotten() -> None:
    readouts = MeasuredReadouts(20_000_000)
    for k in range(1, 200):
        readouts.note(0, 50_000_000 * k, np.eye(4), (MOTION, MOTION))
    assert len(readouts._framesets) < 30
    known = readouts.at(0)
    assert known is not None
    np.testing.assert_array_equal(known.angular_velocity, MOTION.angular_velocity)  # of the first one, by the gyro


def compensated(rig: Rig, points: Float, error: Float) -> tuple[Float, Float, Float]:
    """Points (N, 3) ``[x, y, 1/Z]`` of the left camera at the stamp by wrong velocities, right rays, and line times.

    The error is that of angular velocity and velocity.
    """
    pair = rig.pairs[0]
    motion = replace(MOTION, angular_velocity=MOTION.angular_velocity + error[:3], velocity=MOTION.velocity + error[3:])
    rays = []
    for camera in pair.left, pair.right:
        pixels, depths = seen(camera, points)
        rays.append(camera.unproject(pixels_at_stamp(camera, pixels, depths, motion)[0])[0])
        if camera is pair.left:
            lines = pixels[:, 1]
    found, _, _ = triangulate(rays[0], rays[1], pair.right_T_left, pair.left.focal_px, pair.right.focal_px)
    return found, rays[1], 1e-6 * pair.left.line_time_us * lines


@pytest.mark.parametrize("which", [0, 1], ids=["now", "reference"])
@pytest.mark.parametrize("error", [[0.0, 0.0, 0.0, 0.03, -0.02, 0.04], [0.02, -0.01, 0.03, 0.0, 0.0, 0.0]])
def test_wrong_velocities_change_a_motion_as_its_derivatives_say(which: int, error: list[float]) -> None:
    rig = half_size_rig().with_cameras(rolling)
    points = scene(rig)
    cur_T_ref = se3(so3_exp(np.array([0.02, -0.01, 0.03])), np.array([0.05, 0.02, -0.03]))
    now, right, seconds_now = compensated(rig, points, np.array(error) if which == 0 else np.zeros(6))
    then = points @ cur_T_ref[:3, :3] - cur_T_ref[:3, 3] @ cur_T_ref[:3, :3]  # where the points are at the reference
    reference, _, seconds_then = compensated(rig, then, np.array(error) if which == 1 else np.zeros(6))
    n = len(points)
    covariances = np.tile(1e-8 * np.eye(3), (n, 1, 1))
    everything = np.ones(n, dtype=bool)
    observations = Observations(
        np.zeros(n, dtype=np.int64), reference, covariances, np.ascontiguousarray(now[:, :2]), right, everything
    )
    arrays, config = RigArrays.of(rig), Config().motion
    refined = refine(arrays, observations, cur_T_ref, config)
    assert refined.inlier.all()
    measured = se3_log(np.ascontiguousarray(se3_inverse(refined.cur_T_ref @ se3_inverse(cur_T_ref))))
    derivatives = derivatives_by_readout(
        arrays,
        observations,
        everything,
        refined.cur_T_ref,
        config.pixel_sigma_px,
        np.array([seconds_now, seconds_then]),
    )
    expected = -derivatives[which] @ error  # the true velocity is less than the one that was used
    assert np.linalg.norm(measured) > 3e-4
    assert np.linalg.norm(measured - expected) < 0.1 * np.linalg.norm(measured)


def tracked(points: Float, pixels: Float, lines: Float) -> TrackedFrame:
    """Tracks that are seen at some lines (N,)."""
    n = len(points)
    whole, pixels = np.arange(n), np.column_stack([pixels[:, 0], lines])
    none = np.zeros((n, 2))
    return TrackedFrame(
        0, 3 * whole, whole, pixels, points[:, :2].copy(), none, none, points, np.tile(np.eye(3), (n, 1, 1)), none,
        np.ones(n, dtype=bool), whole,
    )  # fmt: skip


def test_line_times_are_of_the_points_rows_now_and_at_the_reference() -> None:
    """Of two pairs, the second of which has lost every other track."""
    pairs = small_rig(2)
    rig = replace(pairs, pairs=(pairs.pairs[0], replace(pairs.pairs[1], left=rolling(pairs.pairs[1].left),
                                                        right=rolling(pairs.pairs[1].right))))  # fmt: skip
    random = np.random.default_rng(5)
    points = np.column_stack([random.uniform(-0.3, 0.3, (20, 2)), np.full(20, 0.3)])
    now, then = (random.uniform(0.0, 200.0, 20) for _ in range(2))
    reference = {j: tracked(points, 100.0 * points[:, :2], then) for j in range(2)}
    whole = tracked(points, 100.0 * points[:, :2], now)
    frames = {0: whole, 1: whole.keep(np.arange(20) % 2 == 0)}
    seen = TrackedFrameset(
        50_000_000, Frozen(frozenset(), None, ""), frames, reference, correspond(reference, frames), None
    )
    seconds = Readouts(rig)._line_seconds(seen)
    line_s = 1e-6 * rig.pairs[1].left.line_time_us
    expected = np.zeros((2, 30))
    expected[:, 20:] = line_s * np.array([now[::2], then[::2]])
    np.testing.assert_allclose(seconds, expected)


def test_errors_of_readouts_are_those_of_both_velocities_and_of_the_gyro() -> None:
    pairs = small_rig(2)
    rig = pairs.with_cameras(rolling)
    assert rig.imu is not None
    random = np.random.default_rng(6)
    points = np.column_stack([random.uniform(-0.3, 0.3, (20, 2)), np.full(20, 0.3)])
    reference, frames = (
        {j: tracked(points, 100.0 * points[:, :2], random.uniform(0.0, 200.0, 20)) for j in range(2)} for _ in range(2)
    )
    covariances = np.array([np.diag([1e-4, 4e-4, 9e-4]), np.diag([1e-6, 0.0, 1e-2])])
    readouts, motions = Readouts(rig), [replace(MOTION, velocity_covariance=c, is_by_imu=True) for c in covariances]
    seen = TrackedFrameset(
        50_000_000, Frozen(frozenset(), None, ""), frames, reference, correspond(reference, frames), motions[0]
    )
    readouts._applied[seen.reference_stamp_ns] = motions[1]
    arrays, inlier, observations = RigArrays.of(rig), np.ones(20, dtype=bool), seen.correspondences.observations
    rates = rig.imu.gyro_noise_density**2 / (1e-9 * rig.cameras[0].readout_ns) * np.eye(3)
    every = np.ones(40, dtype=bool)
    for j, rows in ((0, slice(0, 20)), (1, slice(20, 40))):
        derivatives = derivatives_by_readout(
            arrays, observations.of_pair(j), inlier, np.eye(4), 0.3,
            np.ascontiguousarray(readouts._line_seconds(seen)[:, rows]),
        )  # fmt: skip
        by_errors = readouts.shared_errors(seen, arrays, 0.3)(j, inlier, np.eye(4))
        expected = sum(
            d[:, :3] @ rates @ d[:, :3].T + d[:, 3:] @ c @ d[:, 3:].T
            for d, c in zip(derivatives, covariances, strict=True)
        )
        np.testing.assert_allclose(by_errors @ by_errors.T, expected, rtol=1e-6, atol=1e-15)
    by_velocities, (now, then) = readouts.errors(seen, arrays, every, np.eye(4), 0.3)
    derivatives = derivatives_by_readout(arrays, observations, every, np.eye(4), 0.3, readouts._line_seconds(seen))
    np.testing.assert_array_equal(by_velocities.derivatives, derivatives[:, :, 3:])
    for found, each in ((now, derivatives[0]), (then, derivatives[1])):
        np.testing.assert_allclose(found, each[:, :3] @ rates @ each[:, :3].T, rtol=1e-6, atol=1e-15)
    by_both = [d[:, 3:] @ c @ d[:, 3:].T for d, c in zip(derivatives, covariances, strict=True)]
    np.testing.assert_allclose(by_velocities.covariances_of_motion, by_both, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("is_single", [False, True])
def test_compensating_again_is_compensating_once(is_single: bool) -> None:
    rig = half_size_rig().with_cameras(rolling)
    pair, points = rig.pairs[0], scene(rig)
    (left_px, _), (right_px, _) = seen(pair.left, points), seen(pair.right, points)
    left, right = pair.left.unproject(left_px)[0], pair.right.unproject(right_px)[0]
    found, covariances, _ = triangulate(left, right, pair.right_T_left, pair.left.focal_px, pair.right.focal_px)
    group = SingleCamera(pair.left) if is_single else pair
    frame = replace(
        tracked(found, left_px, left_px[:, 1]), left_rays=left, right_rays=right, right_pixels=right_px,
        covariances=covariances, is_single=is_single,
    )  # fmt: skip
    once = as_at_stamp(frame, group, MOTION)
    twice = again = as_at_stamp(once, group, MOTION)
    for _ in range(30):
        again = as_at_stamp(again, group, MOTION)
    np.testing.assert_allclose(again.points, twice.points, atol=1e-9)
    np.testing.assert_allclose(again.points[:, 2], once.points[:, 2], rtol=1e-6)
    # A single camera's point is where it is at the stamp from then on, and no longer where a line has seen it.
    np.testing.assert_allclose(again.points[:, :2], once.points[:, :2], atol=2e-3 if is_single else 1e-9)


def by_velocities() -> ByVelocities:
    random = np.random.default_rng(3)
    derivatives = 0.03 * random.normal(size=(2, 6, 3))
    return ByVelocities(random.normal(size=(2, 3)), derivatives, np.tile(0.01 * np.eye(3), (2, 1, 1)))


def test_factor_of_a_motion_has_the_derivatives_of_its_error() -> None:
    random = np.random.default_rng(4)
    keys, velocities = [gtsam.symbol("x", k) for k in (0, 1)], [gtsam.symbol("v", k) for k in (1, 0)]
    values = gtsam.Values()
    poses = [se3(so3_exp(random.normal(size=3)), random.normal(size=3)) for _ in range(2)]
    for key, pose in zip(keys, poses, strict=True):
        values.insert(key, gtsam.Pose3(pose))
    dependence = by_velocities()
    for k, key in enumerate(velocities):
        values.insert(key, poses[1 - k][:3, :3] @ dependence.used[k])
    motion = RelativeMotion(
        0, 1, se3_inverse(poses[0]) @ poses[1], np.eye(6), np.zeros((6, 6)), 50, by_velocities=dependence
    )
    factor = readout_factor(keys[0], keys[1], (velocities[0], velocities[1]), motion, gtsam.noiseModel.Unit.Create(6))
    np.testing.assert_allclose(factor.unwhitenedError(values), np.zeros(6), atol=1e-9)
    system, _ = factor.linearize(values).jacobian()
    sizes = [6, 6, 3, 3]
    for column, derivative in enumerate(system.T):
        errors = []
        for step in (1e-6, -1e-6):
            change, parts = gtsam.VectorValues(), np.split(step * np.eye(18)[column], np.cumsum(sizes)[:-1])
            for key, part in zip([*keys, *velocities], parts, strict=True):
                change.insert(key, part)
            errors.append(factor.unwhitenedError(values.retract(change)))
        np.testing.assert_allclose((errors[0] - errors[1]) / 2e-6, derivative, atol=1e-6)


def test_covariance_with_any_velocity_has_that_of_the_velocities() -> None:
    dependence = by_velocities()
    motion = RelativeMotion(0, 1, np.eye(4), 1e-6 * np.eye(6), 1e-8 * np.eye(6), 50, by_velocities=dependence)
    whole = motion.with_any_velocity()
    assert whole.by_velocities is None
    now, then = (each @ each.T * 0.01 for each in dependence.derivatives)
    np.testing.assert_allclose(whole.covariance, motion.covariance + now + then)
    np.testing.assert_allclose(whole.shared_covariance, motion.shared_covariance + then)
    assert replace(motion, by_velocities=None).with_any_velocity().covariance is motion.covariance


def test_views_of_a_single_camera_are_from_where_its_lines_see_them() -> None:
    """The reprojection errors are zero by the velocity of the state, whatever depth was known when it was seen."""
    rig = half_size_rig().with_cameras(rolling)
    camera, points = rig.pairs[0].left, scene(rig)
    single = Rig((), rig.imu, singles=(SingleCamera(camera),))
    pixels, _ = seen(camera, points)
    gravity = np.array([1.0, -2.0, -9.0])
    measured = replace(MOTION, velocity=np.zeros(3), acceleration=np.zeros(3), force=MOTION.acceleration - gravity)
    rays, readout = turned_rays(camera, pixels, measured)
    in_cam, n = points @ camera.cam_T_body[:3, :3].T + camera.cam_T_body[:3, 3], len(points)
    landmarks = np.column_stack([in_cam[:, :2] / in_cam[:, 2:], 1.0 / in_cam[:, 2]])
    zero = np.zeros(n, dtype=np.int64)
    structure = Structure(np.tile(camera.body_T_cam, (n, 1, 1)), np.arange(n + 1), zero, zero, rays, readout)
    errors2 = [
        visual_equations(
            np.eye(4)[None],
            np.array([[velocity, 0.5 * gravity]]),
            Cameras.of(single),
            landmarks,
            structure,
            0.3,
            0.0,
            1e4,
            Eliminated.empty(structure),
        )[3]
        for velocity in (MOTION.velocity, np.zeros(3))
    ]
    assert errors2[0].max() < 1e-6
    assert np.median(errors2[1]) > 1.0


def rendered_room(name: str, rig: Rig, duration_s: float, rate_hz: float = 20.0) -> Path:
    """A walk through the room, rendered once."""

    def write(folder: Path) -> None:
        write_recording(Simulator(build_scene("room", duration_s), rig, 1, rate_hz=rate_hz), folder)

    return rendered_once(f"room-{name}", write, "320x240", duration_s)


@pytest.fixture(scope="module")
def fast_walk() -> Path:
    """Images at 30 Hz that are read out in 30 ms."""
    rig = stereo().with_cameras(half_size).with_cameras(lambda camera: replace(camera, line_time_us=30e3 / 240))
    return rendered_room("rolling-30hz", rig, 4.0, 30.0)


@pytest.fixture(scope="module")
def two_pairs() -> Path:
    return rendered_room("rolling-two-pairs", default_rig().with_cameras(half_size).with_cameras(rolling), 3.5, 10.0)


@pytest.fixture(scope="module")
def noisy_pairs() -> Path:
    """Two pairs that are read out in 29 ms, beside a gyro with eight times the usual noise."""
    rig = default_rig().with_cameras(half_size).with_cameras(lambda camera: replace(camera, line_time_us=29e3 / 240))
    assert rig.imu is not None
    imu = replace(rig.imu, gyro_noise_density=8.0 * rig.imu.gyro_noise_density)
    return rendered_room("rolling-noisy-pairs", replace(rig, imu=imu), 3.0, 15.0)


def test_pairs_beside_a_noisy_gyro_do_not_contradict_each_other(noisy_pairs: Path) -> None:
    source = open_source(noisy_pairs)
    odometry = Odometry(source.rig)
    for measurement in source:
        odometry.process(measurement)
    assert odometry.take_events() == []


@pytest.fixture(scope="module")
def walk() -> Path:
    return rendered_room("rolling", stereo().with_cameras(half_size).with_cameras(rolling), DURATION_S)


def ate_m(walk: Path, rig: Rig, begin_s: float = 0.0) -> float:
    """Begun in the walk, with the IMU's samples from just before as a live source has them."""
    source = open_source(walk, rig, from_s=begin_s)
    assert source.truth is not None
    odometry = Odometry(source.rig)
    estimates = [each for each in map(odometry.process, source) if each is not None] + odometry.finish()
    posed = [each for each in estimates if each.nav_T_body is not None]
    poses: Float = np.array([each.nav_T_body for each in posed])
    estimated = Trajectory(np.array([each.stamp_ns for each in posed], dtype=np.int64), poses)
    return evaluate(estimated, load_trajectory(source.truth)).ate_position_m.rmse


def test_the_line_time_in_the_rig_restores_the_accuracy(walk: Path) -> None:
    rig = open_source(walk).rig
    known = ate_m(walk, rig)
    assert known < 0.002
    assert ate_m(walk, rig.without_imu()) < 0.002
    assert ate_m(walk, rig.with_cameras(lambda camera: replace(camera, line_time_us=0.0))) > 5.0 * known


def test_a_walk_that_begins_in_motion_is_as_accurate_as_one_from_a_standstill(walk: Path) -> None:
    """The velocity of the first framesets is not known, and points of theirs are seen for long."""
    rig = open_source(walk).rig
    assert ate_m(walk, rig, 2.0) < 0.0008
    assert ate_m(walk, rig.without_imu(), 2.0) < 0.002


def test_first_framesets_in_motion_are_not_calibrated_by(fast_walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their velocity is not known yet, nor whether their points were compensated rightly."""
    calibrated: set[int] = set()
    add_frameset = SelfCalibration.add_frameset

    def noting(self: SelfCalibration, stamp_ns: int, *others: Any) -> None:
        calibrated.add(stamp_ns)
        add_frameset(self, stamp_ns, *others)

    monkeypatch.setattr(SelfCalibration, "add_frameset", noting)
    source = open_source(fast_walk)
    odometry, known = Odometry(source.rig), {}
    assert source.truth is not None
    begin_ns = int(load_trajectory(source.truth).stamps_ns[0]) + 2_000_000_000
    for measurement in (each for each in source if each.stamp_ns >= begin_ns):
        estimate = odometry.process(measurement)
        if estimate is not None:
            frontend = odometry._frontend
            assert isinstance(frontend, VisualFrontend)
            known[estimate.stamp_ns] = frontend.are_velocities_known
    stamps = list(known)
    assert not any(known[stamp] for stamp in stamps[:2])
    assert all(known[stamp] for stamp in stamps[4:])
    assert calibrated
    assert not calibrated & {stamp for stamp, is_known in known.items() if not is_known}


def test_window_of_compensated_views_does_not_replace_the_inertial_state(
    fast_walk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It does with the same images of cameras whose lines are said to be exposed at once."""
    replaced: list[InertialState] = []
    monkeypatch.setattr(SmootherEstimator, "use_inertial_state", lambda _, known: replaced.append(known))
    rig = open_source(fast_walk).rig
    wrong = draw(rig, CalibrationErrorSizes.of_level(2, ["left-right-rotation"]), seed=1).written_rig
    at_once = wrong.with_cameras(lambda camera: replace(camera, line_time_us=0.0))
    for used, is_replaced in ((wrong, False), (at_once, True)):
        replaced.clear()
        odometry = Odometry(used)
        for measurement in open_source(fast_walk, used):
            odometry.process(measurement)
        odometry.finish()
        assert bool(replaced) == is_replaced


def test_images_that_are_read_out_until_the_next_ones_are_as_accurate(fast_walk: Path) -> None:
    """From motion on: without velocities as variables, IMU and vision contradict each other."""
    assert ate_m(fast_walk, open_source(fast_walk).rig, 1.5) < 0.0015


@pytest.mark.parametrize("has_imu", [True, False])
def test_several_pairs_with_rolling_shutters_go_on_over_keyframes(has_imu: bool, two_pairs: Path) -> None:
    rig = open_source(two_pairs).rig
    assert ate_m(two_pairs, rig if has_imu else rig.without_imu(), 1.0) < (0.002 if has_imu else 0.01)


def test_pairs_without_imu_do_not_contradict_each_other_and_doubt_no_exact_calibration(noisy_pairs: Path) -> None:
    """The velocities that the images show lag behind the motion, by the same for both pairs."""
    source = open_source(noisy_pairs, open_source(noisy_pairs).rig.without_imu())
    odometry = Odometry(source.rig)
    qualities = [each.vision for each in map(odometry.process, source) if each is not None]
    qualities += [each.vision for each in odometry.finish()]
    assert qualities.count(Quality.GOOD) >= 0.8 * len(qualities)
    kinds = {event.kind for event in odometry.take_events()}
    assert not kinds & {EventKind.EXTRINSICS_OFF, EventKind.CALIBRATION_CORRECTED}


def test_framesets_without_imu_are_calibrated_by_after_the_next_one(
    two_pairs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By points that are compensated with the velocities which the motion after them shows."""
    calibrated: list[tuple[int, int]] = []
    newest_ns = 0
    add_frameset = SelfCalibration.add_frameset

    def noting(self: SelfCalibration, stamp_ns: int, *others: Any) -> None:
        calibrated.append((stamp_ns, newest_ns))
        add_frameset(self, stamp_ns, *others)

    monkeypatch.setattr(SelfCalibration, "add_frameset", noting)
    source = open_source(two_pairs, open_source(two_pairs).rig.without_imu())
    odometry = Odometry(source.rig)
    for measurement in source:
        newest_ns = measurement.stamp_ns
        odometry.process(measurement)
    stamps = [stamp_ns for stamp_ns, _ in calibrated]
    assert len(stamps) > 20
    assert stamps == sorted(set(stamps))
    assert all(newest - stamp_ns == 100_000_000 for stamp_ns, newest in calibrated)


@pytest.mark.parametrize("has_imu", [True, False])
def test_a_pair_with_rolling_shutters_beside_a_single_camera_goes_on(has_imu: bool, two_pairs: Path) -> None:
    rig = open_source(two_pairs).rig.with_only(["cam0", "cam1", "cam2"])
    mixed = replace(rig, singles=(SingleCamera(replace(rig.singles[0].left, line_time_us=0.0)),))
    for each in (rig, mixed):
        assert ate_m(two_pairs, each if has_imu else each.without_imu(), 1.0) < 0.03


def test_a_single_camera_is_as_accurate_with_a_rolling_shutter() -> None:
    """From motion on, with landmarks whose distance is not known when they are seen first."""
    ates_m = []
    for line_time_us in (0.0, READOUT_US / 240):
        small = phone().with_cameras(half_size)
        rig = replace(small, singles=(SingleCamera(replace(small.cameras[0], line_time_us=line_time_us)),))
        walk = rendered_room(f"phone-{line_time_us:.0f}", rig, 6.0)
        ates_m.append(ate_m(walk, open_source(walk).rig, 1.0))
    assert ates_m[1] < 0.01
    assert ates_m[1] < 1.5 * ates_m[0]
