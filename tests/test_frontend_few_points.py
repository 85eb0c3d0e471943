"""What few points show of a predicted motion, as information, and how a walk through a blank bend uses it."""

import numpy as np
import pytest
from scipy.stats import chi2
from synthetic import seen_points, transform, two_pair_rig

from graphvio.arrays import Float
from graphvio.config.stages import MotionConfig
from graphvio.frontend.motion.few_points import fit_few_points
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.frontend.motion.refinement import refine
from graphvio.geometry import se3_exp, se3_log

RIG = two_pair_rig()
ARRAYS = RigArrays.of(RIG)
TRUTH = transform([0.02, -0.03, 0.05], [-0.06, 0.02, 0.01])  # cur_T_ref
SIGMA_PX, MAX_PX = 0.3, 3.0
HALVES = slice(0, 3), slice(3, 6)


def predicted(rng: np.random.Generator) -> Float:
    """Return a motion as an IMU predicts it: off by some millimetres and hundredths of a degree."""
    return np.asarray(se3_exp(rng.normal(size=6) * np.repeat([5e-4, 3e-3], 3)) @ TRUTH)


def few(number: int, per_pair: int, sigma_px: float = SIGMA_PX) -> tuple[Observations, Float]:
    rng = np.random.default_rng(number)
    return seen_points(RIG, TRUTH, per_pair, rng, sigma_px), predicted(rng)


def distance2(cur_T_ref: Float, covariance: Float) -> float:
    error = se3_log(cur_T_ref @ np.linalg.inv(TRUTH))
    return float(error @ np.linalg.solve(covariance, error))


@pytest.mark.parametrize("per_pair", [2, 5])
def test_fit_is_consistent(per_pair: int) -> None:
    fits = [fit_few_points(ARRAYS, *few(number, per_pair), SIGMA_PX, MAX_PX) for number in range(400)]
    nees = [distance2(fit.cur_T_ref, fit.covariance) for fit in fits if fit is not None]
    assert len(nees) > 390
    assert 4.5 < np.mean(nees) < 7.0  # of 6; the mean of 400 is known to 0.2
    assert np.mean(np.array(nees) > chi2.ppf(0.95, 6)) < 0.1


@pytest.mark.parametrize("count", [5, 20])
def test_fits_from_one_reference_are_consistent_together(count: int) -> None:
    """What they share, the error of the triangulated points, does not become less by their number."""
    nees = []
    for number in range(100):
        rng = np.random.default_rng(number)
        seen, off, own, fits = seen_points(RIG, np.eye(4), 3, rng, SIGMA_PX), [], [], []
        for _ in range(count):
            noise = SIGMA_PX / ARRAYS.focal_px[seen.pair]
            of_now = seen_points(RIG, np.eye(4), 3, np.random.default_rng(number))  # the same points without noise
            left = of_now.left + noise[:, :1] * rng.standard_normal(seen.left.shape)
            right = of_now.right + noise[:, 1:] * rng.standard_normal(seen.right.shape)
            fit = fit_few_points(ARRAYS, seen._replace(left=left, right=right), np.eye(4), SIGMA_PX, MAX_PX)
            assert fit is not None
            fits.append(fit)
            off.append(se3_log(fit.cur_T_ref))
            own.append(np.linalg.inv(fit.covariance - fit.shared_covariance))
        covariance = np.linalg.inv(np.sum(own, axis=0))
        mean = covariance @ np.einsum("nij,nj->i", own, off)
        nees.append(mean @ np.linalg.solve(covariance + fits[0].shared_covariance, mean))
    assert 3.0 < np.mean(nees) < 9.0  # of 6; without the shared part, 50 for 20 of them


def test_fit_of_many_points_is_the_refinement() -> None:
    seen, start = few(1, 100)
    fit, refined = fit_few_points(ARRAYS, seen, start, SIGMA_PX, MAX_PX), refine(ARRAYS, seen, start, MotionConfig())
    assert fit is not None
    between = se3_log(fit.cur_T_ref @ np.linalg.inv(refined.cur_T_ref))
    assert between @ np.linalg.solve(refined.covariance, between) < 1.0  # a fraction of its noise, of 6 dimensions


def test_fit_knows_little_where_points_show_little() -> None:
    """Three points of one view leave some directions open."""
    seen, start = few(2, 3)
    near = seen.of_rows(seen.pair == 0)
    fit = fit_few_points(ARRAYS, near, start, SIGMA_PX, MAX_PX)
    assert fit is not None
    far = near._replace(
        points=near.points * np.array([1.0, 1.0, 1e-9]), covariances=1e-18 * near.covariances,
        left=near.points[:, :2], has_right=np.zeros(len(near.pair), dtype=bool),
    )  # fmt: skip
    nothing = fit_few_points(ARRAYS, far, np.eye(4), SIGMA_PX, MAX_PX)
    assert nothing is not None
    rotation, translation = (np.sqrt(np.linalg.eigvalsh(nothing.covariance[part, part])) for part in HALVES)
    assert rotation[-1] < 0.1
    assert translation[0] > 5.0  # what the IMU predicts is not information of the points


@pytest.mark.parametrize("number", range(5))
def test_fit_leaves_out_a_wrong_point(number: int) -> None:
    seen, start = few(10 + number, 4)
    wrong = seen.left.copy()
    wrong[2] += 2.5 / ARRAYS.focal_px[0, 0]  # 2.5 px: less than the largest error that is tried
    fit = fit_few_points(ARRAYS, seen._replace(left=wrong), start, SIGMA_PX, MAX_PX)
    assert fit is not None
    assert not fit.inlier[2]
    assert fit.inlier.sum() >= 6
    assert distance2(fit.cur_T_ref, fit.covariance) < chi2.ppf(0.999, 6)


def test_fit_by_noisier_points_knows_less() -> None:
    (quiet, start), (loud, _) = few(3, 6), few(3, 6, 3.0 * SIGMA_PX)
    by_quiet, by_loud = (fit_few_points(ARRAYS, seen, start, SIGMA_PX, 10.0) for seen in (quiet, loud))
    assert by_quiet is not None
    assert by_loud is not None
    assert np.trace(by_loud.covariance) > 2.0 * np.trace(by_quiet.covariance)


def test_fit_of_two_points_is_none() -> None:
    seen, start = few(4, 1)
    assert fit_few_points(ARRAYS, seen, start, SIGMA_PX, MAX_PX) is None


def test_fit_of_points_that_fit_nothing_is_none() -> None:
    seen, start = few(5, 3)
    assert fit_few_points(ARRAYS, seen._replace(left=seen.left + 0.5), start, SIGMA_PX, MAX_PX) is None


def test_fit_ignores_points_behind_a_camera_and_missing_right_images() -> None:
    seen, start = few(6, 5)
    points = seen.points.copy()
    points[0, 2] = 50.0  # 2 cm in front of the reference: behind the camera now
    has_right = seen.has_right.copy()
    has_right[1:3] = False
    right = np.where(has_right[:, None], seen.right, np.nan)
    fit = fit_few_points(
        ARRAYS, seen._replace(points=points, has_right=has_right, right=right), start, SIGMA_PX, MAX_PX
    )
    assert fit is not None
    assert not fit.inlier[0]
    assert fit.inlier[1:3].any()
    assert np.isfinite(fit.covariance).all()
    assert distance2(fit.cur_T_ref, fit.covariance) < chi2.ppf(0.999, 6)
