"""The alignment error of the paper's eq. (7), compiled: it is computed for hundreds of candidates.

For symbols see `graphvio.calibration.paper_method`.
"""

import numpy as np

from graphvio.arrays import Float
from graphvio.kernels import kernel
from graphvio.linear_algebra import squared_length


@kernel
def alignment_errors_of(R_1: Float, T_1: Float, moved: Float, R: Float, t: Float) -> Float:
    """Compute alignment errors (N, 3), metres: `graphvio.calibration.paper_method.alignment_errors` as a kernel.

    Args:
        R_1: (N, 3, 3).
        T_1: (N, 3), metres.
        moved: (N, 3) ``R_2^T T_2``, metres.
        R: (3, 3).
        t: (3,), metres.
    """
    errors = np.empty((len(R_1), 3))
    for n in range(len(R_1)):
        for i in range(3):
            total = -t[i]
            for k in range(3):
                total += R[k, i] * moved[n, k] + R_1[n, k, i] * (t[k] - T_1[n, k])
            errors[n, i] = total
    return errors


@kernel
def squared_lengths_of(
    errors: Float, R_1: Float, covariance_1: Float, covariance_2: Float, R: Float, t: Float
) -> Float:
    """Compute squared Mahalanobis distances (N,) of alignment errors (N, 3) from zero.

    Their covariance is ``B S_1 B^T + R^T S_2 R`` with ``B = R_1^T [-[t]_x, I]``.

    Args:
        errors: (N, 3).
        R_1: (N, 3, 3).
        covariance_1: (N, 6, 6) of the first camera's motions, tangent at their end.
        covariance_2: (N, 3, 3) of the second camera's positions at the end, in its frame at the beginning.
        R: (3, 3).
        t: (3,).
    """
    found = np.empty(len(errors))
    turned, by_1, covariance = np.empty((3, 6)), np.empty((3, 6)), np.empty((3, 3))
    for n in range(len(errors)):
        for i in range(3):  # R_1^T [-[t]_x, I]
            a, b, c = R_1[n, 0, i], R_1[n, 1, i], R_1[n, 2, i]
            by_1[i, 0], by_1[i, 1], by_1[i, 2] = c * t[1] - b * t[2], a * t[2] - c * t[0], b * t[0] - a * t[1]
            by_1[i, 3], by_1[i, 4], by_1[i, 5] = a, b, c
        for i in range(3):
            for k in range(6):
                total = 0.0
                for m in range(6):
                    total += by_1[i, m] * covariance_1[n, m, k]
                turned[i, k] = total
        for i in range(3):
            for j in range(3):
                total = 0.0
                for k in range(6):
                    total += turned[i, k] * by_1[j, k]
                for k in range(3):
                    for m in range(3):
                        total += R[k, i] * covariance_2[n, k, m] * R[m, j]
                covariance[i, j] = total
        found[n] = squared_length(errors[n], covariance)
    return found
