"""Rolling shutters: rendered line by line, compensated in the front-end, and what that is worth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import half_size, half_size_rig, small_rig
from rendered import rendered_once

from graphvio import Odometry, Rig, RigError, Trajectory, load_trajectory, open_source
from graphvio.arrays import Float
from graphvio.backend.inertial import ImuBuffer
from graphvio.config import Config
from graphvio.evaluation import evaluate
from graphvio.frontend.depth.stereo import triangulate
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.tracking.rolling_shutter import ReadoutMotion, as_at_stamp, pixels_at_lines, pixels_at_stamp
from graphvio.geometry import se3, se3_inverse, so3_exp
from graphvio.measurements.sensors import FrameSet, ImuSample
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Camera, SingleCamera
from graphvio.simulation import Simulator, build_scene, write_recording
from graphvio.simulation.named_rigs import stereo

DURATION_S, READOUT_US = 3.0, 20e3
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


def test_readout_motion_of_a_rate_that_changes() -> None:
    buffer = ImuBuffer(100.0)
    for stamp_ns in range(0, 60_000_000, 5_000_000):
        rate = MOTION.angular_velocity + 0.1 + 1e-9 * (stamp_ns - 12_000_000) * MOTION.angular_acceleration
        buffer.add(ImuSample(stamp_ns, rate, np.array([0.0, 0.0, 9.81])))
    interval = buffer.interval(12_000_000, 32_000_000)
    assert interval is not None
    found = ReadoutMotion.accelerated(interval, np.full(3, 0.1), MOTION.velocity, MOTION.acceleration)
    np.testing.assert_allclose(found.angular_velocity, MOTION.angular_velocity, atol=1e-9)
    np.testing.assert_allclose(found.angular_acceleration, MOTION.angular_acceleration, atol=1e-6)


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


def test_line_times_that_make_no_sense_are_refused() -> None:
    rig = small_rig(1)
    with pytest.raises(RigError, match=r"camera cam0: line_time_us is 41000\.0; it must be in microseconds"):
        rig.with_cameras(lambda camera: replace(camera, line_time_us=41e3))
    with pytest.raises(RigError, match=r"read their lines out in 0\.0 and 19\.6 ms; a pair needs the same"):
        replace(rig.pairs[0], right=rolling(rig.pairs[0].right))


@pytest.fixture(scope="module")
def walk() -> Path:
    def write(folder: Path) -> None:
        rig = stereo().with_cameras(half_size).with_cameras(rolling)
        write_recording(Simulator(build_scene("room", DURATION_S), rig, 1), folder)

    return rendered_once("room-rolling", write, "320x240", DURATION_S)


def ate_m(walk: Path, rig: Rig) -> float:
    source = open_source(walk, rig)
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
    assert ate_m(walk, rig.without_imu()) < 0.01  # by constant velocity
    assert ate_m(walk, rig.with_cameras(lambda camera: replace(camera, line_time_us=0.0))) > 5.0 * known
