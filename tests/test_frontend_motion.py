from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2
from synthetic import random_transform, seen_points, transform, two_pair_rig

from graphvio.arrays import AnyArray, Float, Int
from graphvio.config.stages import MotionConfig
from graphvio.frontend.motion.cost import camera_motions, robust_cost
from graphvio.frontend.motion.noise import noise_by_pair
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.frontend.motion.paper_method import PairPoints, cost
from graphvio.frontend.motion.ransac import hypothesise, preempt, search
from graphvio.frontend.motion.refinement import explained, refine
from graphvio.frontend.motion.selection import best_pair_motion, global_cost, searched_and_refined
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.rig import Rig

RIG = two_pair_rig()
ARRAYS = RigArrays.of(RIG)
CONFIG = MotionConfig(sigma_inflation=1.0)
TRUTH = transform([0.02, -0.03, 0.05], [-0.06, 0.02, 0.01])  # cur_T_ref
STILL = np.eye(4)


def seed(number: int = 0) -> np.random.Generator:
    return np.random.default_rng(number)


def take(seen: Observations, rows: Int) -> Observations:
    columns: list[AnyArray] = [column[rows] for column in seen]
    return Observations(*columns)


# ------------------------------------------------------------------ the cost, eq. (1) to (3)


def test_global_cost_of_one_and_two_points_by_hand() -> None:
    focal, a = RIG.pairs[0].left.focal_px, 1.5
    seen = seen_points(RIG.with_pairs([0]), STILL, 2, seed())
    one = take(seen, np.array([0]))
    arrays = RigArrays.of(RIG.with_pairs([0]))
    assert global_cost(arrays, one, STILL, a) == pytest.approx(0.0, abs=1e-12)
    shifted = one._replace(left=one.left + np.array([3.0, 4.0]) / focal)
    assert global_cost(arrays, shifted, STILL, a) == pytest.approx(np.log(1.0 + 25.0 / a**2))  # a 2-vector, robustified
    alone = shifted._replace(has_right=np.array([False]), right=np.full((1, 2), np.nan))
    assert global_cost(arrays, alone, STILL, a) == pytest.approx(np.log(1.0 + 25.0 / a**2))
    two = seen._replace(
        left=seen.left + np.array([[3.0, 4.0], [0.0, 0.0]]) / focal,
        right=seen.right + np.array([[0.0, 0.0], [0.0, 1.0]]) / RIG.pairs[0].right.focal_px,
    )
    expected = np.log(1.0 + 25.0 / a**2) + np.log(1.0 + 1.0 / a**2)
    assert global_cost(arrays, two, STILL, a) == pytest.approx(expected)
    assert robust_cost(STILL, arrays, two, np.array([1]), a) == pytest.approx(np.log(1.0 + 1.0 / a**2))


def test_global_cost_of_points_behind_the_camera_is_finite() -> None:
    seen = seen_points(RIG, STILL, 5, seed())
    backwards = transform([0.0, np.pi, 0.0], [0.0, 0.0, 0.0])
    assert global_cost(ARRAYS, seen, backwards, 1.5) == pytest.approx(20 * np.log(1.0 + 1e6))


# ------------------------------------------------------------------ hypotheses


def test_hypothesise_returns_motions_of_body() -> None:
    seen = seen_points(RIG, TRUTH, 60, seed(4))
    found, sources = hypothesise(ARRAYS, seen, 100, 0.3, seed())
    assert len(found) == len(sources)
    for pair in range(2):
        of_pair = sources == pair
        assert 90 < of_pair.sum() <= 100
        errors = np.abs(found[of_pair] - TRUTH).max(axis=(1, 2))
        assert np.mean(errors < 1e-6) > 0.9


def test_hypothesise_without_three_near_points_returns_none() -> None:
    seen = seen_points(RIG, TRUTH, 2, seed())
    assert hypothesise(ARRAYS, seen, 10, 0.3, seed())[0].shape == (0, 4, 4)
    far = seen_points(RIG, TRUTH, 30, seed())
    far = far._replace(points=far.points * [1.0, 1.0, 1e-4])
    assert hypothesise(ARRAYS, far, 10, 0.3, seed())[0].shape == (0, 4, 4)
    assert np.array_equal(preempt(ARRAYS, far, TRUTH[None], 100, 1.5, seed()), TRUTH)


def test_search_with_an_obstructed_pair_samples_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """One pair's right triple is enough."""
    sampled: list[int] = []

    def counted(*arguments: Any) -> tuple[Float, Int]:
        sampled.append(arguments[2])
        return hypothesise(*arguments)

    monkeypatch.setattr("graphvio.frontend.motion.ransac.hypothesise", counted)
    sound = seen_points(RIG, TRUTH, 60, seed(3), sigma_px=0.3)
    blocked = seen_points(RIG, TRUTH, 60, seed(4), sigma_px=0.3, outlier_share=1.0)
    seen = Observations(*(np.concatenate([a, b]) for a, b in zip(sound.of_pair(0), blocked.of_pair(1), strict=True)))
    best = search(ARRAYS, seen, STILL, CONFIG, seed())
    assert sum(sampled) <= 24  # of 500
    assert np.abs(best - TRUTH).max() < 0.02
    sampled.clear()
    search(ARRAYS, blocked, STILL, CONFIG, seed())
    assert sum(sampled) == 500


@pytest.mark.parametrize("chunk_points", [1, 10, 1000])
def test_preempt_keeps_the_best(chunk_points: int) -> None:
    seen = seen_points(RIG, TRUTH, 80, seed(5), sigma_px=0.2, outlier_share=0.2)
    wrong = [TRUTH @ random_transform(seed(10 + i), 0.1, 0.3) for i in range(50)]
    hypotheses = np.ascontiguousarray(np.array([*wrong[:31], TRUTH, *wrong[31:]]))
    assert np.array_equal(preempt(ARRAYS, seen, hypotheses, chunk_points, 1.5, seed()), TRUTH)


# ------------------------------------------------------------------ refinement


def eliminated_cost(seen: Observations, cur_T_ref: Float, config: MotionConfig) -> float:
    """The refinement's cost in plain numpy: of each point, the least that it costs anywhere, made robust."""
    total, sigma = 0.0, config.pixel_sigma_px

    def predict(j: int, point: Float) -> Float:
        left = ARRAYS.cam_T_body[j, 0] @ cur_T_ref @ ARRAYS.body_T_left[j] @ [point[0], point[1], 1.0, point[2]]
        right = RIG.pairs[j].right_T_left @ left
        focal = ARRAYS.focal_px[j]
        return np.concatenate([focal[0] * left[:2] / left[2], focal[1] * right[:2] / right[2]])

    for i, j in enumerate(seen.pair):
        rows = 4 if seen.has_right[i] else 2
        places = np.concatenate([ARRAYS.focal_px[j, 0] * seen.left[i], ARRAYS.focal_px[j, 1] * seen.right[i]])[:rows]
        root = np.linalg.inv(np.linalg.cholesky(seen.covariances[i]))
        point = seen.points[i]

        def misfit(p: Float) -> Float:
            """All that speaks against a place of the point, in sigmas: what both instants saw."""
            return np.concatenate([root @ (p - seen.points[i]), predict(j, p)[:rows] - places]) / sigma  # noqa: B023

        best = least_squares(misfit, point, x_scale=np.sqrt(np.diag(seen.covariances[i])), xtol=1e-12, ftol=1e-12)
        total += float(np.log1p(2.0 * best.cost / (config.cauchy_scale_px / sigma) ** 2))
    return total


def test_refine_finds_a_minimum_of_the_cost() -> None:
    seen = seen_points(RIG, TRUTH, 25, seed(6), sigma_px=0.3)
    seen = seen._replace(has_right=seed(7).random(50) < 0.8)
    everyone = np.ones(50, dtype=bool)  # known, so that both pairs count for the same
    refined = refine(ARRAYS, seen, TRUTH, CONFIG, known_inlier=everyone)
    lowest = eliminated_cost(seen, refined.cur_T_ref, CONFIG)
    steps = 0.3 * np.sqrt(np.diag(refined.covariance))
    for axis in range(6):
        costs = []
        for sign in (-1.0, 1.0):
            moved = se3_exp(sign * steps[axis] * np.eye(6)[axis]) @ refined.cur_T_ref
            costs.append(eliminated_cost(seen, np.ascontiguousarray(moved), CONFIG) - lowest)
        assert min(costs) > 0.0
        assert abs(costs[1] - costs[0]) < 0.2 * (costs[0] + costs[1])  # the gradient is much less than the curvature


@pytest.mark.parametrize("pairs", [[0], [1], [0, 1]])
def test_refine_without_noise_recovers_the_truth(pairs: list[int]) -> None:
    rig = RIG.with_pairs(pairs)
    seen = seen_points(rig, TRUTH, 60, seed(8))
    for start in (STILL, TRUTH @ transform([0.05, 0.05, -0.05], [0.1, -0.1, 0.1])):
        refined = refine(RigArrays.of(rig), seen, np.ascontiguousarray(start), replace(CONFIG, cauchy_scale_px=30.0))
        np.testing.assert_allclose(refined.cur_T_ref, TRUTH, atol=1e-6)
        assert refined.inlier.all()


@pytest.mark.parametrize("number", range(5))
def test_motion_among_outliers_recovers_the_truth(number: int) -> None:
    seen = seen_points(RIG, TRUTH, 80, seed(20 + number), sigma_px=0.3, outlier_share=0.3)
    far_away = transform([0.3, 0.2, -0.2], [0.5, 0.5, 0.5])  # a prediction of no use
    for solve in (searched_and_refined, best_pair_motion):
        refined = solve(ARRAYS, seen, far_away, CONFIG, seed())
        error = se3_log(refined.cur_T_ref @ np.linalg.inv(TRUTH))
        assert error @ np.linalg.solve(refined.covariance, error) < chi2.ppf(0.9999, 6)
        assert 0.6 < refined.inlier.mean() < 0.8


@pytest.mark.parametrize("number", range(5))
def test_refine_does_not_depend_on_the_initial_motion(number: int) -> None:
    """So that which triples are sampled does not show in a trajectory."""
    seen = seen_points(RIG, TRUTH, 80, seed(400 + number), sigma_px=0.3, outlier_share=0.3)
    steps = 0.01 * seed(500 + number).normal(size=(4, 6))
    ends = [refine(ARRAYS, seen, np.ascontiguousarray(se3_exp(step) @ TRUTH), CONFIG) for step in steps]
    for end in ends[1:]:
        np.testing.assert_allclose(end.cur_T_ref, ends[0].cur_T_ref, atol=1e-7)
        np.testing.assert_array_equal(end.inlier, ends[0].inlier)


@pytest.mark.parametrize("off_px", [2.0, 4.0, 8.0])
def test_refine_with_wrong_points_next_to_the_camera_is_unbiased(off_px: float) -> None:
    """Where images are sharp, an error of a few pixels is many times the noise, and must count as such."""
    seen, wrong = seen_points(RIG, TRUTH, 100, seed(30), sigma_px=0.04), 20
    points, left, right = seen.points.copy(), seen.left.copy(), seen.right.copy()
    for i in range(wrong):  # a third of a metre away, and all seen to one side of where they should be
        points[i] = [0.1 * (i % 5) - 0.2, 0.05 * (i // 5), 3.0]
        for motion, image, focal_px in zip(
            camera_motions(TRUTH, ARRAYS)[0], (left, right), ARRAYS.focal_px[0], strict=True
        ):
            x, y, z = (motion @ [*points[i, :2], 1.0, points[i, 2]])[:3]
            image[i] = [x / z + off_px / focal_px, y / z]
    refined = refine(ARRAYS, seen._replace(points=points, left=left, right=right), TRUTH, CONFIG)
    error = se3_log(refined.cur_T_ref @ np.linalg.inv(TRUTH))
    assert error @ np.linalg.solve(refined.covariance, error) < chi2.ppf(0.9999, 6)
    assert not refined.inlier[:wrong].any()
    assert refined.inlier[wrong:].mean() > 0.95


def test_refine_ignores_values_of_missing_right_images() -> None:
    seen = seen_points(RIG, TRUTH, 40, seed(31), sigma_px=0.3)
    seen = seen._replace(has_right=seed(32).random(80) < 0.6)
    none = np.where(seen.has_right[:, None], seen.right, 0.0)
    refined, again = (refine(ARRAYS, seen._replace(right=right), TRUTH, CONFIG) for right in (seen.right, none))
    np.testing.assert_allclose(refined.cur_T_ref, again.cur_T_ref, atol=1e-12)
    np.testing.assert_allclose(refined.covariance, again.covariance, rtol=1e-9)


def test_covariance_is_consistent() -> None:
    nees = []
    for number in range(300):
        seen = seen_points(RIG, TRUTH, 50, seed(1000 + number), sigma_px=CONFIG.pixel_sigma_px)
        refined = refine(ARRAYS, seen, TRUTH, CONFIG)
        error = se3_log(refined.cur_T_ref @ np.linalg.inv(TRUTH))
        nees.append(error @ np.linalg.solve(refined.covariance, error))
    assert 4.5 < np.mean(nees) < 8.0  # of 6; the mean of 300 is known to 0.2
    assert np.mean(np.array(nees) > chi2.ppf(0.95, 6)) < 0.12


def test_covariance_follows_the_noise_and_the_inflation() -> None:
    quiet, loud = (
        refine(ARRAYS, seen_points(RIG, TRUTH, 80, seed(9), sigma_px=s), TRUTH, CONFIG).covariance for s in (0.3, 0.6)
    )
    assert np.trace(loud[3:, 3:]) / np.trace(quiet[3:, 3:]) == pytest.approx(4.0, rel=0.4)
    seen = seen_points(RIG, TRUTH, 80, seed(9), sigma_px=0.3)
    plain = refine(ARRAYS, seen, TRUTH, CONFIG).covariance
    np.testing.assert_allclose(
        refine(ARRAYS, seen, TRUTH, replace(CONFIG, sigma_inflation=2.0)).covariance, 4.0 * plain
    )


def pairs_of_unlike_noise(number: int, sigmas_px: tuple[float, float]) -> Observations:
    parts = [
        seen_points(RIG, TRUTH, 60, seed(2 * number + j), sigma_px=sigma).of_pair(j)
        for j, sigma in enumerate(sigmas_px)
    ]
    return Observations(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def test_refine_weighs_a_noisier_pair_less() -> None:
    """Each pair has a noise of its own: the sharper one leads, and the covariance stays consistent."""
    squares: dict[str, list[float]] = {"both": [], "sharper": []}
    nees = []
    for number in range(200):
        seen = pairs_of_unlike_noise(number, (0.1, 0.4))
        refined, alone = (refine(ARRAYS, of, TRUTH, CONFIG) for of in (seen, seen.of_pair(0)))
        for name, motion in (("both", refined), ("sharper", alone)):
            squares[name].append(float(np.sum((se3_inverse(TRUTH) @ motion.cur_T_ref)[:3, 3] ** 2)))
        error = se3_log(refined.cur_T_ref @ np.linalg.inv(TRUTH))
        nees.append(error @ np.linalg.solve(refined.covariance, error))
    assert np.mean(squares["both"]) < 0.9 * np.mean(squares["sharper"])
    assert 4.5 < np.mean(nees) < 8.0


@pytest.mark.parametrize(("sigmas_px", "ratio"), [((0.2, 0.2), 1.0), ((0.15, 0.3), 4.0)])
def test_noise_by_pair_is_that_of_the_residuals(sigmas_px: tuple[float, float], ratio: float) -> None:
    seen, px = pairs_of_unlike_noise(3, sigmas_px), CONFIG.pixel_sigma_px
    _, errors_px = explained(ARRAYS, seen, TRUTH, CONFIG)
    noise = noise_by_pair(4.0 * (errors_px / px) ** 2, seen.has_right, seen.pair, 2, 100.0)
    assert noise[1] / noise[0] == pytest.approx(ratio, rel=0.4)
    one = np.zeros(len(seen.pair), dtype=np.int64)
    np.testing.assert_array_equal(noise_by_pair(errors_px, seen.has_right, one, 2, 100.0), 1.0)


def test_refine_of_far_points_leaves_translation_uncertain() -> None:
    seen = seen_points(RIG, STILL, 50, seed(10), sigma_px=0.3)
    far = seen._replace(points=seen.points * [1.0, 1.0, 0.0])  # at infinity: rotation only
    far = far._replace(left=far.points[:, :2].copy(), has_right=np.zeros(100, dtype=bool))
    refined = refine(ARRAYS, far, STILL, CONFIG)
    sigmas = np.sqrt(np.diag(refined.covariance))
    assert np.isfinite(refined.cur_T_ref).all()
    assert sigmas[:3].max() < 1e-3
    assert sigmas[3:].min() > 1.0


@pytest.mark.parametrize("number", [353, 369, 413, 1599, 1909, 2127, 2193, 2919])
def test_points_behind_a_camera_are_no_inliers_of_a_motion_that_fits_nothing(number: int) -> None:
    rng, rig = seed(number), RIG.with_pairs([0])
    count = int(rng.integers(8, 60))
    seen = seen_points(rig, TRUTH, count, rng)
    points = np.column_stack([seen.points[:, :2], rng.uniform(0.02, 3.0, count)])
    seen = seen._replace(
        points=points,
        covariances=seen.covariances * np.exp(rng.uniform(0.0, 12.0)),  # depths are hardly known
        left=seen.left + rng.normal(0.0, 0.05, seen.left.shape),
        has_right=rng.random(count) < rng.random(),
    )
    start = transform(rng.normal(0.0, 0.2, 3), rng.normal(0.0, 1.0, 3))
    refined = refine(RigArrays.of(rig), seen, start, CONFIG)
    assert np.isfinite(refined.errors_px[refined.inlier]).all()
    assert np.isfinite(refined.covariance).all()


# ------------------------------------------------------------------ one, two, and swapped pairs


def noisy(rig: Rig = RIG) -> Observations:
    return seen_points(rig, TRUTH, 60, seed(11), sigma_px=0.3, outlier_share=0.1)


def test_motion_of_one_pair_is_that_of_the_single_pair_algorithm() -> None:
    rig = RIG.with_pairs([1])
    arrays, seen = RigArrays.of(rig), noisy(rig)
    joint = searched_and_refined(arrays, seen, STILL, CONFIG, seed())
    best = best_pair_motion(arrays, seen, STILL, CONFIG, seed())
    assert np.array_equal(joint.cur_T_ref, best.cur_T_ref)
    assert np.array_equal(joint.covariance, best.covariance)
    assert np.array_equal(joint.inlier, best.inlier)
    left = rig.pairs[0].left
    motion = left.cam_T_body @ TRUTH @ left.body_T_cam
    assert global_cost(arrays, seen, TRUTH, 1.5) == pytest.approx(cost(motion, PairPoints.of(rig.pairs[0], seen), 1.5))


def test_joint_motion_with_a_pair_without_points_is_unchanged() -> None:
    alone = noisy(RIG.with_pairs([0]))
    one = searched_and_refined(RigArrays.of(RIG.with_pairs([0])), alone, STILL, CONFIG, seed())
    two = searched_and_refined(ARRAYS, alone, STILL, CONFIG, seed())
    np.testing.assert_allclose(one.cur_T_ref, two.cur_T_ref, rtol=0, atol=1e-12)
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=1e-9)


def test_refine_with_swapped_pairs_is_unchanged() -> None:
    seen = noisy()
    order = np.concatenate([np.flatnonzero(seen.pair == 1), np.flatnonzero(seen.pair == 0)])
    swapped = take(seen, order)._replace(pair=1 - seen.pair[order])
    arrays = RigArrays.of(RIG.with_pairs([1, 0]))
    assert global_cost(arrays, swapped, TRUTH, 1.5) == pytest.approx(global_cost(ARRAYS, seen, TRUTH, 1.5), rel=1e-12)
    first, second = refine(ARRAYS, seen, STILL, CONFIG), refine(arrays, swapped, STILL, CONFIG)
    np.testing.assert_allclose(second.cur_T_ref, first.cur_T_ref, atol=1e-9)
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=1e-6)
    assert np.array_equal(second.inlier, first.inlier[order])


@pytest.mark.parametrize("number", range(5))
def test_joint_motion_with_swapped_pairs_is_unchanged(number: int) -> None:
    """Other triples are sampled, from another initial motion; the result is the same to a hundredth of a sigma."""
    seen = seen_points(RIG, TRUTH, 60, seed(60 + number), sigma_px=0.3, outlier_share=0.2)
    order = np.concatenate([np.flatnonzero(seen.pair == 1), np.flatnonzero(seen.pair == 0)])
    swapped = take(seen, order)._replace(pair=1 - seen.pair[order])
    first = searched_and_refined(ARRAYS, seen, STILL, CONFIG, seed(number))
    second = searched_and_refined(RigArrays.of(RIG.with_pairs([1, 0])), swapped, STILL, CONFIG, seed(number))
    sigmas = np.sqrt(np.diag(first.covariance))
    assert np.abs(se3_log(second.cur_T_ref @ np.linalg.inv(first.cur_T_ref)) / sigmas).max() < 0.01
    scale = np.outer(sigmas, sigmas)
    np.testing.assert_allclose(second.covariance / scale, first.covariance / scale, atol=0.01)
    assert np.array_equal(second.inlier, first.inlier[order])


@pytest.mark.parametrize("solve", [searched_and_refined, best_pair_motion])
def test_motion_of_the_same_seed_is_the_same(solve: Callable[..., object]) -> None:
    seen = noisy()
    first, again = (solve(ARRAYS, seen, STILL, CONFIG, seed(5)) for _ in range(2))
    assert vars(first).keys() == vars(again).keys()
    for name, value in vars(first).items():
        assert np.array_equal(value, getattr(again, name)), name


def test_best_pair_motion_is_of_the_pair_with_sound_points() -> None:
    sound, broken = noisy(), noisy()
    places = seed(12).uniform(-0.5, 0.5, (2, 60, 2))
    for pair in range(2):
        wrong = sound.pair == pair
        left, right = sound.left.copy(), sound.right.copy()
        left[wrong], right[wrong] = places
        broken = sound._replace(left=left, right=right)
        best = best_pair_motion(ARRAYS, broken, STILL, CONFIG, seed())
        alone = searched_and_refined(ARRAYS, broken.of_pair(1 - pair), STILL, CONFIG, seed())
        assert np.abs(best.cur_T_ref - TRUTH).max() < 5e-3
        assert np.abs(best.cur_T_ref - alone.cur_T_ref).max() < 1e-3
        assert len(best.inlier) == 120
        assert best.inlier[~wrong].mean() > 0.8
        assert best.inlier[wrong].mean() < 0.1
        joint = searched_and_refined(ARRAYS, broken, STILL, CONFIG, seed())
        assert np.abs(joint.cur_T_ref - TRUTH).max() < 5e-3


def test_joint_motion_is_better_than_the_best_pairs() -> None:
    errors: dict[str, list[float]] = {"joint": [], "best": []}
    for number in range(40):
        seen = seen_points(RIG, TRUTH, 40, seed(500 + number), sigma_px=0.3)
        for name, solve in (("joint", searched_and_refined), ("best", best_pair_motion)):
            refined = solve(ARRAYS, seen, TRUTH, replace(CONFIG, hypotheses=20), seed())
            errors[name].append(float(np.linalg.norm((se3_inverse(TRUTH) @ refined.cur_T_ref)[:3, 3])))
    assert np.mean(errors["joint"]) < 0.7 * np.mean(errors["best"])


def test_explained_returns_the_inliers_of_refine() -> None:
    seen = noisy()
    refined = refine(ARRAYS, seen, TRUTH, CONFIG)
    again, errors_px = explained(ARRAYS, seen, refined.cur_T_ref, CONFIG)
    assert np.mean(again == refined.inlier) > 0.98
    assert 0.8 < again.mean() < 0.97
    np.testing.assert_allclose(errors_px[again], refined.errors_px[again], atol=1e-3)
