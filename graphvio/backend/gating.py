"""Innovation tests: the chi-square test of a measurement against its prediction (section 5)."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.special import gammaincinv  # scipy.stats takes a second to import

from graphvio.arrays import Float
from graphvio.geometry import se3_adjoint, se3_inverse, se3_log
from graphvio.linear_algebra import squared_length
from graphvio.measurements.gate_result import GateResult

_MIN_SIGMAS = 5.0  # by which a length must exceed its bound to count


def relative_covariance(a_T_b: Float, joint: Float) -> Float:
    """Return the covariance (6, 6) of ``a_T_b``, in frame b, from the joint one (12, 12) of the poses of a and b."""
    jacobian = np.hstack([-se3_adjoint(se3_inverse(a_T_b)), np.eye(6)])
    return np.asarray(jacobian @ joint @ jacobian.T)


def gate_motion(
    measured: Float,
    measured_covariance: Float,
    predicted: Float,
    predicted_covariance: Float,
    probability: float,
) -> GateResult:
    """Test a measured motion against its prediction.

    Args:
        measured: (4, 4) measured motion.
        measured_covariance: (6, 6) covariance of the measured motion, in the frame that it ends in.
        predicted: (4, 4) predicted motion.
        predicted_covariance: (6, 6) covariance of the predicted motion, in the frame that it ends in.
        probability: Share of correct measurements that pass.
    """
    innovation = se3_log(se3_inverse(predicted) @ measured)
    return gate_innovation(innovation, measured_covariance + predicted_covariance, probability)


def gate_innovation(innovation: Float, covariance: Float, probability: float) -> GateResult:
    """Test an innovation (M,) with its covariance (M, M); ``probability`` is the share of correct ones that pass."""
    statistic = squared_length(innovation, covariance)
    threshold = chi_square_quantile(probability, len(innovation))
    return GateResult(statistic <= threshold, statistic, threshold, innovation, covariance)


def excess(value: Float, covariance: Float, max_length: float) -> float | None:
    """Return the length of a vector (3,) if it exceeds a bound by 5 sigma of its covariance (3, 3); else None."""
    length = float(np.linalg.norm(value))
    if length <= max_length:
        return None
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    return length if length - _MIN_SIGMAS * sigma > max_length else None


@cache
def chi_square_quantile(probability: float, degrees_of_freedom: int) -> float:
    """Return the quantile of the chi-square distribution."""
    return float(2.0 * gammaincinv(0.5 * degrees_of_freedom, probability))
