"""The paper's equations in plain numpy, by hand and against the kernels that the odometry uses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from synthetic import random_transform, seen_points, transform, two_pair_rig

from graphvio.arrays import Float
from graphvio.config.stages import MotionConfig
from graphvio.frontend.motion.cost import camera_motions, robust_cost
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.frontend.motion.paper_method import PairPoints, best_pair, cost, global_cost, h, motion_of_pair, rho
from graphvio.frontend.motion.refinement import refine
from graphvio.frontend.motion.selection import best_pair_motion
from graphvio.frontend.motion.selection import global_cost as global_cost_of_kernel
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.rig import Rig, StereoPair

TRUTH = transform([0.02, -0.03, 0.05], [-0.06, 0.02, 0.01])  # cur_T_ref
STILL = np.eye(4)
A_PX = 1.5
CONFIG = MotionConfig(sigma_inflation=1.0, hypotheses=60)
PER_IMAGE = replace(CONFIG, residuals="per_image")


def rig_of(pairs: int) -> Rig:
    """A rig of up to three pairs, no two of which look the same way."""
    two = two_pair_rig()
    turned = transform([0.1, -0.2, 1.4], [0.02, -0.2, 0.1])
    left, right = (
        replace(camera, name=f"side_{camera.name}", body_T_cam=turned @ camera.body_T_cam)
        for camera in (two.pairs[0].left, two.pairs[0].right)
    )
    third = StereoPair("side", left, right)
    return Rig((*two.pairs, third)[:pairs], None, "synthetic")


def scene(rig: Rig, number: int) -> Observations:
    """Noisy points with outliers, a part of them without a right image."""
    rng = np.random.default_rng(number)
    seen = seen_points(rig, TRUTH, 40, rng, sigma_px=1.0, outlier_share=0.2)
    return seen._replace(has_right=rng.random(len(seen.pair)) < 0.7)


def points_of(rig: Rig, seen: Observations) -> list[PairPoints]:
    return [PairPoints.of(pair, seen.of_pair(j)) for j, pair in enumerate(rig.pairs)]


def motions_near_truth(number: int, count: int = 10) -> list[Float]:
    rng = np.random.default_rng(number)
    return [np.ascontiguousarray(TRUTH @ random_transform(rng, 0.01, 0.05)) for _ in range(count)]


def of_left(rig: Rig, pair: int, cur_T_ref: Float) -> Float:
    """The paper's P of a pair for a motion of the body."""
    left = rig.pairs[pair].left
    return np.asarray(left.cam_T_body @ cur_T_ref @ left.body_T_cam)


def of_body(rig: Rig, pair: int, P: Float) -> Float:
    left = rig.pairs[pair].left
    return np.ascontiguousarray(left.body_T_cam @ P @ left.cam_T_body)


# ------------------------------------------------------------------ the equations by hand


def test_motion_of_pair_moves_points_as_the_first_pair_sees_them_move() -> None:
    rng = np.random.default_rng(0)
    P_1, P_12 = random_transform(rng, 0.3, 0.5), random_transform(rng, 2.0, 0.4)
    X_1 = np.array([0.4, -0.2, 3.0, 1.0])
    np.testing.assert_allclose(motion_of_pair(P_1, P_12) @ (P_12 @ X_1), P_12 @ (P_1 @ X_1), atol=1e-12)
    back = motion_of_pair(motion_of_pair(P_1, P_12), se3_inverse(P_12))
    np.testing.assert_allclose(back, P_1, atol=1e-12)


def test_rho_takes_an_error_as_a_vector() -> None:
    np.testing.assert_allclose(rho(np.array([[3.0, 4.0], [0.0, 0.0]]), 1.5), [np.log(1.0 + 25.0 / 1.5**2), 0.0])
    np.testing.assert_allclose(h(np.array([2.0, 3.0, 4.0, 1.0])), [0.5, 0.75])


def test_cost_of_a_point_by_hand() -> None:
    P_s = transform([0.0, 0.0, 0.0], [-0.1, 0.0, 0.0])  # the right camera is 0.1 m to the right
    P = transform([0.0, 0.0, 0.0], [0.0, 0.0, -1.0])  # 1 m forward: points come nearer
    X = np.array([[0.2, 0.1, 1.0, 0.2]])  # 5 m away
    left, right = np.array([[1.0, 0.5]]) / 4.0, np.array([[0.9, 0.5]]) / 4.0
    exact = PairPoints(X, left, right, P_s, (400.0, 500.0))
    assert cost(P, exact, A_PX) == pytest.approx(0.0, abs=1e-20)
    off = exact._replace(x_left=left + np.array([3.0, 4.0]) / 400.0, x_right=right + np.array([0.0, 1.0]) / 500.0)
    expected = np.log(1.0 + 25.0 / A_PX**2) + np.log(1.0 + 1.0 / A_PX**2)
    assert cost(P, off, A_PX) == pytest.approx(expected)
    assert cost(P, off._replace(x_right=np.full((1, 2), np.nan)), A_PX) == pytest.approx(np.log(1.0 + 25.0 / A_PX**2))
    turned = transform([0.0, np.pi, 0.0], [0.0, 0.0, 0.0])  # behind both cameras
    assert cost(turned, exact, A_PX) == pytest.approx(2.0 * np.log(1.0 + 1e6))


# ------------------------------------------------------------------ the kernels against the equations


@pytest.mark.parametrize("pairs", [1, 2, 3])
def test_camera_motions_are_eq_1(pairs: int) -> None:
    rig = rig_of(pairs)
    motions = camera_motions(TRUTH, RigArrays.of(rig))
    for j, pair in enumerate(rig.pairs):
        P_1j = pair.left.cam_T_body @ rig.pairs[0].left.body_T_cam
        np.testing.assert_allclose(motions[j, 0], motion_of_pair(motions[0, 0], P_1j), atol=1e-12)
        np.testing.assert_allclose(motions[j, 1], pair.right_T_left @ motions[j, 0], atol=1e-12)


@pytest.mark.parametrize("pairs", [1, 2, 3])
def test_robust_cost_of_one_pair_is_eq_2(pairs: int) -> None:
    rig = rig_of(pairs)
    arrays, seen = RigArrays.of(rig), scene(rig, pairs)
    points = points_of(rig, seen)
    for cur_T_ref in [STILL, *motions_near_truth(pairs)]:
        for j in range(pairs):
            found = robust_cost(cur_T_ref, arrays, seen, np.flatnonzero(seen.pair == j), A_PX)
            assert found == pytest.approx(cost(of_left(rig, j, cur_T_ref), points[j], A_PX), rel=1e-12)


@pytest.mark.parametrize("pairs", [1, 2, 3])
def test_global_cost_is_eq_3_of_any_pairs_motion(pairs: int) -> None:
    rig = rig_of(pairs)
    arrays, seen = RigArrays.of(rig), scene(rig, 10 + pairs)
    points = points_of(rig, seen)
    for cur_T_ref in [STILL, *motions_near_truth(10 + pairs)]:
        found = global_cost_of_kernel(arrays, seen, cur_T_ref, A_PX)
        for j in range(pairs):
            expected = global_cost(of_left(rig, j, cur_T_ref), j, points, arrays.body_T_left, A_PX)
            assert found == pytest.approx(expected, rel=1e-11)


def test_points_behind_a_camera_cost_as_much_in_both() -> None:
    rig = rig_of(2)
    seen = scene(rig, 20)
    backwards = transform([0.0, np.pi, 0.0], [0.0, 0.0, 0.0])
    sideways = transform([0.0, 0.0, 1.2], [0.3, 0.0, 0.0])
    for cur_T_ref in (backwards, sideways):
        expected = global_cost(of_left(rig, 0, cur_T_ref), 0, points_of(rig, seen), RigArrays.of(rig).body_T_left, A_PX)
        assert global_cost_of_kernel(RigArrays.of(rig), seen, cur_T_ref, A_PX) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("pairs", [1, 2, 3])
@pytest.mark.parametrize("sound", [0, 1, 2])
def test_best_pair_motion_is_that_of_eq_4(pairs: int, sound: int) -> None:
    """One pair sees the world; the others' points have random places."""
    rig, rng = rig_of(pairs), np.random.default_rng(30 + sound)
    arrays, sound = RigArrays.of(rig), min(sound, pairs - 1)
    seen = seen_points(rig, TRUTH, 40, rng, sigma_px=0.3)
    wrong = seen.pair != sound
    left, right = seen.left.copy(), seen.right.copy()
    left[wrong], right[wrong] = rng.uniform(-0.5, 0.5, (2, int(wrong.sum()), 2))
    seen = seen._replace(left=left, right=right)
    alone = [
        best_pair_motion(arrays, seen.of_pair(j), STILL, CONFIG, np.random.default_rng(j)).cur_T_ref
        for j in range(pairs)
    ]
    motions = [of_left(rig, j, cur_T_ref) for j, cur_T_ref in enumerate(alone)]
    points = points_of(rig, seen)
    assert best_pair(motions, points, arrays.body_T_left, A_PX) == sound
    costs = [global_cost_of_kernel(arrays, seen, cur_T_ref, A_PX) for cur_T_ref in alone]
    assert int(np.argmin(costs)) == sound
    best = best_pair_motion(arrays, seen, STILL, CONFIG, np.random.default_rng(0))
    np.testing.assert_allclose(best.cur_T_ref, alone[sound], atol=1e-3)


# ------------------------------------------------------------------ the refinement by eq. (2)


@pytest.mark.parametrize("pairs", [1, 2, 3])
@pytest.mark.parametrize("number", [40, 41])
def test_refine_per_image_is_the_minimum_of_eq_2_and_3(pairs: int, number: int) -> None:
    rig = rig_of(pairs)
    arrays, seen = RigArrays.of(rig), scene(rig, number)
    points = points_of(rig, seen)
    start = motions_near_truth(number, 1)[0]
    refined = refine(arrays, seen, start, PER_IMAGE)
    sigmas = np.sqrt(np.diag(refined.covariance))

    def cost_at(step: Float) -> float:
        cur_T_ref = se3_exp(sigmas * step) @ refined.cur_T_ref
        return global_cost(of_left(rig, 0, cur_T_ref), 0, points, arrays.body_T_left, A_PX)

    lowest = minimize(cost_at, np.full(6, 0.3), method="BFGS", options={"gtol": 1e-6})
    assert cost_at(np.zeros(6)) == pytest.approx(lowest.fun, rel=1e-8)
    np.testing.assert_allclose(lowest.x, 0.0, atol=2e-3)  # sigmas


def test_refine_per_image_leaves_out_points_that_are_known_to_be_outliers() -> None:
    rig = rig_of(2)
    arrays, seen = RigArrays.of(rig), scene(rig, 50)
    known = np.arange(len(seen.pair)) % 3 > 0
    part, whole = (
        refine(arrays, of, TRUTH, PER_IMAGE, known_inlier=rows)
        for of, rows in ((seen.of_rows(known), np.ones(int(known.sum()), dtype=bool)), (seen, known))
    )
    np.testing.assert_allclose(whole.cur_T_ref, part.cur_T_ref, atol=1e-9)
    np.testing.assert_array_equal(whole.inlier, known)


def test_refine_per_image_covariance_is_consistent() -> None:
    rig, nees = rig_of(2), []
    arrays = RigArrays.of(rig)
    for number in range(200):
        seen = seen_points(rig, TRUTH, 50, np.random.default_rng(1000 + number), sigma_px=PER_IMAGE.pixel_sigma_px)
        refined = refine(arrays, seen, TRUTH, PER_IMAGE)
        error = se3_log(refined.cur_T_ref @ np.linalg.inv(TRUTH))
        nees.append(error @ np.linalg.solve(refined.covariance, error))
    assert 4.5 < np.mean(nees) < 8.0  # of 6


def test_best_pair_motion_per_image_is_a_minimum_of_eq_2() -> None:
    rig = rig_of(2)
    arrays, seen = RigArrays.of(rig), scene(rig, 60)
    best = best_pair_motion(arrays, seen, STILL, PER_IMAGE, np.random.default_rng(0))
    motions = [of_left(rig, j, best.cur_T_ref) for j in range(2)]
    steps = 0.05 * np.sqrt(np.diag(best.covariance)) * np.vstack([np.eye(6), -np.eye(6)])

    def rises(j: int) -> bool:
        """Whether eq. (2) of pair j is greater on all sides."""
        points = points_of(rig, seen)[j]
        lowest = cost(motions[j], points, A_PX)
        around = (of_left(rig, j, se3_exp(step) @ best.cur_T_ref) for step in steps)
        return all(cost(P, points, A_PX) > lowest for P in around)

    assert rises(0) != rises(1)
