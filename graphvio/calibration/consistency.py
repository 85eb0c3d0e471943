"""How well motions of two cameras fit a relative pose: errors, derivatives, outliers.

A motion of the first camera, seen from the second, is ``left2_T_left1 motion_1 left1_T_left2``; it must be motion_2
(section 4, eq. 1). Errors are weighed by the covariances of both motions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from graphvio.arrays import Bool, Float, Int
from graphvio.calibration.pose_pairs import PosePairs
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log, se3_right_jacobian_inverse
from graphvio.kernels import kernel, put

_PROBABILITY = 0.999  # of an honest pose pair, to be within what is no outlier
LIMIT = float(chi2.ppf(_PROBABILITY, 6))
_MOST_ROUNDS = 100
_STEPS_A_ROUND = 2
_SHARPENING = 1.4  # of the cost from round to round, towards truncated least squares
_CERTAIN = 1e-3  # weights this near to 0 or 1 are that
_SETTLED = 1e-12
_LONGEST_STEP = 0.5  # radians and metres: from few motions the first steps may lead anywhere
_NOTHING = np.zeros((0, 6))


class Further(NamedTuple):
    """Further unknowns, on which the pose pairs' errors depend linearly: an offset between clocks, a scale.

    Attributes:
        derivatives: (N, 6, M) of the errors, see `error_of`.
        sigmas: (M,) of what is known of them beforehand, around zero.
    """

    derivatives: Float
    sigmas: Float

    def chosen(self, rows: Bool | Int) -> Further:
        """Those of some pose pairs."""
        return Further(self.derivatives[rows], self.sigmas)

    def beside(self, other: Further | None) -> Further:
        """With some more unknowns, before these."""
        if other is None:
            return self
        return Further(
            np.concatenate([other.derivatives, self.derivatives], axis=2),
            np.concatenate([other.sigmas, self.sigmas]),
        )

    @staticmethod
    def none(pairs: PosePairs) -> Further:
        """No further unknowns."""
        return Further(np.zeros((len(pairs), 6, 0)), np.zeros(0))


class Consensus(NamedTuple):
    """What most pose pairs agree on.

    Attributes:
        left2_T_left1: (4, 4).
        further: (M,) further unknowns.
        squares: (N,) squared Mahalanobis distances of the errors there.
    """

    left2_T_left1: Float
    further: Float
    squares: Float

    @property
    def inlier(self) -> Bool:
        """(N,) pose pairs that are no outliers."""
        return np.asarray(self.squares <= LIMIT)


def without_outliers(
    pairs: PosePairs, start: Float, held: Float = _NOTHING, further: Further | None = None
) -> Consensus:
    """The relative pose by truncated least squares, from a start that may be off, by graduated non-convexity.

    H. Yang, P. Antonante, V. Tzoumas, L. Carlone, *Graduated Non-Convexity for Robust Spatial Perception: From
    Non-Minimal Solvers to Global Outlier Rejection*, IEEE RA-L 5(2), 2020.

    Args:
        pairs: N pose pairs.
        start: ``left2_T_left1`` (4, 4).
        held: (K, 6) orthonormal directions, tangent in left1, in which the start is kept.
        further: unknowns besides.
    """
    further = Further.none(pairs) if further is None else further
    begun = Consensus(start, np.zeros(len(further.sigmas)), np.empty(0))
    found = _graduated(pairs, begun, held, further)
    # Where most pose pairs are wild, a solution for all of them is no beginning, but the start may be.
    near = _refined(pairs, solved(pairs, begun, np.zeros(len(pairs)), 0, held, further), held, further)
    return min(found, near, key=lambda each: float(np.minimum(each.squares, LIMIT).sum()))


def _graduated(pairs: PosePairs, begun: Consensus, held: Float, further: Further) -> Consensus:
    """From a cost that is convex to truncated least squares."""
    found = solved(pairs, begun, np.ones(len(pairs)), _MOST_ROUNDS, held, further)
    sharpness = 1.0 / max(2.0 * found.squares.max() / LIMIT - 1.0, 1.0)
    for _ in range(_MOST_ROUNDS):
        weights = _weights(found.squares, sharpness)
        found = solved(pairs, found, weights, _STEPS_A_ROUND, held, further)
        if np.all((weights < _CERTAIN) | (weights > 1.0 - _CERTAIN)):
            break
        sharpness *= _SHARPENING
    return _refined(pairs, found, held, further)


def _refined(pairs: PosePairs, found: Consensus, held: Float, further: Further) -> Consensus:
    """Inliers and solution in turns, until the inliers stay the same."""
    for _ in range(_MOST_ROUNDS):
        before = found.inlier
        found = solved(pairs, found, before.astype(np.float64), _STEPS_A_ROUND, held, further)
        if np.array_equal(before, found.inlier):
            break
    return solved(pairs, found, found.inlier.astype(np.float64), _MOST_ROUNDS, held, further)


def squared_distances(pairs: PosePairs, left2_T_left1: Float) -> Float:
    """Squared Mahalanobis distances (N,) of the pose pairs' errors, 6 degrees of freedom each."""
    errors, _ = whitened(pairs, left2_T_left1)
    return np.asarray(np.sum(errors**2, axis=1))


def information(pairs: PosePairs, left2_T_left1: Float) -> Float:
    """What pose pairs tell of ``left2_T_left1`` (6, 6), tangent in left1."""
    _, jacobians = whitened(pairs, left2_T_left1)
    return np.asarray(np.einsum("nki,nkj->ij", jacobians, jacobians))


def whitened(
    pairs: PosePairs, left2_T_left1: Float, further: Further | None = None, values: Float | None = None
) -> tuple[Float, Float]:
    """Errors (N, 6) of unit covariance, and derivatives (N, 6, 6 + M) by the tangent of ``left2_T_left1`` in left1 and
    by further unknowns, at some values (M,) of these."""
    if further is None or values is None:
        further, values = Further.none(pairs), np.empty(0)
    motions = pairs.motion_1, pairs.covariance_1, pairs.motion_2, pairs.covariance_2
    return _whitened(left2_T_left1, *motions, np.ascontiguousarray(further.derivatives), values)


def solved(
    pairs: PosePairs, start: Consensus, weights: Float, most_steps: int, held: Float, further: Further
) -> Consensus:
    """Gauss-Newton with weighted pose pairs (N,) from a start, of which some directions (K, 6) are kept."""
    left2_T_left1, values = start.left2_T_left1, start.further
    free = np.eye(6 + len(values))
    free[:6, :6] -= held.T @ held
    known = np.diag(np.concatenate([np.zeros(6), further.sigmas**-2]))
    for _ in range(most_steps):
        errors, jacobians = whitened(pairs, left2_T_left1, further, values)
        jacobians = jacobians @ free
        normal = np.einsum("n,nki,nkj->ij", weights, jacobians, jacobians) + known
        gradient = np.einsum("n,nki,nk->i", weights, jacobians, errors) + known[:, 6:] @ values
        step = -np.linalg.lstsq(normal, gradient, rcond=1e-14)[0]
        step /= max(np.abs(step).max() / _LONGEST_STEP, 1.0)
        left2_T_left1 = left2_T_left1 @ se3_exp(step[:6])
        values = values + step[6:]
        if np.abs(step).max() < _SETTLED:
            break
    errors, _ = whitened(pairs, left2_T_left1, further, values)
    return Consensus(left2_T_left1, values, np.sum(errors**2, axis=1))


@kernel
def error_of(left2_T_left1: Float, motion_1: Float, motion_2: Float) -> tuple[Float, Float]:
    """Error (6,) of a pose pair in left2 at the motion's end, and its derivative (6, 6)."""
    seen = left2_T_left1 @ motion_1 @ se3_inverse(left2_T_left1)
    error = se3_log(se3_inverse(motion_2) @ seen)
    by_tangent = se3_adjoint(left2_T_left1) @ (se3_adjoint(se3_inverse(motion_1)) - np.eye(6))
    return error, se3_right_jacobian_inverse(error) @ by_tangent


@kernel
def errors_of(left2_T_left1: Float, motions_1: Float, motions_2: Float) -> Float:
    """Errors (N, 6) of N pose pairs, see `error_of`."""
    errors = np.empty((len(motions_1), 6))
    for i in range(len(motions_1)):
        error, _ = error_of(left2_T_left1, motions_1[i], motions_2[i])
        put(errors[i], error)
    return errors


@kernel
def error_covariance(left2_T_left1: Float, covariance_1: Float, covariance_2: Float) -> Float:
    """Covariance (6, 6) of a pose pair's error, from both motions'."""
    adjoint = se3_adjoint(left2_T_left1)
    return covariance_2 + adjoint @ covariance_1 @ adjoint.T


def _weights(squares: Float, sharpness: float) -> Float:
    """Eq. (14) of the paper on graduated non-convexity."""
    low, high = (LIMIT * bound for bound in (sharpness / (sharpness + 1.0), (sharpness + 1.0) / sharpness))
    between = np.sqrt(LIMIT * sharpness * (sharpness + 1.0) / np.maximum(squares, low)) - sharpness
    return np.where(squares <= low, 1.0, np.where(squares >= high, 0.0, between))


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
    n, further = len(motion_1), len(values)
    errors, jacobians = np.empty((n, 6)), np.empty((n, 6, 6 + further))
    for i in range(n):
        error, jacobian = error_of(left2_T_left1, motion_1[i], motion_2[i])
        root = np.linalg.cholesky(error_covariance(left2_T_left1, covariance_1[i], covariance_2[i]))
        put(jacobians[i, :, :6], jacobian)
        if further:
            error = error + derivatives[i] @ values
            put(jacobians[i, :, 6:], derivatives[i])
        put(errors[i], error)
        _divide(root, errors[i].reshape(6, 1))
        _divide(root, jacobians[i])
    return errors, jacobians


@kernel
def _divide(root: Float, values: Float) -> None:
    """Forward substitution: ``values`` (6, K) become ``root^-1 values`` for a lower triangle, in place."""
    for row in range(6):
        for column in range(values.shape[1]):
            total = values[row, column]
            for k in range(row):
                total -= root[row, k] * values[k, column]
            values[row, column] = total / root[row, row]
