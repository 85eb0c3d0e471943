"""Calibration of more than two cameras at once."""

from functools import cache
from itertools import combinations

import numpy as np
import pytest
from hand_eye import LEFT2_T_LEFT1, Walk, motions, planar, turning
from monte_carlo import band
from scipy.stats import chi2

from graphvio.arrays import Float
from graphvio.calibration.nuisances import ScaleMode
from graphvio.calibration.pair_calibration import SYSTEMATIC_POSE_COVARIANCE, PairCalibration, calibrate_pair
from graphvio.calibration.segments import Segments, all_segments
from graphvio.calibration.several import CameraExtrinsics, pairwise, place_all
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log

LEFT3_T_LEFT1 = se3_exp(np.array([0.2, -1.5, 0.3, -0.2, 0.1, 0.3]))
TRUTH = np.array([np.eye(4), LEFT2_T_LEFT1, LEFT3_T_LEFT1])
NAMES = ("front", "back", "side")
PERIOD_NS = 100_000_000


def segments(seed: int, walk: Walk = turning) -> Segments:
    rng = np.random.default_rng(seed)
    extrinsics = [se3_inverse(np.ascontiguousarray(place)) for place in TRUTH]
    cameras = [motions(walk, place, rng, period_ns=PERIOD_NS) for place in extrinsics]
    return all_segments(cameras[0].stamps_ns.tolist(), [each.between for each in cameras])


def placed(made: Segments) -> CameraExtrinsics:
    def calibrate(one: int, other: int, mode: ScaleMode) -> PairCalibration:
        return calibrate_pair(made.of_both(one, other), scale_mode=mode)

    found, missing = pairwise(NAMES, calibrate, "auto")
    assert not missing
    return place_all(found, NAMES, made)


@cache
def found(seed: int) -> CameraExtrinsics:
    """From a sound walk."""
    return placed(segments(seed))


def covariance_between(extrinsics: CameraExtrinsics, one: int, other: int) -> Float:
    """Covariance (6, 6) of ``left_other_T_left_one``, tangent in the camera ``one``."""
    # X_ij = X_j X_i^-1: changes d_j of X_j and d_i of X_i, in left1, make Ad(X_i) (d_j - d_i).
    apart = np.zeros((6, len(extrinsics.covariance)))
    for camera, sign in ((other, 1.0), (one, -1.0)):
        if camera:
            apart[:, 6 * (camera - 1) : 6 * camera] += sign * np.eye(6)
    apart = se3_adjoint(np.ascontiguousarray(extrinsics.left_T_left1[one])) @ apart
    return np.asarray(apart @ extrinsics.covariance @ apart.T)


def error(extrinsics: CameraExtrinsics) -> Float:
    """(12,) tangents to the truth."""
    return np.concatenate([se3_log(se3_inverse(extrinsics.left_T_left1[j]) @ TRUTH[j]) for j in (1, 2)])


def test_place_all_errors_are_within_covariance_and_no_larger_than_pairwise() -> None:
    runs = 8
    squares, ratios = [], []
    distances: list[float] = []
    for seed in range(runs):
        extrinsics = found(seed)
        off = error(extrinsics)
        squares.append(off @ np.linalg.solve(extrinsics.covariance, off))
        ratios.append(
            np.trace(covariance_between(extrinsics, 1, 2) - SYSTEMATIC_POSE_COVARIANCE)
            / np.trace(extrinsics.pairwise[1, 2].covariance - SYSTEMATIC_POSE_COVARIANCE)
        )
        distances += extrinsics.distances.values()
        (loop,) = extrinsics.loops
        assert loop.statistic < chi2.isf(1e-4, 6)
        assert extrinsics.warnings == ()
    low, high = band(runs, 12)
    assert low < np.mean(squares) < high
    assert np.median(ratios) < 1.02
    assert max(distances) < chi2.isf(1e-3, 6)


def test_place_all_closes_loops_exactly() -> None:
    extrinsics = found(1)
    around = np.eye(4)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        around = extrinsics.left_T_left1[j] @ se3_inverse(extrinsics.left_T_left1[i]) @ around
    np.testing.assert_allclose(around, np.eye(4), atol=1e-12)


def test_covariance_between_matches_sampled_poses() -> None:
    extrinsics = found(2)
    root = np.linalg.cholesky(extrinsics.covariance)
    rng = np.random.default_rng(0)
    between = LEFT3_T_LEFT1 @ se3_inverse(LEFT2_T_LEFT1)
    errors = []
    for _ in range(2000):
        change = root @ rng.standard_normal(12)
        one, other = (TRUTH[j] @ se3_exp(np.ascontiguousarray(change[6 * j - 6 : 6 * j])) for j in (1, 2))
        errors.append(se3_log(se3_inverse(between) @ other @ se3_inverse(one)))
    covariance, sampled = covariance_between(extrinsics, 1, 2), np.cov(np.array(errors).T)
    np.testing.assert_allclose(np.diag(sampled), np.diag(covariance), rtol=0.15)


def test_place_all_camera_blind_at_times_is_consistent() -> None:
    made = segments(3)
    made.known[made.start_ns > np.median(made.start_ns), 2] = False
    made.motions[~made.known] = np.nan
    made.covariances[~made.known] = np.nan
    extrinsics = placed(made)
    off = error(extrinsics)
    assert off @ np.linalg.solve(extrinsics.covariance, off) < chi2.isf(1e-3, 12)
    sigmas = np.sqrt(np.diag(extrinsics.covariance))
    assert np.all(sigmas[9:] > sigmas[3:6])


def test_place_all_wrong_scale_is_corrected() -> None:
    made = segments(4)
    made.motions[:, 1, :3, 3] *= 1.02
    extrinsics = placed(made)
    assert any("back measures lengths 2." in sentence for sentence in extrinsics.warnings)
    off = error(extrinsics)
    assert off @ np.linalg.solve(extrinsics.covariance, off) < chi2.isf(1e-3, 12)
    assert max(extrinsics.distances.values()) < chi2.isf(1e-3, 6)
    assert extrinsics.loops[0].statistic < chi2.isf(1e-4, 6)


def test_place_all_planar_motion_leaves_heights_open() -> None:
    extrinsics = placed(segments(5, planar))
    for one, other in combinations(range(3), 2):
        assert not extrinsics.pairwise[one, other].observability.is_complete
    sigmas = np.sqrt(np.diag(extrinsics.covariance))
    assert sigmas[4] > 1.0
    assert sigmas[10] > 1.0
    assert sigmas[[3, 5, 9, 11]].max() < 0.03


def test_pairwise_unrelated_camera_is_named() -> None:
    made = segments(6)
    made.motions[:, 2] = made.motions[::-1, 2].copy()
    with pytest.raises(CalibrationError, match="front and side: "):
        placed(made)
