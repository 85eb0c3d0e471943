"""One observation of a landmark by a pair or single camera: its errors, and derivatives with respect to all unknowns.

The row of an image's error in one direction has the derivatives with respect to the keyframe's pose, the pair's
calibration and the landmark, and then the error itself, in columns that begin at 0, `POSE`, `POINT_AT` and `ERROR_AT`.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.cameras import distort, distortion_basis
from graphvio.kernels import kernel
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
POINT_AT = POSE + PAIR
ERROR_AT = POINT_AT + POINT
COLUMNS = ERROR_AT + 1
MIN_DEPTH_RATIO = 1e-3


class Scratch(NamedTuple):
    """Intermediate results of `observe`, which would otherwise be allocated for each observation."""

    of_point: tuple[Float, Float, Float, Float, Float, Float]
    of_pixel: tuple[Float, Float, Float, Float, Float]
    error: Float


@kernel
def new_scratch() -> Scratch:
    """Allocate intermediate results."""
    return Scratch(
        (np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))),
        (np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, CAMERA))),
        np.empty(2),
    )


@kernel
def _project(
    calibration: RigCalibration, j: int, image: int, y: Float, seen: Float, to_pixel: Float, error: Float,
    by_camera: Float,
) -> bool:  # fmt: skip
    """Project a homogeneous point (3,); fill the error (2,) and its derivatives by point (2, 3) and camera (2, 9).

    Returns:
        Whether the point is in front of the camera, and within the domain of its lens.
    """
    if not y[2] > MIN_DEPTH_RATIO:
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
def observe(
    pose: Float, calibration: RigCalibration, j: int, odom_T_landmark: Float, landmark: Float,
    left_px: Float, right_px: Float, has_right: bool, scratch: Scratch, rows: Float,
) -> int:  # fmt: skip
    """Fill rows (4, COLUMNS) of one observation: derivatives with respect to pose, calibration and landmark, errors.

    Loops are used instead of slices throughout: each slice that is assigned takes seconds to compile, in every kernel
    that calls this one.

    Returns:
        The number of rows that were filled: 0, 2 or 4, pixels of the left image first.
    """
    for r in range(4):
        for c in range(COLUMNS):
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
            rows[first + r, ERROR_AT] = error[r]
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
                rows[first + r, POINT_AT + c] = (
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
                rows[first + r, POINT_AT + 2] += (
                    to_pixel[r, 0] * right[0, 3] + to_pixel[r, 1] * right[1, 3] + to_pixel[r, 2] * right[2, 3]
                )
                for c in range(3):
                    rows[first + r, POSE + STEREO + c] = -turned[r, c]
                    rows[first + r, POSE + STEREO + 3 + c] = w * to_pixel[r, c]
    return 4 if has_right else 2
