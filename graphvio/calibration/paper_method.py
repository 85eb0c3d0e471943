"""The paper's calibration of P_12 (section 4), step by step, with additions that make it robust to noise.

``P_12 P_1(k) = P_2(k) P_12`` gives eq. (5) for the rotation and eq. (6) for the translation. RANSAC over minimal sets
of three pose pairs finds the rotation as an eigenvector, eq. (8) and (9), then the translation by least squares, eq.
(10); Levenberg-Marquardt minimises the alignment error, eq. (7), on the inliers.

The paper does not say how solutions are compared, and takes the best one as it is. Here their costs weigh the alignment
errors by the covariances of the motions, the ten best are refined on their inliers, and directions in which the
rotations do not exceed their noise are left out.

``R_1, T_1`` and ``R_2, T_2`` are the paper's: ``P_j(k)`` maps points from the start to the end of a motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtri

from graphvio.arrays import Bool, Float, Int
from graphvio.calibration.alignment import alignment_errors_of, squared_lengths_of
from graphvio.calibration.pose_pairs import MIN_PAIRS, PosePairs, inverses
from graphvio.errors import CalibrationError
from graphvio.geometry import quat_wxyz_from_rotation, rotation_from_quat_wxyz, se3, so3_exp

_TRIPLES = 500
_CANDIDATES = 10  # best triples, which are refined before one is chosen
_LIMIT = float(chdtri(3, 1e-3))
_TRIPLE_LIMIT = 9.0 * _LIMIT  # larger, as a solution from three pose pairs has an error itself
_MIN_TURN, _MAX_TURN = np.deg2rad([0.2, 170.0])  # limits for a pose pair in a triple: both signs of q fit a half turn
_MIN_TURNED = 3.0  # rms rotation about an axis over the noise of a rotation
_ROUNDS = 5
_ITERATIONS = 50
_FIRST_DAMPING, _STIFFER, _LOOSER = 1e-6, 10.0, 0.1
_MIN_STEP = 1e-14
_TINY = 1e-12


class PoseParts(NamedTuple):
    """The paper's ``P_1(k)`` and ``P_2(k)``: rotations (N, 3, 3) and translations (N, 3), metres."""

    R_1: Float
    T_1: Float
    R_2: Float
    T_2: Float

    @staticmethod
    def of(pairs: PosePairs) -> PoseParts:
        """Return the parts of N pose pairs."""
        parts = []
        for P in (inverses(pairs.motion_1), inverses(pairs.motion_2)):
            parts += [np.ascontiguousarray(P[:, :3, :3]), np.ascontiguousarray(P[:, :3, 3])]
        return PoseParts(*parts)

    def select(self, rows: Bool | Int) -> PoseParts:
        """Return the parts of some pose pairs, by mask or indices."""
        return PoseParts(*(part[rows] for part in self))


@dataclass(frozen=True, eq=False)
class PaperSolution:
    """The result of the paper's method."""

    left2_T_left1: Float  # (4, 4), the paper's P_12
    inlier: Bool  # (N,) pose pairs that the refinement used


def calibrate(pairs: PosePairs, seed: int = 0) -> PaperSolution:
    """Calibrate by RANSAC, whose random triples have a seed, then by Levenberg-Marquardt on the inliers.

    Raises:
        CalibrationError: with fewer than three pose pairs, without rotation, or if no solution explains three of them.
    """
    if len(pairs) < MIN_PAIRS:
        raise CalibrationError(f"calibration needs {MIN_PAIRS} pose pairs and has {len(pairs)}; record for longer")
    weighted = _Weighted(pairs)
    best = _best_triples(weighted, np.random.default_rng(seed))
    _, R, t = min((_refined_on_inliers(weighted, R, t) for R, t in best), key=lambda found: found[0])
    parts, inlier = weighted.parts, weighted.distances(R, t) < _LIMIT
    if inlier.sum() < MIN_PAIRS:
        raise CalibrationError(
            f"the best relative pose of the cameras explains {inlier.sum()} of {len(pairs)} motions; are they on one "
            "rig, and are their clocks the same?"
        )
    R, t = refine(parts.select(inlier), R, t, weighted.noise_rad)
    return PaperSolution(se3(R, -R @ t), inlier)


def rotation(R_1: Float, R_2: Float) -> tuple[Float, Float]:
    """Find R(q) as an eigenvector, eq. (8) and (9).

    Args:
        R_1: (N, 3, 3) rotations of the first camera.
        R_2: (N, 3, 3) rotations of the second camera.

    Returns:
        R(q) (3, 3), and the eigenvalues (4,) of ``C^T C`` in ascending order; the second is zero where the rotations do
        not determine q.
    """
    eigenvalues, vectors = np.linalg.eigh(_normal_matrices(R_1, R_2).sum(axis=0))
    return rotation_from_quat_wxyz(np.ascontiguousarray(vectors[:, 0])), eigenvalues


def translation(R: Float, parts: PoseParts, noise_rad: float = 0.0) -> Float:
    """Find T (3,) by least squares, eq. (10), see `translations`; the shortest one where it is not unique.

    Args:
        R: (3, 3) rotation.
        parts: parts of N pose pairs.
        noise_rad: standard deviation of a rotation; axes with no more rotation than this explains are left out.
    """
    return np.asarray(translations(R[None], PoseParts(*(part[None] for part in parts)), noise_rad)[0])


def translations(R: Float, parts: PoseParts, noise_rad: float) -> Float:
    """Find translations T, eq. (10), for M sets of pose pairs at once.

    ``A T = b`` is solved by the singular values of A: directions in which the rotations determine nothing are left out.

    Args:
        R: (M, 3, 3) rotations.
        parts: parts of N pose pairs for each set, (M, N, ...).
        noise_rad: standard deviation of a rotation, see `translation`.

    Returns:
        Translations (M, 3), metres.
    """
    A = (np.eye(3) - parts.R_2).reshape(len(R), -1, 3)
    # eq. (10) has A T plus R T_1 - T_2: the paper's b lacks a sign
    b = (parts.T_2 - parts.T_1 @ np.swapaxes(R, 1, 2)).reshape(len(R), -1)
    found = np.empty((len(R), 3))
    for m, (left, sizes, right) in enumerate(zip(*np.linalg.svd(A, full_matrices=False), strict=True)):
        turned = sizes > _min_singular_value(sizes, parts.R_2.shape[1], noise_rad)
        found[m] = right[turned].T @ ((left.T @ b[m])[turned] / sizes[turned])
    return found


def alignment_errors(parts: PoseParts, R: Float, t: Float) -> Float:
    """Compute alignment errors (N, 3), eq. (7), metres.

    Each is the vector between the centres of the second camera at the end of a motion, as both cameras' motions predict
    it, in the frame of the first camera at the beginning; ``t = -R^T T`` is that centre in the first camera's frame.
    """
    R_1_t = np.einsum("nji,nj->ni", parts.R_1, t - parts.T_1)  # R_1^T (t - T_1)
    return np.asarray(_moved(parts) @ R + R_1_t - t)


def _moved(parts: PoseParts) -> Float:
    """Return ``R_2^T T_2`` (N, 3)."""
    return np.asarray(np.einsum("nji,nj->ni", parts.R_2, parts.T_2))


def jacobians(parts: PoseParts, R: Float) -> Float:
    """Differentiate the alignment errors (N, 3, 6) with respect to ``[dt, dq]``; dq is half a left rotation vector."""
    made = np.empty((len(parts.R_1), 3, 6))
    made[:, :, :3] = np.swapaxes(parts.R_1, 1, 2) - np.eye(3)
    made[:, :, 3:] = _by_turn(R, _moved_crosses(parts))
    return made


def _by_turn(R: Float, crosses: Float) -> Float:
    """Differentiate the alignment errors with respect to dq: (N, 3, 3)."""
    return np.asarray(2.0 * np.einsum("ji,njk->nik", R, crosses))  # 2 R^T [R_2^T T_2]_x


def _moved_crosses(parts: PoseParts) -> Float:
    """Return the matrices (N, 3, 3) of the cross products with ``R_2^T T_2``."""
    return _crosses(_moved(parts))  # [R_2^T T_2]_x


def refine(parts: PoseParts, R: Float, t: Float, noise_rad: float = 0.0) -> tuple[Float, Float]:
    """Minimise the sum of squared alignment errors by Levenberg-Marquardt, from R (3, 3) and t (3,).

    Components of t that the rotations do not determine stay as they are, see `translation`.
    """
    damping, turned = _FIRST_DAMPING, _turned_axes(parts, noise_rad)
    errors = alignment_errors(parts, R, t)
    cost = float(np.sum(errors**2))
    by_t, crosses = jacobians(parts, R)[:, :, :3] @ turned, _moved_crosses(parts)  # these depend on neither R nor t
    for _ in range(_ITERATIONS):
        J = np.concatenate([by_t, _by_turn(R, crosses)], axis=2).reshape(-1, turned.shape[1] + 3)
        normal, gradient = J.T @ J, J.T @ errors.ravel()
        damped = normal + damping * np.diag(normal.diagonal() + _TINY * normal.trace())
        step = -np.linalg.lstsq(damped, gradient, rcond=1e-15)[0]
        next_R = so3_exp(np.asarray(2.0 * step[-3:], dtype=np.float64)) @ R
        next_t = t + turned @ step[:-3]
        next_errors = alignment_errors(parts, next_R, next_t)
        next_cost = float(np.sum(next_errors**2))
        if next_cost <= cost:
            R, t, errors, cost = next_R, next_t, next_errors, next_cost
            damping *= _LOOSER
        else:
            damping *= _STIFFER
        if np.abs(step).max() < _MIN_STEP:
            break
    return R, t


def _turned_axes(parts: PoseParts, noise_rad: float) -> Float:
    """Return the orthonormal directions (3, K), in left1, in which the rotations determine t."""
    _, sizes, right = np.linalg.svd((np.swapaxes(parts.R_1, 1, 2) - np.eye(3)).reshape(-1, 3), full_matrices=False)
    return np.asarray(right[sizes > _min_singular_value(sizes, len(parts.R_1), noise_rad)].T)


def _min_singular_value(sizes: Float, count: int, noise_rad: float) -> float:
    """Return the smallest singular value of N rotations less the identity that noise does not explain."""
    return max(_MIN_TURNED * noise_rad * float(np.sqrt(count)), _TINY * float(sizes[0]))


class _Weighted:
    """Pose pairs, with alignment errors that are weighted by the motions' covariances."""

    def __init__(self, pairs: PosePairs) -> None:
        self.parts = PoseParts.of(pairs)
        self.turns = np.linalg.norm(pairs.rotations_rad, axis=1)
        variances = [np.trace(each[:, :3, :3], axis1=1, axis2=2) for each in (pairs.covariance_1, pairs.covariance_2)]
        self.noise_rad = float(np.sqrt(np.median(variances) / 3.0))
        self._moved, self._covariance_1 = _moved(self.parts), np.ascontiguousarray(pairs.covariance_1)
        R_2 = pairs.motion_2[:, :3, :3]
        self._covariance_2 = R_2 @ pairs.covariance_2[:, 3:, 3:] @ np.swapaxes(R_2, 1, 2)

    def distances(self, R: Float, t: Float) -> Float:
        """Return squared Mahalanobis distances (N,) of the alignment errors from zero."""
        errors = alignment_errors_of(self.parts.R_1, self.parts.T_1, self._moved, R, t)
        return squared_lengths_of(errors, self.parts.R_1, self._covariance_1, self._covariance_2, R, t)

    def costs(self, R: Float, t: Float, limit: float) -> Float:
        """Return the sums (M,) of the `distances`, each truncated at a limit, for M solutions."""
        return np.array([np.minimum(self.distances(*each), limit).sum() for each in zip(R, t, strict=True)])


def _best_triples(weighted: _Weighted, rng: np.random.Generator) -> list[tuple[Float, Float]]:
    """Return rotations and t by the triples with the lowest cost, the best first."""
    parts, turns = weighted.parts, weighted.turns
    normals = _normal_matrices(parts.R_1, parts.R_2)
    fit = np.flatnonzero((turns > _MIN_TURN) & (turns < _MAX_TURN))
    if len(fit) < MIN_PAIRS:
        raise CalibrationError(
            f"{len(fit)} of {len(turns)} motions turn by more than {np.rad2deg(_MIN_TURN):g} degrees, and {MIN_PAIRS} "
            "are needed: without rotation the poses of the cameras cannot be found; turn the rig about two axes"
        )
    triples = rng.permuted(np.broadcast_to(fit, (_TRIPLES, len(fit))), axis=1)[:, :MIN_PAIRS]
    _, vectors = np.linalg.eigh(normals[triples].sum(axis=1))
    R = np.array([rotation_from_quat_wxyz(np.ascontiguousarray(q)) for q in vectors[:, :, 0]])
    T = translations(R, PoseParts(*(part[triples] for part in parts)), weighted.noise_rad)
    t = np.array([-each.T @ of_each for each, of_each in zip(R, T, strict=True)])
    best = np.argsort(weighted.costs(R, t, _TRIPLE_LIMIT), kind="stable")[:_CANDIDATES]
    return [(R[k], t[k]) for k in best]


def _refined_on_inliers(weighted: _Weighted, R: Float, t: Float) -> tuple[float, Float, Float]:
    """Alternate between inliers and solution until the inliers stay the same; return the cost, R and t."""
    before = None
    for number in range(_ROUNDS):
        inlier = weighted.distances(R, t) < (_TRIPLE_LIMIT if number == 0 else _LIMIT)
        if inlier.sum() < MIN_PAIRS or (before is not None and np.array_equal(inlier, before)):
            break
        chosen, before = weighted.parts.select(inlier), inlier
        if number == 0:
            R, _ = rotation(chosen.R_1, chosen.R_2)
            t = -R.T @ translation(R, chosen, weighted.noise_rad)
        R, t = refine(chosen, R, t, weighted.noise_rad)
    return float(np.minimum(weighted.distances(R, t), _LIMIT).sum()), R, t


def _normal_matrices(R_1: Float, R_2: Float) -> Float:
    """Return ``C_k^T C_k`` (N, 4, 4) of eq. (9); with Hamilton's product eq. (5) reads ``q q_1 = q_2 q``.

    Quaternions with a positive real part have signs that agree, as both rotations turn by the same angle.
    """
    q_1, q_2 = (np.array([quat_wxyz_from_rotation(np.ascontiguousarray(R)) for R in each]) for each in (R_1, R_2))
    C = _product_matrices(q_1, "right") - _product_matrices(q_2, "left")
    return np.asarray(np.swapaxes(C, 1, 2) @ C)


def _product_matrices(quats_wxyz: Float, side: Literal["left", "right"]) -> Float:
    """Return the matrices (N, 4, 4) of the product with quaternions from the left or from the right."""
    sign = 1.0 if side == "left" else -1.0
    made = np.empty((len(quats_wxyz), 4, 4))
    w, v = quats_wxyz[:, 0], quats_wxyz[:, 1:]
    made[:, 0, 0], made[:, 0, 1:], made[:, 1:, 0] = w, -v, v
    made[:, 1:, 1:] = w[:, None, None] * np.eye(3) + sign * _crosses(v)
    return made


def _crosses(vectors: Float) -> Float:
    """Return the matrices (N, 3, 3) of the cross products with vectors (N, 3)."""
    x, y, z = vectors.T
    zero = np.zeros(len(vectors))
    return np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
