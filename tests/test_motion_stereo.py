"""Depth of a single camera's points from motion, on synthetic truth."""

import numpy as np
import pytest
from synthetic import CAM_AXES, random_transform, transform

from graphvio.arrays import Float
from graphvio.frontend.depth.motion_stereo import PRIOR_INVERSE_DEPTH, FirstSights, MotionHistory
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse

SIGMA_PX, FOCAL_PX = 0.3, 400.0
BODY_T_CAM = transform([0.0, 0.0, 0.0], [0.1, -0.2, 0.05])
BODY_T_CAM[:3, :3] = CAM_AXES


def seen(points_world: Float, world_T_body: Float, rng: np.random.Generator, noise: float = 1.0) -> tuple[Float, Float]:
    """Normalised coordinates (N, 2) with pixel noise, and true points (N, 3) ``[x, y, 1/Z]``."""
    cam_T_world = se3_inverse(world_T_body @ BODY_T_CAM)
    points = points_world @ cam_T_world[:3, :3].T + cam_T_world[:3, 3]
    exact = points[:, :2] / points[:, 2:]
    rays = exact + noise * SIGMA_PX / FOCAL_PX * rng.standard_normal(exact.shape)
    return rays, np.column_stack([exact, 1.0 / points[:, 2]])


def scene(rng: np.random.Generator, n: int) -> Float:
    """Points (N, 3) 2 to 10 m in front of the first camera."""
    depth = rng.uniform(2.0, 10.0, n)
    in_cam = np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)) * depth[:, None], depth])
    return np.asarray(in_cam @ BODY_T_CAM[:3, :3].T + BODY_T_CAM[:3, 3])


def walk(rng: np.random.Generator, steps: int, length_m: float = 0.15) -> list[Float]:
    """Poses ``world_T_body`` (4, 4)."""
    poses = [np.eye(4)]
    for _ in range(steps):
        poses.append(poses[-1] @ random_transform(rng, 0.02, length_m))
    return poses


def history_of(poses: list[Float], sigma: float, rng: np.random.Generator) -> MotionHistory:
    """Motions with noise, as the front-end adds them."""
    history, covariance = MotionHistory(), sigma**2 * np.eye(6)
    for k in range(1, len(poses)):
        exact = se3_inverse(poses[k]) @ poses[k - 1]
        history.advance(k - 1, k, se3_exp(sigma * rng.standard_normal(6)) @ exact, covariance)
    return history


def test_motion_history_chains_motions_and_their_covariances() -> None:
    rng = np.random.default_rng(1)
    poses, history, steps = walk(rng, 3), MotionHistory(), []
    for k in range(1, 4):
        steps.append(se3_inverse(poses[k]) @ poses[k - 1])
        history.advance(k - 1, k, steps[-1], k * 1e-6 * np.eye(6))
    since = history.since(0)
    assert since is not None
    assert since.keyframes == 3
    np.testing.assert_allclose(since.cur_T_then, se3_inverse(poses[3]) @ poses[0], atol=1e-12)
    expected, onward = np.zeros((6, 6)), np.eye(4)
    for k in (3, 2, 1):
        adjoint = se3_adjoint(np.ascontiguousarray(onward))
        expected += adjoint @ (k * 1e-6 * np.eye(6)) @ adjoint.T
        onward = onward @ steps[k - 1]
    np.testing.assert_allclose(since.covariance, expected, atol=1e-15)


def test_motion_history_after_a_break_knows_nothing_of_before() -> None:
    history = MotionHistory()
    history.advance(0, 1, np.eye(4), np.eye(6))
    history.advance(5, 6, np.eye(4), np.eye(6))
    assert history.since(0) is None
    assert history.since(5) is not None


def test_locate_without_baseline_returns_the_prior() -> None:
    rng = np.random.default_rng(2)
    rays, _ = seen(scene(rng, 20), np.eye(4), rng)
    history = MotionHistory()
    history.restart(0)
    points, covariances = FirstSights().locate(np.arange(20), rays, history, BODY_T_CAM, FOCAL_PX, SIGMA_PX)
    np.testing.assert_array_equal(points[:, :2], rays)
    np.testing.assert_array_equal(points[:, 2], PRIOR_INVERSE_DEPTH)
    assert (SIGMA_PX * np.sqrt(covariances[:, 2, 2]) > 5.0).all()


def test_locate_with_exact_measurements_returns_exact_depths() -> None:
    rng = np.random.default_rng(3)
    world, poses = scene(rng, 50), walk(rng, 1, 0.4)
    first, history, ids = FirstSights(), MotionHistory(), np.arange(50)
    history.restart(0)
    first.locate(ids, seen(world, poses[0], rng, 0.0)[0], history, BODY_T_CAM, FOCAL_PX, SIGMA_PX)
    history.advance(0, 1, se3_inverse(poses[1]) @ poses[0], 1e-12 * np.eye(6))
    rays, true = seen(world, poses[1], rng, 0.0)
    points, _ = first.locate(ids, rays, history, BODY_T_CAM, FOCAL_PX, SIGMA_PX)
    np.testing.assert_allclose(points[:, 2], true[:, 2], atol=1e-4)  # the prior is wide


@pytest.mark.parametrize("steps", [2, 6])
def test_locate_has_a_covariance_that_the_errors_bear_out(steps: int) -> None:
    """Squared errors over their covariance, of pixel noise only."""
    squared = []
    for seed in range(40):
        rng = np.random.default_rng([7, seed])
        world, poses = scene(rng, 60), walk(rng, steps)
        first, history, ids = FirstSights(), MotionHistory(), np.arange(60)
        history.restart(0)
        first.locate(ids, seen(world, poses[0], rng)[0], history, BODY_T_CAM, FOCAL_PX, SIGMA_PX)
        history = history_of(poses, 1e-9, rng)
        rays, true = seen(world, poses[-1], rng)
        points, covariances = first.locate(ids, rays, history, BODY_T_CAM, FOCAL_PX, SIGMA_PX)
        errors = points - true
        squared.append(np.einsum("ni,nij,nj->n", errors, np.linalg.inv(SIGMA_PX**2 * covariances), errors))
    mean = float(np.mean(np.concatenate(squared))) / 3.0
    # What a track drifts from keyframe to keyframe is in the covariance, and not in these pixels.
    assert 0.6 < mean < 1.1


def test_locate_of_what_does_not_fit_the_motion_returns_the_prior() -> None:
    rng = np.random.default_rng(9)
    world, poses = scene(rng, 30), walk(rng, 2, 0.3)
    first, ids = FirstSights(), np.arange(30)
    history = MotionHistory()
    history.restart(0)
    first.locate(ids, seen(world, poses[0], rng)[0], history, BODY_T_CAM, FOCAL_PX, SIGMA_PX)
    history = history_of(poses, 1e-6, rng)
    rays, _ = seen(world, poses[2], rng)
    rays[4] += 0.1  # 40 pixels off
    points, covariances = first.locate(ids, rays, history, BODY_T_CAM, FOCAL_PX, SIGMA_PX)
    known = SIGMA_PX * np.sqrt(covariances[:, 2, 2]) < 0.3 * points[:, 2]
    assert not known[4]
    assert points[4, 2] == PRIOR_INVERSE_DEPTH
    assert known[np.arange(30) != 4].mean() > 0.8


def test_locate_after_a_motion_whose_covariance_is_not_positive_returns_the_prior() -> None:
    """Rounding may make it so where a motion is hardly known; variances of depths must not be negative for it."""
    rng = np.random.default_rng(10)
    world, poses = scene(rng, 30), walk(rng, 1, 0.3)
    first, history, ids = FirstSights(), MotionHistory(), np.arange(30)
    history.restart(0)
    first.locate(ids, seen(world, poses[0], rng)[0], history, BODY_T_CAM, FOCAL_PX, SIGMA_PX)
    history.advance(0, 1, se3_inverse(poses[1]) @ poses[0], -0.1 * np.eye(6))
    points, covariances = first.locate(ids, seen(world, poses[1], rng)[0], history, BODY_T_CAM, FOCAL_PX, SIGMA_PX)
    assert (covariances[:, 2, 2] > 0.0).all()
    assert (points[:, 2] == PRIOR_INVERSE_DEPTH).all()


def test_locate_of_new_tracks_returns_the_prior() -> None:
    rng = np.random.default_rng(10)
    world, poses = scene(rng, 20), walk(rng, 2, 0.3)
    first, history = FirstSights(), MotionHistory()
    history.restart(0)
    old, every = np.arange(10), np.arange(20)
    first.locate(old, seen(world[:10], poses[0], rng)[0], history, BODY_T_CAM, FOCAL_PX, SIGMA_PX)
    history.advance(0, 1, se3_inverse(poses[1]) @ poses[0], 1e-10 * np.eye(6))
    points, _ = first.locate(every, seen(world, poses[1], rng)[0], history, BODY_T_CAM, FOCAL_PX, SIGMA_PX)
    assert (points[10:, 2] == PRIOR_INVERSE_DEPTH).all()
    history.advance(1, 2, se3_inverse(poses[2]) @ poses[1], 1e-10 * np.eye(6))
    rays, true = seen(world, poses[2], rng)
    points, covariances = first.locate(every, rays, history, BODY_T_CAM, FOCAL_PX, SIGMA_PX)
    errors = (points - true)[:, 2] / (SIGMA_PX * np.sqrt(covariances[:, 2, 2]))
    assert np.abs(errors).max() < 4.0
