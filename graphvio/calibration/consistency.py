"""Errors of pose pairs for a relative pose of the cameras, and detection of outliers among the pose pairs.

A motion of the first camera, seen from the second, is ``left2_T_left1 motion_1 left1_T_left2``; it must be motion_2
(section 4, eq. 1). Errors are weighted by the covariances of both motions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv  # scipy.stats takes a second to import

from graphvio.arrays import Bool, Float
from graphvio.calibration.nuisances import Nuisances
from graphvio.calibration.pose_pairs import PosePairs
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log, se3_right_jacobian_inverse
from graphvio.kernels import kernel, put

LIMIT = float(2.0 * gammaincinv(3.0, 0.999))  # chi-square of 6
"""Squared Mahalanobis distance from which a pose pair is an outlier."""

_MAX_ROUNDS = 100
_STEPS_A_ROUND = 2
_SHARPENING = 1.4  # factor on the cost's sharpness per round, towards truncated least squares
_CERTAIN = 1e-3  # weights this near to 0 or 1 count as such
_CONVERGED = 1e-12
_MAX_STEP = 0.5  # radians and metres: with few motions the first steps may be far too long


class Consensus(NamedTuple):
    """A relative pose on which most pose pairs agree."""

    left2_T_left1: Float  # (4, 4)
    nuisances: Float  # (M,) values of the nuisance variables
    errors: Float  # (N, 6) of all pose pairs, whitened
    jacobians: Float  # (N, 6, 6 + M) of these, see `whitened`

    @property
    def squares(self) -> Float:
        """Squared Mahalanobis distances (N,) of all pose pairs' errors."""
        return np.asarray(np.sum(self.errors**2, axis=1))

    @property
    def inlier(self) -> Bool:
        """Mask (N,) of pose pairs that are not outliers."""
        return np.asarray(self.squares <= LIMIT)


def without_outliers(pairs: PosePairs, start: Float, held: Float, nuisances: Nuisances) -> Consensus:
    """Minimise truncated least squares by graduated non-convexity.

    H. Yang, P. Antonante, V. Tzoumas, L. Carlone, *Graduated Non-Convexity for Robust Spatial Perception: From
    Non-Minimal Solvers to Global Outlier Rejection*, IEEE RA-L 5(2), 2020.

    Args:
        pairs: N pose pairs.
        start: initial ``left2_T_left1`` (4, 4).
        held: orthonormal directions (K, 6), tangent in left1, in which the initial pose is kept.
        nuisances: variables to estimate with the pose.
    """
    initial = _at(pairs, start, nuisances, np.zeros(len(nuisances.sigmas)))
    graduated = _graduated(pairs, initial, held, nuisances)
    # Where most pose pairs are outliers, a solution for all of them is a bad start, but the given pose may be good.
    near = _refined(pairs, initial, held, nuisances)
    return min(graduated, near, key=lambda each: float(np.minimum(each.squares, LIMIT).sum()))


def _graduated(pairs: PosePairs, initial: Consensus, held: Float, nuisances: Nuisances) -> Consensus:
    """Minimise a sequence of costs, from a convex one to truncated least squares."""
    found = _solve(pairs, initial, np.ones(len(pairs)), _MAX_ROUNDS, held, nuisances)
    sharpness = 1.0 / max(2.0 * found.squares.max() / LIMIT - 1.0, 1.0)
    for _ in range(_MAX_ROUNDS):
        weights = _weights(found.squares, sharpness)
        found = _solve(pairs, found, weights, _STEPS_A_ROUND, held, nuisances)
        if np.all((weights < _CERTAIN) | (weights > 1.0 - _CERTAIN)):
            break
        sharpness *= _SHARPENING
    return _refined(pairs, found, held, nuisances)


def _refined(pairs: PosePairs, found: Consensus, held: Float, nuisances: Nuisances) -> Consensus:
    """Alternate between inliers and solution until the inliers stay the same."""
    for _ in range(_MAX_ROUNDS):
        before = found.inlier
        found = _solve(pairs, found, before.astype(np.float64), _STEPS_A_ROUND, held, nuisances)
        if np.array_equal(before, found.inlier):
            break
    return _solve(pairs, found, found.inlier.astype(np.float64), _MAX_ROUNDS, held, nuisances)


def _solve(
    pairs: PosePairs, start: Consensus, weights: Float, max_steps: int, held: Float, nuisances: Nuisances
) -> Consensus:
    """Minimise by Gauss-Newton with weights (N,) of the pose pairs; directions ``held`` (K, 6) stay as they are."""
    found = start
    free = np.eye(6 + len(found.nuisances))
    free[:6, :6] -= held.T @ held
    prior = np.diag(np.concatenate([np.zeros(6), nuisances.sigmas**-2]))
    for _ in range(max_steps):
        jacobians = found.jacobians @ free
        normal = np.einsum("n,nki,nkj->ij", weights, jacobians, jacobians) + prior
        gradient = np.einsum("n,nki,nk->i", weights, jacobians, found.errors) + prior[:, 6:] @ found.nuisances
        step = -np.linalg.lstsq(normal, gradient, rcond=1e-14)[0]
        step /= max(np.abs(step).max() / _MAX_STEP, 1.0)
        found = _at(pairs, found.left2_T_left1 @ se3_exp(step[:6]), nuisances, found.nuisances + step[6:])
        if np.abs(step).max() < _CONVERGED:
            break
    return found


def _at(pairs: PosePairs, left2_T_left1: Float, nuisances: Nuisances, values: Float) -> Consensus:
    return Consensus(left2_T_left1, values, *whitened(pairs, left2_T_left1, nuisances, values))


def _weights(squares: Float, sharpness: float) -> Float:
    """Return the weights (N,) by eq. (14) of the paper on graduated non-convexity."""
    low, high = (LIMIT * bound for bound in (sharpness / (sharpness + 1.0), (sharpness + 1.0) / sharpness))
    between = np.sqrt(LIMIT * sharpness * (sharpness + 1.0) / np.maximum(squares, low)) - sharpness
    return np.where(squares <= low, 1.0, np.where(squares >= high, 0.0, between))


def information(pairs: PosePairs, left2_T_left1: Float) -> Float:
    """Return the Fisher information (6, 6) of pose pairs on ``left2_T_left1``, tangent in left1."""
    _, jacobians = whitened(pairs, left2_T_left1)
    return np.asarray(np.einsum("nki,nkj->ij", jacobians, jacobians))


def whitened(
    pairs: PosePairs, left2_T_left1: Float, nuisances: Nuisances | None = None, values: Float | None = None
) -> tuple[Float, Float]:
    """Whiten the errors of pose pairs, and linearise them.

    Args:
        pairs: N pose pairs.
        left2_T_left1: (4, 4).
        nuisances: M variables.
        values: (M,) values of the nuisance variables.

    Returns:
        Errors (N, 6) of unit covariance, and derivatives (N, 6, 6 + M) with respect to the tangent of ``left2_T_left1``
        in left1 and to the nuisance variables.
    """
    if nuisances is None or values is None:
        nuisances, values = Nuisances.none(len(pairs)), np.empty(0)
    motions = pairs.motion_1, pairs.covariance_1, pairs.motion_2, pairs.covariance_2
    return _whitened(left2_T_left1, *motions, np.ascontiguousarray(nuisances.derivatives), values)


@kernel
def error_of(left2_T_left1: Float, motion_1: Float, motion_2: Float) -> tuple[Float, Float]:
    """Compute the error (6,) of a pose pair in left2 at the end, and its derivative (6, 6).

    The derivative is with respect to the tangent of ``left2_T_left1`` in left1.
    """
    error = _error(left2_T_left1, motion_1, motion_2)
    by_tangent = se3_adjoint(left2_T_left1) @ (se3_adjoint(se3_inverse(motion_1)) - np.eye(6))
    return error, se3_right_jacobian_inverse(error) @ by_tangent


@kernel
def _error(left2_T_left1: Float, motion_1: Float, motion_2: Float) -> Float:
    seen = left2_T_left1 @ motion_1 @ se3_inverse(left2_T_left1)
    return se3_log(se3_inverse(motion_2) @ seen)


@kernel
def errors_of(left2_T_left1: Float, motions_1: Float, motions_2: Float) -> Float:
    """Compute the errors (N, 6) of N pose pairs, see `error_of`."""
    errors = np.empty((len(motions_1), 6))
    for i in range(len(motions_1)):
        put(errors[i], _error(left2_T_left1, motions_1[i], motions_2[i]))
    return errors


@kernel
def error_covariance(left2_T_left1: Float, covariance_1: Float, covariance_2: Float) -> Float:
    """Compute the covariance (6, 6) of a pose pair's error from those of both motions."""
    adjoint = se3_adjoint(left2_T_left1)
    return covariance_2 + adjoint @ covariance_1 @ adjoint.T


@kernel
def _whitened(
    left2_T_left1: Float,
    motion_1: Float,
    covariance_1: Float,
    motion_2: Float,
    covariance_2: Float,
    derivatives: Float,
    values: Float,
) -> tuple[Float, Float]:
    n, nuisances = len(motion_1), len(values)
    errors, jacobians = np.empty((n, 6)), np.empty((n, 6, 6 + nuisances))
    for i in range(n):
        error, jacobian = error_of(left2_T_left1, motion_1[i], motion_2[i])
        root = np.linalg.cholesky(error_covariance(left2_T_left1, covariance_1[i], covariance_2[i]))
        put(jacobians[i, :, :6], jacobian)
        if nuisances:
            error = error + derivatives[i] @ values
            put(jacobians[i, :, 6:], derivatives[i])
        put(errors[i], error)
        _divide(root, errors[i].reshape(6, 1))
        _divide(root, jacobians[i])
    return errors, jacobians


@kernel
def _divide(root: Float, values: Float) -> None:
    """Replace values (6, K) by ``root^-1 values``, with a lower triangular root, by forward substitution."""
    for row in range(6):
        for column in range(values.shape[1]):
            total = values[row, column]
            for k in range(row):
                total -= root[row, k] * values[k, column]
            values[row, column] = total / root[row, row]
