"""The nav frame where the cameras' attitude in body is corrected: body turns, and the path does not bend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from calibration_walks import recorded

from graphvio import Odometry, open_source
from graphvio.arrays import Float
from graphvio.backend.states import RigState, StateCovariance
from graphvio.evaluation import evaluate
from graphvio.geometry import se3, se3_adjoint, se3_inverse, so3_exp, so3_log
from graphvio.measurements.events import EventKind
from graphvio.odometry.nav_frame import NavFrame
from graphvio.self_calibration.consider import ConsiderCovariance
from graphvio.self_calibration.window import Keyframe
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.slam import FrontEnd
from graphvio.slam.keyframe import Keyframe as SlamKeyframe
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

SECONDS = 12.0
OLD_R_NEW = so3_exp(np.array([0.02, -0.01, 0.03]))
POSE = se3(so3_exp(np.array([0.3, -0.2, 1.1])), np.array([4.0, -2.0, 1.0]))
LATER = se3(so3_exp(np.array([-0.1, 0.4, 2.0])), np.array([5.0, -1.0, 1.2]))


def state_at(pose: Float) -> RigState:
    return RigState(pose, np.array([1.0, 0.2, -0.1]), np.zeros(3), np.zeros(3))


def test_nav_frame_turned_keeps_position_and_what_body_feels() -> None:
    frame = NavFrame()
    frame.turn(5, POSE, OLD_R_NEW)
    before, after = state_at(POSE), frame.state(state_at(POSE))
    np.testing.assert_allclose(after.nav_T_body[:3, 3], POSE[:3, 3], atol=1e-12)
    np.testing.assert_allclose(after.nav_T_body[:3, :3], POSE[:3, :3] @ OLD_R_NEW, atol=1e-12)
    for old, new in ((before.velocity_nav, after.velocity_nav), (before.gravity_nav, after.gravity_nav)):
        np.testing.assert_allclose(after.nav_T_body[:3, :3].T @ new, POSE[:3, :3].T @ old, atol=1e-12)


def test_nav_frame_turned_keeps_the_attitude_of_the_cameras() -> None:
    frame, old_R_cam = NavFrame(), so3_exp(np.array([0.0, 1.5, 0.2]))
    frame.turn(5, POSE, OLD_R_NEW)
    new_R_cam = OLD_R_NEW.T @ old_R_cam
    nav_R_cam = frame.state(state_at(POSE)).nav_T_body[:3, :3] @ new_R_cam
    np.testing.assert_allclose(nav_R_cam, POSE[:3, :3] @ old_R_cam, atol=1e-12)


def test_nav_frame_turned_twice_keeps_motions_between_later_poses() -> None:
    frame = NavFrame()
    frame.turn(5, POSE, OLD_R_NEW)
    frame.turn(6, LATER, OLD_R_NEW.T)
    moved = [frame.state(state_at(pose)).nav_T_body for pose in (POSE, LATER)]
    np.testing.assert_allclose(se3_inverse(moved[0]) @ moved[1], se3_inverse(POSE) @ LATER, atol=1e-12)


def test_nav_frame_covariance_turned_with_the_velocity() -> None:
    frame = NavFrame()
    velocity = np.diag([1.0, 4.0, 9.0])
    covariance = StateCovariance(np.eye(6), velocity=velocity, gravity=None)
    assert frame.covariance(covariance) is covariance
    frame.turn(5, POSE, OLD_R_NEW)
    turned = frame.covariance(covariance)
    new, old = frame.state(state_at(POSE)).nav_T_body[:3, :3], POSE[:3, :3]
    assert turned.velocity is not None
    np.testing.assert_allclose(new.T @ turned.velocity @ new, old.T @ velocity @ old, atol=1e-12)
    assert turned.gravity is None
    assert turned.pose is covariance.pose


def test_nav_frame_poses_of_before_a_turn_stay() -> None:
    frame = NavFrame()
    assert frame.pose(4, POSE) is POSE
    frame.turn(5, POSE, OLD_R_NEW)
    assert frame.pose(4, POSE) is POSE
    np.testing.assert_array_equal(frame.pose(5, LATER), frame.state(state_at(LATER)).nav_T_body)


def test_consider_covariance_after_a_correction_of_the_pose_has_what_is_left() -> None:
    rng = np.random.default_rng(2)
    gain, change = 0.1 * rng.normal(size=(6, 6)), 0.01 * rng.normal(size=6)
    consider = ConsiderCovariance(6)
    first, newest = Keyframe(0, np.eye(4), {}), Keyframe(1, POSE, {})
    consider.extend([first, newest], np.array([np.zeros((6, 6)), gain]))
    # The calibration is known now, and the pose as wrong as before.
    consider.set_calibration_in_force(change, np.zeros((6, 6)))
    consider.correct(gain @ change)
    np.testing.assert_allclose(consider.at(POSE), 0.0, atol=1e-30)
    consider.correct(np.array([1e-6, 0.0, 0.0, 0.0, 0.0, 0.0]))  # so small that there is no term of second order
    np.testing.assert_allclose(consider.at(POSE)[0, 0], 1e-12)
    carried = se3_adjoint(se3_inverse(LATER) @ POSE)[:, 0]
    np.testing.assert_allclose(consider.at(LATER), 1e-12 * np.outer(carried, carried), atol=1e-20)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("nav_frame") / "walk", SECONDS)


@pytest.mark.parametrize(("seed", "max_error_m"), [(0, 0.0036), (1, 0.0055)])
def test_path_with_a_wrong_attitude_of_the_cameras_in_body_does_not_bend(
    seed: int, max_error_m: float, walk: Path
) -> None:
    exact = open_source(walk)
    assert exact.truth is not None
    truth = load_trajectory(exact.truth)
    written = draw(exact.rig, CalibrationErrorSizes.of_level(3, ["cameras-in-body"]), seed).written_rig
    odometry = Odometry(written)
    front_end, keyframes = FrontEnd(odometry), list[SlamKeyframe]()
    front_end.on_keyframe(keyframes.append)
    estimates = [each for each in map(odometry.process, open_source(walk, written)) if each is not None]
    estimates += odometry.finish()
    refined = odometry.refined_rig
    assert refined is not None
    corrected = so3_log(written.pairs[0].left.body_T_cam[:3, :3] @ refined.pairs[0].left.body_T_cam[:3, :3].T)
    assert np.linalg.norm(corrected) > np.deg2rad(0.5)
    kinds = {event.kind for event in odometry.take_events()}
    assert not kinds & {EventKind.VISION_GATED, EventKind.IMU_NOT_COVERING}
    estimated = Trajectory(
        np.array([each.stamp_ns for each in estimates]), np.array([each.nav_T_body for each in estimates])
    )
    true = dict(zip(truth.stamps_ns.tolist(), truth.nav_T_body, strict=True))
    steps, true_steps = (
        np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        for poses in (estimated.nav_T_body, np.array([true[ns] for ns in estimated.stamps_ns.tolist()]))
    )
    np.testing.assert_allclose(steps, true_steps, atol=0.003)  # positions go on
    assert evaluate(estimated, truth).ate_position_m.rmse < max_error_m
    chain = [keyframes[0].odom_T_body]
    for each in keyframes[1:]:
        assert each.previous_T_body is not None
        chain.append(chain[-1] @ each.previous_T_body)
    chained = Trajectory(np.array([each.stamp_ns for each in keyframes]), np.array(chain))
    assert evaluate(chained, truth).ate_position_m.rmse < max_error_m
