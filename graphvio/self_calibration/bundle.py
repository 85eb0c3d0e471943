"""Bundle adjustment of a window of keyframes, with the calibration of all cameras as shared unknowns.

A landmark is ``[a, b, w]``, the homogeneous point ``[a, b, 1, w]`` of a fixed frame, that of the left camera which saw
it first as it was estimated then: `w` is its inverse depth there. It is seen in keyframe k by a pair's left camera as
``left_T_body inverse(odom_T_body_k) odom_T_landmark [a, b, 1, w]``, and by the right one through ``right_T_left``.
Landmarks are eliminated one after the other (Schur complement), so that poses and calibration remain:
B. Triggs et al., *Bundle adjustment: a modern synthesis*, 2000, section 6.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.cameras import distort, distortion_basis
from graphvio.kernels import kernel, put, vector_kernel
from graphvio.self_calibration.parameters import (
    BODY,
    CAMERA,
    DISTORTION,
    INTRINSICS,
    PAIR,
    RIGHT,
    STEREO,
    RigCalibration,
)

POSE, POINT = 6, 3
_POINT_AT = POSE + PAIR
_ERROR_AT = _POINT_AT + POINT
_COLUMNS = _ERROR_AT + 1
_ERROR2_BEHIND = 1e6  # of a landmark behind the camera
_MIN_DEPTH_RATIO = 1e-3


class Tracks(NamedTuple):
    """Observations of L landmarks in K keyframes: N rows, sorted by landmark.

    Attributes:
        pair: (L,) index of the pair or single camera that sees each landmark.
        odom_T_landmark: (L, 4, 4) fixed frame of each.
        rows: (L + 1,) the observations of landmark l are ``rows[l]`` to ``rows[l + 1]``.
        keyframe: (N,) index.
        left_px: (N, 2).
        right_px: (N, 2).
        has_right: (N,).
    """

    pair: Int
    odom_T_landmark: Float
    rows: Int
    keyframe: Int
    left_px: Float
    right_px: Float
    has_right: Bool

    def of(self, kept: Bool) -> "Tracks":
        """Return those of the landmarks (L,) that are kept."""
        rows, begins = rows_of(self.rows, kept)
        return Tracks(
            self.pair[kept],
            self.odom_T_landmark[kept],
            begins,
            self.keyframe[rows],
            self.left_px[rows],
            self.right_px[rows],
            self.has_right[rows],
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
    """What the elimination of the landmarks leaves behind, to find them again.

    Attributes:
        inverse: (L, 3, 3) of their normal matrices.
        gradient: (L, 3).
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


class _Scratch(NamedTuple):
    """Intermediate results of `_observe`, which would be allocated for each observation."""

    of_point: tuple[Float, Float, Float, Float, Float, Float]
    of_pixel: tuple[Float, Float, Float, Float, Float]
    error: Float


@kernel
def _scratch() -> _Scratch:
    """Allocate intermediate results."""
    return _Scratch(
        (np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))),
        (np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, CAMERA))),
        np.empty(2),
    )


@kernel
def _project(
    calibration: RigCalibration, j: int, image: int, y: Float, seen: Float, to_pixel: Float, error: Float,
    by_camera: Float,
) -> bool:  # fmt: skip
    """Project a homogeneous point (3,): the error (2,), its derivatives by the point (2, 3) and the camera (2, 9)."""
    if not y[2] > _MIN_DEPTH_RATIO:
        return False
    model, intrinsics, distortion = (
        calibration.models[j, image], calibration.intrinsics[j, image], calibration.distortion[j, image],
    )  # fmt: skip
    a, b = y[0] / y[2], y[1] / y[2]
    u, v, uu, uv, vu, vv = distort(model, distortion, a, b)
    if not (uu > 0.0 and uu * vv - uv * vu > 0.0):
        return False
    fx, fy = intrinsics[0], intrinsics[1]
    error[0], error[1] = fx * u + intrinsics[2] - seen[0], fy * v + intrinsics[3] - seen[1]
    inverse = 1.0 / y[2]
    to_pixel[0, 0], to_pixel[0, 1] = fx * uu * inverse, fx * uv * inverse
    to_pixel[1, 0], to_pixel[1, 1] = fy * vu * inverse, fy * vv * inverse
    to_pixel[0, 2] = -(a * to_pixel[0, 0] + b * to_pixel[0, 1])
    to_pixel[1, 2] = -(a * to_pixel[1, 0] + b * to_pixel[1, 1])
    by_camera[0, 0], by_camera[0, 1], by_camera[0, 2], by_camera[0, 3] = u, 0.0, 1.0, 0.0
    by_camera[1, 0], by_camera[1, 1], by_camera[1, 2], by_camera[1, 3] = 0.0, v, 0.0, 1.0
    basis = distortion_basis(model, distortion, a, b)
    for i in range(DISTORTION):
        by_camera[0, INTRINSICS + i], by_camera[1, INTRINSICS + i] = fx * basis[i, 0], fy * basis[i, 1]
    return True


@kernel
def _turned(v: Float, matrix: Float, out: Float) -> None:
    """Multiply a matrix (2, 3) by ``skew(v)`` into ``out`` (2, 3)."""
    for r in range(2):
        out[r, 0] = matrix[r, 1] * v[2] - matrix[r, 2] * v[1]
        out[r, 1] = matrix[r, 2] * v[0] - matrix[r, 0] * v[2]
        out[r, 2] = matrix[r, 0] * v[1] - matrix[r, 1] * v[0]


@kernel
def _observe(
    pose: Float, calibration: RigCalibration, j: int, odom_T_landmark: Float, landmark: Float,
    left_px: Float, right_px: Float, has_right: bool, scratch: _Scratch, rows: Float,
) -> int:  # fmt: skip
    """Fill the rows (4, _COLUMNS) of one observation: derivatives by pose, calibration and landmark, and errors.

    Loops stand for slices throughout: each slice that is assigned takes seconds to compile, in every kernel that calls.

    Returns:
        The number of rows that were filled: 0, 2 or 4, pixels of the left image first.
    """
    for r in range(4):
        for c in range(_COLUMNS):
            rows[r, c] = 0.0
    a, b, w = landmark[0], landmark[1], landmark[2]
    frame, left, right = odom_T_landmark, calibration.body_T_left[j], calibration.right_T_left[j]
    in_odom, in_body, in_left_body, in_camera, by_point, left_by_point = scratch.of_point
    to_pixel, by_left, by_body, turned, by_camera = scratch.of_pixel
    error, seen = scratch.error, left_px
    for r in range(3):
        in_odom[r] = frame[r, 0] * a + frame[r, 1] * b + frame[r, 2] + w * (frame[r, 3] - pose[r, 3])
    for r in range(3):
        in_body[r] = pose[0, r] * in_odom[0] + pose[1, r] * in_odom[1] + pose[2, r] * in_odom[2]
        for c in range(2):
            by_point[r, c] = pose[0, r] * frame[0, c] + pose[1, r] * frame[1, c] + pose[2, r] * frame[2, c]
        by_point[r, 2] = (
            pose[0, r] * (frame[0, 3] - pose[0, 3])
            + pose[1, r] * (frame[1, 3] - pose[1, 3])
            + pose[2, r] * (frame[2, 3] - pose[2, 3])
            - left[r, 3]
        )
        in_left_body[r] = in_body[r] - w * left[r, 3]
    for r in range(3):
        in_camera[r] = left[0, r] * in_left_body[0] + left[1, r] * in_left_body[1] + left[2, r] * in_left_body[2]
        for c in range(3):
            left_by_point[r, c] = (
                left[0, r] * by_point[0, c] + left[1, r] * by_point[1, c] + left[2, r] * by_point[2, c]
            )
    for image in range(2 if has_right else 1):
        first = 2 * image
        in_left_x, in_left_y, in_left_z = in_camera[0], in_camera[1], in_camera[2]
        if image == 1:
            seen = right_px
            for r in range(3):
                in_camera[r] = (
                    right[r, 0] * in_left_x + right[r, 1] * in_left_y + right[r, 2] * in_left_z + w * right[r, 3]
                )
        if not _project(calibration, j, image, in_camera, seen, to_pixel, error, by_camera):
            return first
        for r in range(2):
            rows[first + r, _ERROR_AT] = error[r]
            for c in range(CAMERA):
                rows[first + r, POSE + image * RIGHT + c] = by_camera[r, c]
            for c in range(3):
                by_left[r, c] = to_pixel[r, c]
                if image == 1:
                    by_left[r, c] = (
                        to_pixel[r, 0] * right[0, c] + to_pixel[r, 1] * right[1, c] + to_pixel[r, 2] * right[2, c]
                    )
        for r in range(2):
            for c in range(3):
                by_body[r, c] = by_left[r, 0] * left[c, 0] + by_left[r, 1] * left[c, 1] + by_left[r, 2] * left[c, 2]
                rows[first + r, _POINT_AT + c] = (
                    by_left[r, 0] * left_by_point[0, c]
                    + by_left[r, 1] * left_by_point[1, c]
                    + by_left[r, 2] * left_by_point[2, c]
                )
                rows[first + r, 3 + c] = rows[first + r, POSE + BODY + 3 + c] = -w * by_body[r, c]
        _turned(in_body, by_body, turned)
        for r in range(2):
            for c in range(3):
                rows[first + r, c] = turned[r, c]
        _turned(in_left_body, by_body, turned)
        for r in range(2):
            for c in range(3):
                rows[first + r, POSE + BODY + c] = turned[r, c]
        if image == 1:
            in_camera[0], in_camera[1], in_camera[2] = in_left_x, in_left_y, in_left_z
            _turned(in_camera, by_left, turned)
            for r in range(2):
                rows[first + r, _POINT_AT + 2] += (
                    to_pixel[r, 0] * right[0, 3] + to_pixel[r, 1] * right[1, 3] + to_pixel[r, 2] * right[2, 3]
                )
                for c in range(3):
                    rows[first + r, POSE + STEREO + c] = -turned[r, c]
                    rows[first + r, POSE + STEREO + 3 + c] = w * to_pixel[r, c]
    return 4 if has_right else 2


@vector_kernel
def eliminate_landmarks(
    poses: Float, calibration: RigCalibration, landmarks: Float, tracks: Tracks, sigma_px: float, scale: float,
    damping: float, hessian: Float, gradient: Float, eliminated: Eliminated,
) -> tuple[float, Float]:  # fmt: skip
    """Add the normal equations of poses and calibration, landmarks eliminated.

    Args:
        poses: (K, 4, 4) ``odom_T_body``; perturbed on the right, ``R Exp(r)``, ``p + R t``.
        calibration: of P pairs.
        landmarks: (L, 3).
        tracks: of these.
        sigma_px: noise of a corner's position.
        scale: of the Cauchy cost, in whitened units.
        damping: of the landmarks' normal matrices, relative.
        hessian: (6 K + P PAIR, 6 K + P PAIR), upper and lower triangle, is added to.
        gradient: (6 K + P PAIR,) is added to.
        eliminated: output.

    Returns:
        Robust cost of all errors, and the squared whitened error of each image's observation (N, 2), NaN without one.
    """
    n_poses = 6 * len(poses)
    rows, weighted, line = np.zeros((4, _COLUMNS)), np.zeros((4, _COLUMNS)), np.zeros(_COLUMNS)
    (r0, r1, r2, r3), (w0, w1, w2, w3) = _lines(rows), _lines(weighted)
    totals, of_poses = np.zeros((PAIR + POINT, _COLUMNS)), np.zeros((3, n_poses))
    vb, vwc, scratch = np.zeros(3), np.zeros((3, PAIR)), _scratch()
    t0, t1, t2 = of_poses[0], of_poses[1], of_poses[2]
    errors2, cost = np.full((len(tracks.keyframe), 2), np.nan), 0.0
    for point in range(len(landmarks)):
        first, last = tracks.rows[point], tracks.rows[point + 1]
        at = n_poses + PAIR * tracks.pair[point]
        v, bl = np.zeros((3, 3)), np.zeros(3)
        wc = eliminated.by_calibration[point]
        for c in range(PAIR + POINT):
            for d in range(_COLUMNS):
                totals[c, d] = 0.0
        for n in range(first, last):
            k, wp = 6 * tracks.keyframe[n], eliminated.by_pose[n]
            filled = _observe(
                poses[tracks.keyframe[n]], calibration, tracks.pair[point], tracks.odom_T_landmark[point],
                landmarks[point], tracks.left_px[n], tracks.right_px[n], tracks.has_right[n], scratch, rows,
            )  # fmt: skip
            for c in range(_COLUMNS):
                w0[c] = w1[c] = w2[c] = w3[c] = 0.0
            for r in range(0, 4 if tracks.has_right[n] else 2, 2):
                du, dv = rows[r, _ERROR_AT], rows[r + 1, _ERROR_AT]
                e2 = (du * du + dv * dv) / (sigma_px * sigma_px) if r < filled else _ERROR2_BEHIND
                errors2[n, r // 2] = e2
                cost += 0.5 * scale * scale * np.log(1.0 + e2 / (scale * scale))
                if r >= filled:
                    continue
                weight = 1.0 / ((1.0 + e2 / (scale * scale)) * sigma_px * sigma_px)
                for one in (r, r + 1):
                    for c in range(_COLUMNS):
                        weighted[one, c] = weight * rows[one, c]
            for c in range(POSE):
                a0, a1, a2, a3 = w0[c], w1[c], w2[c], w3[c]
                for d in range(_COLUMNS):
                    line[d] = a0 * r0[d] + a1 * r1[d] + a2 * r2[d] + a3 * r3[d]
                gradient[k + c] += line[_ERROR_AT]
                for d in range(c, POSE):
                    hessian[k + c, k + d] += line[d]
                for d in range(PAIR):
                    hessian[k + c, at + d] += line[POSE + d]
                for d in range(3):
                    wp[d, c] = line[_POINT_AT + d]
            for c in range(POSE, _ERROR_AT):
                a0, a1, a2, a3, total = w0[c], w1[c], w2[c], w3[c], totals[c - POSE]
                if a0 != 0.0 or a1 != 0.0:
                    for d in range(_COLUMNS):
                        total[d] += a0 * r0[d] + a1 * r1[d] + a2 * r2[d] + a3 * r3[d]
                elif a2 != 0.0 or a3 != 0.0:  # what belongs to the right image alone
                    for d in range(_COLUMNS):
                        total[d] += a2 * r2[d] + a3 * r3[d]
        for c in range(PAIR):
            gradient[at + c] += totals[c, _ERROR_AT]
            for d in range(3):
                wc[d, c] = totals[c, _POINT_AT + d]
        for c in range(3):
            bl[c] = totals[PAIR + c, _ERROR_AT]
            for d in range(c, 3):
                v[c, d] = totals[PAIR + c, _POINT_AT + d]
        for c in range(3):
            v[c, c] = v[c, c] * (1.0 + damping) + 1e-9
            for d in range(c):
                v[c, d] = v[d, c]
        inverse = _inverse3(v)
        put(eliminated.inverse[point], inverse)
        put(eliminated.gradient[point], bl)
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
    for c in range(len(gradient)):
        for d in range(c):
            hessian[c, d] = hessian[d, c]
    return cost, errors2


@kernel
def _lines(rows: Float) -> tuple[Float, Float, Float, Float]:
    """Return the four lines of a matrix."""
    return rows[0], rows[1], rows[2], rows[3]


@kernel
def _inverse3(m: Float) -> Float:
    """Invert a symmetric matrix (3, 3)."""
    out = np.empty((3, 3))
    a, b, c, d, e, f = m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]
    x, y, z = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * x + b * y + c * z
    out[0, 0], out[0, 1], out[0, 2] = x / determinant, y / determinant, z / determinant
    out[1, 1], out[1, 2] = (a * f - c * c) / determinant, (b * c - a * e) / determinant
    out[2, 2] = (a * d - b * b) / determinant
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return out


@kernel
def landmarks_after(landmarks: Float, tracks: Tracks, eliminated: Eliminated, step: Float, n_keyframes: int) -> Float:
    """Return the landmarks (L, 3) after a step (6 K + P PAIR,) of poses and calibration."""
    moved = landmarks.copy()
    for point in range(len(landmarks)):
        at = 6 * n_keyframes + PAIR * tracks.pair[point]
        b = eliminated.gradient[point].copy()
        for r in range(3):
            for c in range(PAIR):
                b[r] += eliminated.by_calibration[point, r, c] * step[at + c]
            for n in range(tracks.rows[point], tracks.rows[point + 1]):
                k = 6 * tracks.keyframe[n]
                for c in range(6):
                    b[r] += eliminated.by_pose[n, r, c] * step[k + c]
        for r in range(3):
            for c in range(3):
                moved[point, r] -= eliminated.inverse[point, r, c] * b[c]
    return moved
