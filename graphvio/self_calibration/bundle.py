"""Bundle adjustment of a window of keyframes, with the calibration of all cameras as shared unknowns.

A landmark is ``[a, b, w]``, the homogeneous point ``[a, b, 1, w]`` of a frame of its own, that of the left camera which
saw it first as it was last estimated: `w` is its inverse depth there. Keyframe k sees it by a pair's left camera as
``left_T_body inverse(odom_T_body_k) odom_T_landmark [a, b, 1, w]``, and by the right one through ``right_T_left``.
Landmarks are eliminated one after the other (Schur complement), so that poses and calibration remain:
B. Triggs et al., *Bundle adjustment: a modern synthesis*, 2000, section 6.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.kernels import kernel, vector_kernel
from graphvio.self_calibration.moving_landmarks import move_landmark
from graphvio.self_calibration.observation import COLUMNS, ERROR_AT, POINT, POINT_AT, POSE, new_scratch, observe
from graphvio.self_calibration.parameters import PAIR, RigCalibration

_ERROR2_BEHIND = 1e6  # squared whitened error of a landmark behind the camera
_MAX_FARTHER = 0.5  # see `move_landmark`: stereo cameras see points that are nearly at infinity


class Tracks(NamedTuple):
    """Observations of L landmarks in K keyframes: N rows, sorted by landmark.

    Attributes:
        pair: (L,) index of the pair or single camera that sees each landmark.
        odom_T_landmark: (L, 4, 4) frame of each landmark.
        rows: (L + 1,) the observations of landmark l are ``rows[l]`` to ``rows[l + 1]``.
        keyframe: (N,) index of the keyframe.
        left_px: (N, 2) pixels in the left image.
        right_px: (N, 2) pixels in the right image; meaningful where ``has_right``.
        has_right: (N,) whether the landmark was found there.
        sigma_px: (N,) noise of each observation's corners.
    """

    pair: Int
    odom_T_landmark: Float
    rows: Int
    keyframe: Int
    left_px: Float
    right_px: Float
    has_right: Bool
    sigma_px: Float

    def of(self, kept: Bool) -> "Tracks":
        """Return the tracks of the landmarks (L,) that are kept."""
        rows, begins = rows_of(self.rows, kept)
        return Tracks(
            self.pair[kept],
            self.odom_T_landmark[kept],
            begins,
            self.keyframe[rows],
            self.left_px[rows],
            self.right_px[rows],
            self.has_right[rows],
            self.sigma_px[rows],
        )


def rows_of(rows: Int, kept: Bool) -> tuple[Bool, Int]:
    """Return which observations (N,) belong to the landmarks (L,) that are kept, and where these landmarks' begin.

    Args:
        rows: (L + 1,) the observations of landmark l are ``rows[l]`` to ``rows[l + 1]``.
        kept: (L,).
    """
    lengths = np.diff(rows)
    return np.repeat(kept, lengths), np.r_[0, np.cumsum(lengths[kept])]


class Eliminated(NamedTuple):
    """Terms of the landmarks' elimination, from which the landmarks' own step follows.

    Attributes:
        inverse: (L, 3, 3) inverse of each landmark's normal matrix.
        gradient: (L, 3) gradient of the cost with respect to each landmark.
        by_calibration: (L, 3, PAIR) coupling with the pair's calibration.
        by_pose: (N, 3, 6) coupling of each observation with its keyframe.
    """

    inverse: Float
    gradient: Float
    by_calibration: Float
    by_pose: Float

    @staticmethod
    def empty(tracks: Tracks) -> "Eliminated":
        """Allocate for some tracks."""
        n_landmarks = len(tracks.pair)
        return Eliminated(
            np.zeros((n_landmarks, 3, 3)),
            np.zeros((n_landmarks, 3)),
            np.zeros((n_landmarks, 3, PAIR)),
            np.zeros((len(tracks.keyframe), 3, 6)),
        )


@vector_kernel
def eliminate_landmarks(
    poses: Float, calibration: RigCalibration, landmarks: Float, tracks: Tracks, scale: float, damping: float,
    hessian: Float, gradient: Float, eliminated: Eliminated,
) -> tuple[float, Float]:  # fmt: skip
    """Add the normal equations of poses and calibration by the reprojection errors, with the landmarks eliminated.

    Args:
        poses: (K, 4, 4) ``odom_T_body``; perturbed on the right, ``R Exp(r)``, ``p + R t``.
        calibration: calibration of P pairs and single cameras.
        landmarks: (L, 3).
        tracks: observations of the landmarks.
        scale: scale of the Cauchy cost, in whitened units.
        damping: damping of the landmarks' normal matrices, relative.
        hessian: (6 K + P PAIR, 6 K + P PAIR), upper and lower triangle, is added to.
        gradient: (6 K + P PAIR,) is added to.
        eliminated: output.

    Returns:
        Robust cost of all errors, and the squared whitened error of each image's observation (N, 2), NaN without one.
    """
    n_poses = 6 * len(poses)
    rows, weighted, line = np.zeros((4, COLUMNS)), np.zeros((4, COLUMNS)), np.zeros(COLUMNS)
    totals, of_poses = np.zeros((PAIR + POINT, COLUMNS)), np.zeros((3, n_poses))
    scratch, errors2, cost = new_scratch(), np.full((len(tracks.keyframe), 2), np.nan), 0.0
    for point in range(len(landmarks)):
        at = n_poses + PAIR * tracks.pair[point]
        for c in range(PAIR + POINT):
            for d in range(COLUMNS):
                totals[c, d] = 0.0
        for n in range(tracks.rows[point], tracks.rows[point + 1]):
            filled = observe(
                poses[tracks.keyframe[n]], calibration, tracks.pair[point], tracks.odom_T_landmark[point],
                landmarks[point], tracks.left_px[n], tracks.right_px[n], tracks.has_right[n], scratch, rows,
            )  # fmt: skip
            cost += _weigh(rows, filled, tracks.has_right[n], tracks.sigma_px[n], scale, weighted, errors2[n])
            _add(rows, weighted, 6 * tracks.keyframe[n], at, line, hessian, gradient, eliminated.by_pose[n], totals)
        _eliminate(point, at, tracks, totals, damping, of_poses, hessian, gradient, eliminated)
    for c in range(len(gradient)):
        for d in range(c):
            hessian[c, d] = hessian[d, c]
    return cost, errors2


@vector_kernel
def _weigh(
    rows: Float, filled: int, has_right: bool, sigma_px: float, scale: float, weighted: Float, errors2: Float
) -> float:
    """Multiply the rows (4, COLUMNS) of an observation by their weight; rows that are not filled become zero.

    Returns:
        Their cost; ``errors2`` (2,) becomes the squared whitened error in each image.
    """
    cost = 0.0
    for r in range(4):
        for c in range(COLUMNS):
            weighted[r, c] = 0.0
    for r in range(0, 4 if has_right else 2, 2):
        du, dv = rows[r, ERROR_AT], rows[r + 1, ERROR_AT]
        e2 = (du * du + dv * dv) / (sigma_px * sigma_px) if r < filled else _ERROR2_BEHIND
        errors2[r // 2] = e2
        cost += 0.5 * scale * scale * np.log(1.0 + e2 / (scale * scale))
        if r >= filled:
            continue
        weight = 1.0 / ((1.0 + e2 / (scale * scale)) * sigma_px * sigma_px)
        for one in (r, r + 1):
            for c in range(COLUMNS):
                weighted[one, c] = weight * rows[one, c]
    return cost


@vector_kernel
def _add(
    rows: Float, weighted: Float, at_pose: int, at_pair: int, line: Float, hessian: Float, gradient: Float,
    by_pose: Float, totals: Float,
) -> None:  # fmt: skip
    """Add one observation: to the equations of its pose, and to the sums of its landmark.

    Args:
        rows: (4, COLUMNS) rows of the observation, see `observe`.
        weighted: the same times its weight.
        at_pose: column of the pose in the normal equations.
        at_pair: column of the pair's calibration.
        line: (COLUMNS,) scratch.
        hessian: is added to.
        gradient: is added to.
        by_pose: (3, 6) output, coupling of the landmark with the pose.
        totals: (PAIR + POINT, COLUMNS) sums over the landmark's observations, of all but the poses.
    """
    (r0, r1, r2, r3), (w0, w1, w2, w3) = _lines(rows), _lines(weighted)
    for c in range(POSE):
        a0, a1, a2, a3 = w0[c], w1[c], w2[c], w3[c]
        for d in range(COLUMNS):
            line[d] = a0 * r0[d] + a1 * r1[d] + a2 * r2[d] + a3 * r3[d]
        gradient[at_pose + c] += line[ERROR_AT]
        for d in range(c, POSE):
            hessian[at_pose + c, at_pose + d] += line[d]
        for d in range(PAIR):
            hessian[at_pose + c, at_pair + d] += line[POSE + d]
        for d in range(3):
            by_pose[d, c] = line[POINT_AT + d]
    for c in range(POSE, ERROR_AT):
        a0, a1, a2, a3, total = w0[c], w1[c], w2[c], w3[c], totals[c - POSE]
        if a0 != 0.0 or a1 != 0.0:
            for d in range(COLUMNS):
                total[d] += a0 * r0[d] + a1 * r1[d] + a2 * r2[d] + a3 * r3[d]
        elif a2 != 0.0 or a3 != 0.0:  # parameters of the right image alone
            for d in range(COLUMNS):
                total[d] += a2 * r2[d] + a3 * r3[d]


@vector_kernel
def _eliminate(
    point: int, at: int, tracks: Tracks, totals: Float, damping: float, of_poses: Float, hessian: Float,
    gradient: Float, eliminated: Eliminated,
) -> None:  # fmt: skip
    """Eliminate a landmark, and add its observations to the equations of the pair's calibration.

    Args:
        point: index of the landmark.
        at: column of the pair's calibration in the normal equations.
        tracks: observations of all landmarks.
        totals: sums over its observations, see `_add`.
        damping: damping of its normal matrix, relative.
        of_poses: (3, 6 K) scratch.
        hessian: is changed.
        gradient: is changed.
        eliminated: output; its couplings of the landmark with the poses are input.
    """
    first, last = tracks.rows[point], tracks.rows[point + 1]
    v, vb, vwc = np.zeros((3, 3)), np.zeros(3), np.zeros((3, PAIR))
    inverse, bl = eliminated.inverse[point], eliminated.gradient[point]
    t0, t1, t2 = of_poses[0], of_poses[1], of_poses[2]
    wc = eliminated.by_calibration[point]
    for c in range(PAIR):
        gradient[at + c] += totals[c, ERROR_AT]
        for d in range(3):
            wc[d, c] = totals[c, POINT_AT + d]
    for c in range(3):
        bl[c] = totals[PAIR + c, ERROR_AT]
        for d in range(c, 3):
            v[c, d] = totals[PAIR + c, POINT_AT + d]
        v[c, c] = v[c, c] * (1.0 + damping) + 1e-9
    inverse3(v, inverse)
    for r in range(3):
        vb[r] = inverse[r, 0] * bl[0] + inverse[r, 1] * bl[1] + inverse[r, 2] * bl[2]
        for c in range(PAIR):
            vwc[r, c] = inverse[r, 0] * wc[0, c] + inverse[r, 1] * wc[1, c] + inverse[r, 2] * wc[2, c]
    for c in range(PAIR):
        gradient[at + c] -= wc[0, c] * vb[0] + wc[1, c] * vb[1] + wc[2, c] * vb[2]
        for d in range(c, PAIR):
            hessian[at + c, at + d] += (
                totals[c, POSE + d] - wc[0, c] * vwc[0, d] - wc[1, c] * vwc[1, d] - wc[2, c] * vwc[2, d]
            )
    # The landmark's inverse normal matrix times its couplings, for all poses from its first to its last: zero where
    # it was not seen, so that one long loop subtracts what belongs to a row.
    end = 6 * tracks.keyframe[last - 1] + POSE if last > first else 0
    for c in range(6 * tracks.keyframe[first] if last > first else 0, end):
        t0[c] = t1[c] = t2[c] = 0.0
    for n in range(first, last):
        k, wp = 6 * tracks.keyframe[n], eliminated.by_pose[n]
        for r in range(3):
            for c in range(POSE):
                of_poses[r, k + c] = inverse[r, 0] * wp[0, c] + inverse[r, 1] * wp[1, c] + inverse[r, 2] * wp[2, c]
    for n in range(first, last):
        k, wp = 6 * tracks.keyframe[n], eliminated.by_pose[n]
        for c in range(POSE):
            a0, a1, a2 = wp[0, c], wp[1, c], wp[2, c]
            gradient[k + c] -= a0 * vb[0] + a1 * vb[1] + a2 * vb[2]
            row = hessian[k + c]
            for d in range(PAIR):
                row[at + d] -= a0 * vwc[0, d] + a1 * vwc[1, d] + a2 * vwc[2, d]
            for d in range(k + c, end):
                row[d] -= a0 * t0[d] + a1 * t1[d] + a2 * t2[d]


@kernel
def _lines(rows: Float) -> tuple[Float, Float, Float, Float]:
    """Return the four rows of a matrix."""
    return rows[0], rows[1], rows[2], rows[3]


@kernel
def inverse3(m: Float, out: Float) -> None:
    """Invert a symmetric matrix (3, 3), given by its upper triangle."""
    a, b, c, d, e, f = m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]
    x, y, z = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * x + b * y + c * z
    out[0, 0], out[0, 1], out[0, 2] = x / determinant, y / determinant, z / determinant
    out[1, 1], out[1, 2] = (a * f - c * c) / determinant, (b * c - a * e) / determinant
    out[2, 2] = (a * d - b * b) / determinant
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


@kernel
def landmarks_after(
    landmarks: Float, tracks: Tracks, calibration: RigCalibration, poses: Float, moved_poses: Float,
    eliminated: Eliminated, step: Float,
) -> tuple[Float, Float]:  # fmt: skip
    """Return the landmarks (L, 3) after a step of poses and calibration, and their frames (L, 4, 4).

    A landmark moves along with the camera that sees it first, see `graphvio.self_calibration.moving_landmarks`.

    Args:
        landmarks: (L, 3) before.
        tracks: observations of the landmarks.
        calibration: calibration of P pairs and single cameras, before.
        poses: (K, 4, 4) ``odom_T_body``, before.
        moved_poses: (K, 4, 4) after.
        eliminated: terms of the landmarks' elimination.
        step: (6 K + P PAIR,) step of poses and calibration.
    """
    moved, frames = np.empty_like(landmarks), tracks.odom_T_landmark.copy()
    b, work = np.zeros(3), np.zeros((4, 3))
    for point in range(len(landmarks)):
        first, end, at = tracks.rows[point], tracks.rows[point + 1], POSE * len(poses) + PAIR * tracks.pair[point]
        for r in range(3):
            b[r] = eliminated.gradient[point, r]
            for c in range(PAIR):
                b[r] += eliminated.by_calibration[point, r, c] * step[at + c]
            for n in range(first, end):
                k = POSE * tracks.keyframe[n]
                for c in range(POSE):
                    b[r] += eliminated.by_pose[n, r, c] * step[k + c]
        k, body_T_left = tracks.keyframe[first], calibration.body_T_left[tracks.pair[point]]
        move_landmark(
            frames[point], landmarks[point], eliminated.inverse[point], b, poses[k], moved_poses[k], body_T_left,
            step[POSE * k : POSE * k + POSE], _MAX_FARTHER, work, moved[point],
        )  # fmt: skip
    return moved, frames
