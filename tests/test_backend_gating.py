import numpy as np
import pytest
from scipy.stats import chi2
from synthetic import random_covariance, random_transform, transform

from graphvio.backend.gating import gate_motion, relative_covariance
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.measurements.gate_result import GateResult


def test_relative_covariance_against_monte_carlo() -> None:
    rng = np.random.default_rng(0)
    nav_T_a, nav_T_b = random_transform(rng, 0.8, 3.0), random_transform(rng, 1.2, 5.0)
    joint = random_covariance(rng, 12, 2e-3)
    a_T_b = se3_inverse(nav_T_a) @ nav_T_b
    errors = []
    for sampled in rng.multivariate_normal(np.zeros(12), joint, size=20000):
        moved = se3_inverse(nav_T_a @ se3_exp(sampled[:6])) @ nav_T_b @ se3_exp(sampled[6:])
        errors.append(se3_log(se3_inverse(a_T_b) @ moved))
    whitener = np.linalg.inv(np.linalg.cholesky(relative_covariance(a_T_b, joint)))
    np.testing.assert_allclose(np.cov(whitener @ np.array(errors).T), np.eye(6), atol=0.06)


def test_what_both_poses_share_cancels() -> None:
    """Two poses that move together, as one rigid body, have a motion between them that is known."""
    rng = np.random.default_rng(1)
    a_T_b = random_transform(rng, 0.5, 2.0)
    shared = random_covariance(rng, 6, 0.1)
    b_T_a = se3_inverse(a_T_b)
    adjoint = np.zeros((6, 6))  # of b_T_a, column by column
    for i, axis in enumerate(np.eye(6)):
        adjoint[:, i] = se3_log(b_T_a @ se3_exp(1e-6 * axis) @ a_T_b) / 1e-6
    both = np.vstack([np.eye(6), adjoint])
    np.testing.assert_allclose(relative_covariance(a_T_b, both @ shared @ both.T), 0.0, atol=1e-8)


@pytest.mark.parametrize("probability", [0.5, 0.95, 0.99])
def test_consistent_innovations_pass_as_often_as_they_should(probability: float) -> None:
    rng = np.random.default_rng(2)
    truth = random_transform(rng, 0.3, 1.0)
    of_measured, of_predicted = random_covariance(rng, 6, 0.01), random_covariance(rng, 6, 0.02)
    n = 4000
    samples = zip(
        rng.multivariate_normal(np.zeros(6), of_measured, size=n),
        rng.multivariate_normal(np.zeros(6), of_predicted, size=n),
        strict=True,
    )
    passed = sum(
        gate_motion(truth @ se3_exp(a), of_measured, truth @ se3_exp(b), of_predicted, probability).accepted
        for a, b in samples
    )
    band = 4.0 * np.sqrt(probability * (1.0 - probability) / n) + 0.003
    assert passed / n == pytest.approx(probability, abs=band)


def test_gross_errors_are_refused() -> None:
    covariance = np.diag(np.repeat([1e-3, 1e-2], 3) ** 2)
    truth = transform([0.01, 0.02, 0.0], [0.1, 0.0, 0.0])
    for error in ([0.1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0.2, 0], [0, 0, 3.1, 0, 0, 0], [0, 0, 0, 1e3, 0, 0]):
        gate_result = gate_motion(truth @ se3_exp(np.array(error, dtype=float)), covariance, truth, covariance, 0.9999)
        assert not gate_result.accepted
        assert gate_result.statistic > gate_result.threshold == pytest.approx(chi2.ppf(0.9999, 6))


def test_the_statistic_is_the_mahalanobis_distance() -> None:
    measured, predicted = transform([0, 0, 0], [0.3, 0, 0]), np.eye(4)
    gate_result = gate_motion(measured, 0.04 * np.eye(6), predicted, 0.05 * np.eye(6), 0.95)
    assert gate_result.statistic == pytest.approx(0.3**2 / 0.09)
    assert gate_result.accepted


def test_an_outcome_near_the_threshold_is_not_clear() -> None:
    clear = [
        GateResult(statistic < 20.0, statistic, 20.0, np.zeros(6), np.eye(6)).is_clear
        for statistic in (0.0, 9.0, 11.0, 20.0, 39.0, 41.0)
    ]
    assert clear == [True, True, False, False, False, True]
