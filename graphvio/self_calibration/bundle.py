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
from graphvio.kernels import kernel
from graphvio.self_calibration.parameters import (
    BODY,
    CAMERA,
    DISTORTION,
    INTRINSICS,
    LEFT,
    PAIR,
    RIGHT,
    STEREO,
    RigCalibration,
)

POSE, POINT = 6, 3
_POINT_AT = POSE + PAIR
_ERROR_AT = _POINT_AT + POINT
_COLUMNS = _ERROR_AT + 1
_MIN_DEPTH_RATIO = 1e-3


class Tracks(NamedTuple):
    """Observations of L landmarks in K keyframes: N rows, sorted by landmark.

    Attributes:
        pair: (L,) index of the pair that sees each landmark.
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
        lengths = np.diff(self.rows)
        rows = np.repeat(kept, lengths)
        return Tracks(
            self.pair[kept],
            self.odom_T_landmark[kept],
            np.r_[0, np.cumsum(lengths[kept])],
            self.keyframe[rows],
            self.left_px[rows],
            self.right_px[rows],
            self.has_right[rows],
        )


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


@kernel
def _project(
    model: int, intrinsics: Float, distortion: Float, y: Float, seen: Float, to_pixel: Float, error: Float,
    by_camera: Float,
) -> bool:  # fmt: skip
    """Project a homogeneous point (3,): the error (2,), its derivatives by the point (2, 3) and the camera (2, 9)."""
    if not y[2] > _MIN_DEPTH_RATIO:
        return False
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
    by_camera[:] = 0.0
    by_camera[0, 0], by_camera[1, 1], by_camera[0, 2], by_camera[1, 3] = u, v, 1.0, 1.0
    basis = distortion_basis(model, a, b)
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
    left_px: Float, right_px: Float, has_right: bool, rows: Float,
) -> int:  # fmt: skip
    """Fill the rows (4, _COLUMNS) of one observation: derivatives by pose, calibration and landmark, and errors.

    Returns:
        The number of rows that were filled: 0, 2 or 4, pixels of the left image first.
    """
    rows[:] = 0.0
    a, b, w = landmark
    frame_R, frame_t = odom_T_landmark[:3, :3], odom_T_landmark[:3, 3]
    body_R, body_t = pose[:3, :3], pose[:3, 3]
    left_R, left_t = calibration.body_T_left[j, :3, :3], calibration.body_T_left[j, :3, 3]
    in_body, by_point = np.empty(3), np.empty((3, 3))
    in_left_body, in_left, left_by_body, left_by_point = np.empty(3), np.empty(3), left_R.T, np.empty((3, 3))
    in_odom = np.empty(3)
    for r in range(3):
        in_odom[r] = frame_R[r, 0] * a + frame_R[r, 1] * b + frame_R[r, 2] + w * (frame_t[r] - body_t[r])
    for r in range(3):
        in_body[r] = body_R[0, r] * in_odom[0] + body_R[1, r] * in_odom[1] + body_R[2, r] * in_odom[2]
        by_point[r, 0] = body_R[0, r] * frame_R[0, 0] + body_R[1, r] * frame_R[1, 0] + body_R[2, r] * frame_R[2, 0]
        by_point[r, 1] = body_R[0, r] * frame_R[0, 1] + body_R[1, r] * frame_R[1, 1] + body_R[2, r] * frame_R[2, 1]
        by_point[r, 2] = (
            body_R[0, r] * (frame_t[0] - body_t[0])
            + body_R[1, r] * (frame_t[1] - body_t[1])
            + body_R[2, r] * (frame_t[2] - body_t[2])
            - left_t[r]
        )
        in_left_body[r] = in_body[r] - w * left_t[r]
    for r in range(3):
        in_left[r] = (
            left_by_body[r, 0] * in_left_body[0]
            + left_by_body[r, 1] * in_left_body[1]
            + left_by_body[r, 2] * in_left_body[2]
        )
        for c in range(3):
            left_by_point[r, c] = (
                left_by_body[r, 0] * by_point[0, c]
                + left_by_body[r, 1] * by_point[1, c]
                + left_by_body[r, 2] * by_point[2, c]
            )
    to_pixel, error, by_camera = np.empty((2, 3)), np.empty(2), np.empty((2, CAMERA))
    by_body, turned = np.empty((2, 3)), np.empty((2, 3))
    if not _project(
        calibration.models[j, 0], calibration.intrinsics[j, 0], calibration.distortion[j, 0], in_left, left_px,
        to_pixel, error, by_camera,
    ):  # fmt: skip
        return 0
    _fill(rows[:2], to_pixel, left_by_body, left_by_point, in_body, in_left_body, w, by_body, turned)
    rows[:2, POSE + LEFT : POSE + LEFT + CAMERA] = by_camera
    rows[:2, _ERROR_AT] = error
    if not has_right:
        return 2
    right_R, right_t = calibration.right_T_left[j, :3, :3], calibration.right_T_left[j, :3, 3]
    in_right = np.empty(3)
    for r in range(3):
        in_right[r] = (
            right_R[r, 0] * in_left[0] + right_R[r, 1] * in_left[1] + right_R[r, 2] * in_left[2] + w * right_t[r]
        )
    if not _project(
        calibration.models[j, 1], calibration.intrinsics[j, 1], calibration.distortion[j, 1], in_right, right_px,
        to_pixel, error, by_camera,
    ):  # fmt: skip
        return 2
    by_left = np.empty((2, 3))
    for r in range(2):
        for c in range(3):
            by_left[r, c] = (
                to_pixel[r, 0] * right_R[0, c] + to_pixel[r, 1] * right_R[1, c] + to_pixel[r, 2] * right_R[2, c]
            )
    _fill(rows[2:], by_left, left_by_body, left_by_point, in_body, in_left_body, w, by_body, turned)
    for r in range(2):
        rows[2 + r, _POINT_AT + 2] += (
            to_pixel[r, 0] * right_t[0] + to_pixel[r, 1] * right_t[1] + to_pixel[r, 2] * right_t[2]
        )
    rows[2:, POSE + RIGHT : POSE + RIGHT + CAMERA] = by_camera
    _turned(in_left, by_left, turned)
    rows[2:, POSE + STEREO : POSE + STEREO + 3] = -turned
    rows[2:, POSE + STEREO + 3 : POSE + STEREO + 6] = w * to_pixel
    rows[2:, _ERROR_AT] = error
    return 4


@kernel
def _fill(
    rows: Float, by_left: Float, left_by_body: Float, left_by_point: Float, in_body: Float, in_left_body: Float,
    w: float, by_body: Float, turned: Float,
) -> None:  # fmt: skip
    """Fill two rows: derivatives by the pose, by ``body_T_left`` and by the landmark, from those by the point."""
    for r in range(2):
        for c in range(3):
            by_body[r, c] = (
                by_left[r, 0] * left_by_body[0, c]
                + by_left[r, 1] * left_by_body[1, c]
                + by_left[r, 2] * left_by_body[2, c]
            )
            rows[r, _POINT_AT + c] = (
                by_left[r, 0] * left_by_point[0, c]
                + by_left[r, 1] * left_by_point[1, c]
                + by_left[r, 2] * left_by_point[2, c]
            )
    _turned(in_body, by_body, turned)
    rows[:, 0:3] = turned
    rows[:, 3:6] = -w * by_body
    _turned(in_left_body, by_body, turned)
    rows[:, POSE + BODY : POSE + BODY + 3] = turned
    rows[:, POSE + BODY + 3 : POSE + BODY + 6] = -w * by_body


@kernel
def total_cost(
    poses: Float, calibration: RigCalibration, landmarks: Float, tracks: Tracks, sigma_px: float, scale: float
) -> tuple[float, Float]:
    """Compute the robust cost of all errors, and the squared whitened error of each image's observation (N, 2).

    Args:
        poses: (K, 4, 4) ``odom_T_body``.
        calibration: of P pairs.
        landmarks: (L, 3).
        tracks: of these.
        sigma_px: noise of a corner's position.
        scale: of the Cauchy cost, in whitened units.
    """
    errors2 = np.full((len(tracks.keyframe), 2), np.nan)
    rows, cost = np.zeros((4, _COLUMNS)), 0.0
    for point in range(len(landmarks)):
        for n in range(tracks.rows[point], tracks.rows[point + 1]):
            filled = _observe(
                poses[tracks.keyframe[n]], calibration, tracks.pair[point], tracks.odom_T_landmark[point],
                landmarks[point], tracks.left_px[n], tracks.right_px[n], tracks.has_right[n], rows,
            )  # fmt: skip
            for image in range(2 if tracks.has_right[n] else 1):
                e2 = 1e6
                if filled >= 2 * image + 2:
                    du, dv = rows[2 * image, _ERROR_AT], rows[2 * image + 1, _ERROR_AT]
                    e2 = (du * du + dv * dv) / (sigma_px * sigma_px)
                errors2[n, image] = e2
                cost += 0.5 * scale * scale * np.log(1.0 + e2 / (scale * scale))
    return cost, errors2


@kernel
def eliminate_landmarks(
    poses: Float, calibration: RigCalibration, landmarks: Float, tracks: Tracks, sigma_px: float, scale: float,
    damping: float, hessian: Float, gradient: Float, eliminated: Eliminated,
) -> None:  # fmt: skip
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
    """
    n_poses = 6 * len(poses)
    rows = np.zeros((4, _COLUMNS))
    local = np.zeros((_COLUMNS, _COLUMNS))
    by_calibration = np.zeros((PAIR, PAIR))
    for point in range(len(landmarks)):
        first, last = tracks.rows[point], tracks.rows[point + 1]
        at = n_poses + PAIR * tracks.pair[point]
        v, bl = np.zeros((3, 3)), np.zeros(3)
        wc = eliminated.by_calibration[point]
        wc[:] = 0.0
        by_calibration[:] = 0.0
        for n in range(first, last):
            k = 6 * tracks.keyframe[n]
            filled = _observe(
                poses[tracks.keyframe[n]], calibration, tracks.pair[point], tracks.odom_T_landmark[point],
                landmarks[point], tracks.left_px[n], tracks.right_px[n], tracks.has_right[n], rows,
            )  # fmt: skip
            local[:] = 0.0
            for r in range(0, filled, 2):
                du, dv = rows[r, _ERROR_AT], rows[r + 1, _ERROR_AT]
                e2 = (du * du + dv * dv) / (sigma_px * sigma_px)
                weight = 1.0 / ((1.0 + e2 / (scale * scale)) * sigma_px * sigma_px)
                for one in (r, r + 1):
                    for c in range(_COLUMNS - 1):
                        value = weight * rows[one, c]
                        if value != 0.0:
                            for d in range(c, _COLUMNS):
                                local[c, d] += value * rows[one, d]
            for c in range(6):
                gradient[k + c] += local[c, _ERROR_AT]
                for d in range(c, 6):
                    hessian[k + c, k + d] += local[c, d]
                for d in range(PAIR):
                    hessian[k + c, at + d] += local[c, POSE + d]
                for d in range(3):
                    eliminated.by_pose[n, d, c] = local[c, _POINT_AT + d]
            for c in range(PAIR):
                gradient[at + c] += local[POSE + c, _ERROR_AT]
                for d in range(c, PAIR):
                    by_calibration[c, d] += local[POSE + c, POSE + d]
                for d in range(3):
                    wc[d, c] += local[POSE + c, _POINT_AT + d]
            for c in range(3):
                bl[c] += local[_POINT_AT + c, _ERROR_AT]
                for d in range(c, 3):
                    v[c, d] += local[_POINT_AT + c, _POINT_AT + d]
        for c in range(3):
            v[c, c] = v[c, c] * (1.0 + damping) + 1e-9
            for d in range(c):
                v[c, d] = v[d, c]
        inverse = _inverse3(v)
        eliminated.inverse[point], eliminated.gradient[point] = inverse, bl
        vb = inverse @ bl
        vwc = inverse @ wc
        for c in range(PAIR):
            gradient[at + c] -= wc[0, c] * vb[0] + wc[1, c] * vb[1] + wc[2, c] * vb[2]
            for d in range(c, PAIR):
                hessian[at + c, at + d] += (
                    by_calibration[c, d] - wc[0, c] * vwc[0, d] - wc[1, c] * vwc[1, d] - wc[2, c] * vwc[2, d]
                )
        for n in range(first, last):
            k, wp = 6 * tracks.keyframe[n], eliminated.by_pose[n]
            for c in range(6):
                gradient[k + c] -= wp[0, c] * vb[0] + wp[1, c] * vb[1] + wp[2, c] * vb[2]
                for d in range(PAIR):
                    hessian[k + c, at + d] -= wp[0, c] * vwc[0, d] + wp[1, c] * vwc[1, d] + wp[2, c] * vwc[2, d]
            for other in range(n, last):
                k2, wq = 6 * tracks.keyframe[other], eliminated.by_pose[other]
                for d in range(6):
                    x = inverse[0, 0] * wq[0, d] + inverse[0, 1] * wq[1, d] + inverse[0, 2] * wq[2, d]
                    y = inverse[1, 0] * wq[0, d] + inverse[1, 1] * wq[1, d] + inverse[1, 2] * wq[2, d]
                    z = inverse[2, 0] * wq[0, d] + inverse[2, 1] * wq[1, d] + inverse[2, 2] * wq[2, d]
                    for c in range(6 if k2 > k else d + 1):
                        hessian[k + c, k2 + d] -= wp[0, c] * x + wp[1, c] * y + wp[2, c] * z
    for c in range(len(gradient)):
        for d in range(c):
            hessian[c, d] = hessian[d, c]


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
        b = eliminated.gradient[point] + eliminated.by_calibration[point] @ step[at : at + PAIR]
        for n in range(tracks.rows[point], tracks.rows[point + 1]):
            k = 6 * tracks.keyframe[n]
            b += eliminated.by_pose[n] @ step[k : k + 6]
        moved[point] -= eliminated.inverse[point] @ b
    return moved
