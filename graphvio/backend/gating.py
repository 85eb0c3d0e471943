"""The chi-square test of a measured motion against its prediction (section 5)."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.stats import chi2

from graphvio.arrays import Float
from graphvio.geometry import se3_adjoint, se3_inverse, se3_log
from graphvio.measurements.gate_result import GateResult

_SURELY = 5.0  # standard deviations


def relative_covariance(a_T_b: Float, joint: Float) -> Float:
    """Covariance (6, 6) of ``a_T_b``, in frame b, from the joint covariance (12, 12) of the poses of a and b."""
    jacobian = np.hstack([-se3_adjoint(se3_inverse(a_T_b)), np.eye(6)])
    return np.asarray(jacobian @ joint @ jacobian.T)


def gate_motion(
    measured: Float,
    measured_covariance: Float,
    predicted: Float,
    predicted_covariance: Float,
    probability: float,
) -> GateResult:
    """Test a motion (4, 4) against a predicted one; covariances (6, 6) in the frame that it ends in."""
    innovation = se3_log(se3_inverse(predicted) @ measured)
    return gate_innovation(innovation, measured_covariance + predicted_covariance, probability)


def gate_innovation(innovation: Float, covariance: Float, probability: float) -> GateResult:
    """Test an innovation (M,) with a covariance (M, M)."""
    statistic = float(innovation @ np.linalg.solve(covariance, innovation))
    threshold = chi_square_quantile(probability, len(innovation))
    return GateResult(statistic <= threshold, statistic, threshold, innovation, covariance)


def excess(value: Float, covariance: Float, most: float) -> float | None:
    """The length of a vector (3,) with a covariance (3, 3), if it is surely more than it can be; else None."""
    length = float(np.linalg.norm(value))
    if length <= most:
        return None
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    return length if length - _SURELY * sigma > most else None


@cache
def chi_square_quantile(probability: float, degrees_of_freedom: int) -> float:
    """The value below which a chi-square variable lies with a probability."""
    return float(chi2.ppf(probability, degrees_of_freedom))
