"""The paper's calibration and the graph, on pose pairs whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from hand_eye import LEFT2_T_LEFT1, SyntheticPairs, by_dual_quaternions, synthetic_pairs
from hypothesis import given, settings
from hypothesis import strategies as st
from monte_carlo import band

from graphvio.arrays import Float
from graphvio.calibration import graph, paper_method
from graphvio.calibration.alignment import alignment_errors_of
from graphvio.calibration.comparison import compare
from graphvio.calibration.consistency import whitened
from graphvio.calibration.paper_method import PoseParts
from graphvio.calibration.pose_pairs import PosePairs
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_exp, se3_inverse, se3_log, so3_exp

ANGLE, STEP_M = 2e-3, 3e-3


def error_of(found: Float, true: Float = LEFT2_T_LEFT1) -> Float:
    """Tangent (6,) in left1."""
    return np.asarray(se3_log(se3_inverse(np.ascontiguousarray(found)) @ true))


def both(pairs: PosePairs) -> tuple[paper_method.PaperSolution, graph.GraphSolution]:
    paper = paper_method.calibrate(pairs)
    return paper, graph.solve(pairs, paper.left2_T_left1)


@settings(deadline=None, max_examples=15)
@given(
    tangent=st.lists(st.floats(-2.5, 2.5), min_size=6, max_size=6), seed=st.integers(0, 2**31), count=st.integers(6, 60)
)
def test_all_methods_without_noise_are_exact(tangent: list[float], seed: int, count: int) -> None:
    true = se3_exp(np.array(tangent))
    pairs = synthetic_pairs(count, np.random.default_rng(seed), left2_T_left1=true).pairs
    paper, found = both(pairs)
    assert np.abs(error_of(paper.left2_T_left1, true)).max() < 1e-9
    assert np.abs(error_of(found.left2_T_left1, true)).max() < 1e-9
    assert np.abs(error_of(by_dual_quaternions(pairs), true)).max() < 1e-6
    assert paper.inlier.all()
    assert found.inlier.all()


def test_rotation_satisfies_equation_5() -> None:
    """With all axes turned about, so that no order of the products but the right one fits."""
    parts = PoseParts.of(synthetic_pairs(20, np.random.default_rng(1)).pairs)
    R, eigenvalues = paper_method.rotation(parts.R_1, parts.R_2)
    np.testing.assert_allclose(R @ parts.R_1, parts.R_2 @ R, atol=1e-12)
    np.testing.assert_allclose(R, LEFT2_T_LEFT1[:3, :3], atol=1e-12)
    assert eigenvalues[0] < 1e-12 < 1e-3 < eigenvalues[1]


def test_alignment_errors_are_those_of_equation_6_where_5_holds() -> None:
    """For any translation: they are turned into the frame of the first camera, with the opposite sign."""
    parts = PoseParts.of(synthetic_pairs(20, np.random.default_rng(1)).pairs)
    R, T = LEFT2_T_LEFT1[:3, :3], np.array([0.3, -0.1, 0.2])
    of_6 = parts.T_1 @ R.T + T - parts.R_2 @ T - parts.T_2
    turned = -(np.swapaxes(parts.R_2 @ R, 1, 2) @ of_6[:, :, None])[:, :, 0]
    assert np.abs(of_6).max() > 0.01
    np.testing.assert_allclose(paper_method.alignment_errors(parts, R, -R.T @ T), turned, atol=1e-12)


def test_calibrate_large_turns_ignore_quaternion_signs() -> None:
    """Turns of more than a half, whose quaternions change their sign."""
    pairs = synthetic_pairs(30, np.random.default_rng(2), turns=(1.2, 1.2, 1.2)).pairs
    assert np.linalg.norm(pairs.rotations_rad, axis=1).max() > 2.5
    assert np.abs(error_of(paper_method.calibrate(pairs).left2_T_left1)).max() < 1e-9


def test_alignment_errors_are_distances_of_second_camera() -> None:
    pairs = synthetic_pairs(10, np.random.default_rng(3), ANGLE, STEP_M).pairs
    R = LEFT2_T_LEFT1[:3, :3]
    t = -R.T @ LEFT2_T_LEFT1[:3, 3]
    left1_T_left2 = np.linalg.inv(LEFT2_T_LEFT1)
    by_1, by_2 = pairs.motion_1 @ left1_T_left2, left1_T_left2 @ pairs.motion_2
    expected = by_1[:, :3, 3] - by_2[:, :3, 3]
    parts = PoseParts.of(pairs)
    np.testing.assert_allclose(paper_method.alignment_errors(parts, R, t), expected, atol=1e-12)
    moved = np.einsum("nji,nj->ni", parts.R_2, parts.T_2)
    by_kernel = alignment_errors_of(parts.R_1, parts.T_1, moved, np.ascontiguousarray(R), t)
    np.testing.assert_allclose(by_kernel, expected, atol=1e-12)


def test_costs_of_triples_are_the_sums_of_limited_distances() -> None:
    rng = np.random.default_rng(4)
    weighted = paper_method._Weighted(synthetic_pairs(40, rng).pairs)
    R = np.array([so3_exp(vector) for vector in rng.normal(size=(5, 3))])
    R[0], t = LEFT2_T_LEFT1[:3, :3].T, rng.normal(size=(5, 3))
    limit = float(np.median([weighted.distances(*each) for each in zip(R, t, strict=True)]))
    expected = [np.minimum(weighted.distances(*each), limit).sum() for each in zip(R, t, strict=True)]
    np.testing.assert_allclose(weighted.costs(R, t, limit), expected, rtol=1e-10)


def test_jacobians_match_numerical_derivatives() -> None:
    parts = PoseParts.of(synthetic_pairs(10, np.random.default_rng(4), ANGLE, STEP_M).pairs)
    R, t, h = LEFT2_T_LEFT1[:3, :3], np.array([0.1, -0.2, 0.3]), 1e-6
    numeric = []
    for axis in np.eye(3):
        errors = [paper_method.alignment_errors(parts, R, t + sign * h * axis) for sign in (1.0, -1.0)]
        numeric.append((errors[0] - errors[1]) / (2.0 * h))
    for axis in np.eye(3):  # dq is half a rotation vector
        errors = [paper_method.alignment_errors(parts, so3_exp(sign * 2.0 * h * axis) @ R, t) for sign in (1.0, -1.0)]
        numeric.append((errors[0] - errors[1]) / (2.0 * h))
    np.testing.assert_allclose(paper_method.jacobians(parts, R), np.stack(numeric, axis=2), atol=1e-8)


def test_whitened_matches_numerical_derivatives() -> None:
    pairs, h = synthetic_pairs(5, np.random.default_rng(5), ANGLE, STEP_M).pairs, 1e-6
    flat = replace(pairs, covariance_1=1e-12 * pairs.covariance_1)  # else the whitener changes, too
    _, jacobians = whitened(flat, LEFT2_T_LEFT1)
    numeric = []
    for axis in np.eye(6):
        errors = [whitened(flat, LEFT2_T_LEFT1 @ se3_exp(sign * h * axis))[0] for sign in (1.0, -1.0)]
        numeric.append((errors[0] - errors[1]) / (2.0 * h))
    scale = np.abs(jacobians).max()
    np.testing.assert_allclose(jacobians / scale, np.stack(numeric, axis=2) / scale, atol=1e-6)


@pytest.mark.parametrize("outlier_share", [0.0, 0.3, 0.6])
def test_both_methods_errors_are_within_covariance(outlier_share: float) -> None:
    runs = 16
    squares, differences, kept, missed = [], [], 0, 0
    for seed in range(runs):
        made: SyntheticPairs = synthetic_pairs(150, np.random.default_rng([seed, 1]), ANGLE, STEP_M, outlier_share)
        paper, found = both(made.pairs)
        error = error_of(found.left2_T_left1)
        squares.append(error @ np.linalg.solve(found.covariance, error))
        differences.append(compare(made.pairs, paper, found).agrees)
        kept += int(np.sum(found.inlier & made.outlier))
        missed += int(np.sum(~found.inlier & ~made.outlier))
    low, high = band(runs)
    assert low < np.mean(squares) < high
    assert np.mean(differences) >= 0.95
    assert kept <= 1
    assert missed <= 0.005 * runs * 150


def test_solve_good_start_finds_few_inliers() -> None:
    """Slow turns and little noise: outliers are so far off that a solution for all motions leads nowhere."""
    for seed in range(8):
        made = synthetic_pairs(300, np.random.default_rng([seed, 2]), 2e-4, 4e-4, 0.6, turns=(0.05, 0.1, 0.05))
        start = LEFT2_T_LEFT1 @ se3_exp(np.repeat([3e-4, 3e-4], 3))
        found = graph.solve(made.pairs, start)
        assert not np.any(found.inlier & made.outlier)
        assert found.inlier.sum() > 0.95 * np.sum(~made.outlier)


def test_compare_wrong_solution_disagrees() -> None:
    pairs = synthetic_pairs(100, np.random.default_rng(6), ANGLE, STEP_M).pairs
    paper, found = both(pairs)
    assert compare(pairs, paper, found).agrees
    wrong = replace(paper, left2_T_left1=paper.left2_T_left1 @ se3_exp(np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.03])))
    assert not compare(pairs, wrong, found).agrees


def test_both_methods_same_seed_give_same_bits() -> None:
    pairs = synthetic_pairs(80, np.random.default_rng(7), ANGLE, STEP_M, 0.4).pairs
    one, other = both(pairs), both(pairs)
    assert np.array_equal(one[0].left2_T_left1, other[0].left2_T_left1)
    assert np.array_equal(one[1].left2_T_left1, other[1].left2_T_left1)


def test_calibrate_too_few_pose_pairs_raises() -> None:
    pairs = synthetic_pairs(2, np.random.default_rng(8)).pairs
    with pytest.raises(CalibrationError, match="needs 3 pose pairs and has 2"):
        paper_method.calibrate(pairs)


def test_calibrate_without_rotation_raises() -> None:
    pairs = synthetic_pairs(50, np.random.default_rng(9), turns=(0.0, 0.0, 0.0)).pairs
    with pytest.raises(CalibrationError, match="without rotation"):
        paper_method.calibrate(pairs)


def test_both_methods_unrelated_motions_raise() -> None:
    made = synthetic_pairs(60, np.random.default_rng(10), ANGLE, STEP_M, outlier_share=1.0)
    with pytest.raises(CalibrationError, match="one rig"):
        both(made.pairs)


def test_pose_pairs_not_finite_raises() -> None:
    pairs = synthetic_pairs(5, np.random.default_rng(11)).pairs
    broken = pairs.motion_2.copy()
    broken[3, 0, 3] = np.nan
    with pytest.raises(CalibrationError, match="motion_2 of pair 3 holds NaN"):
        replace(pairs, motion_2=broken)
