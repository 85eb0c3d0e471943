"""Calibration of a rig as one vector of parameters: its layout, and rigs that differ by such a vector.

A vector is the difference from the nominal rig, that of the rig file. Parameters of pairs come first, those of single
cameras follow. Rotations are rotation vectors: that of the right camera turns the left camera's frame, ``right_R_left
Exp(r)``; that of a pair turns it in body, ``Exp(r) body_R_left``.

Of a lens, the first five distortion coefficients are in the vector; the others, of ``rational``'s denominator, stay
those of the rig file.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.cameras import COEFFICIENTS, N_ESTIMATED
from graphvio.geometry import skew, so3_exp
from graphvio.rig import Camera, Rig, SingleCamera, StereoPair

INTRINSICS, DISTORTION, ROTATION = 4, N_ESTIMATED, 3
CAMERA = INTRINSICS + DISTORTION
LEFT, RIGHT, STEREO, BODY = 0, CAMERA, 2 * CAMERA, 2 * CAMERA + 6
PAIR = BODY + 6
"""Number of parameters of a pair: left camera, right camera, ``right_T_left``, ``body_T_left``."""
PLACE, SINGLE = CAMERA, CAMERA + 6
"""Index of a single camera's first parameter of ``body_T_cam``, after its lens, and number of all its parameters."""


_CAMERA_NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "d1", "d2", "d3", "d4", "d5")
_AXES = tuple("xyz")
_MATRIX = tuple(f"{row}{column}" for row in _AXES for column in _AXES)


def parameter_names(rig: Rig) -> list[str]:
    """Return the names of a rig's parameters, in their order: of its cameras, and of its IMU if there is one."""
    names = []
    for pair in rig.pairs:
        names += [f"{camera.name}.{name}" for camera in (pair.left, pair.right) for name in _CAMERA_NAMES]
        for transform in ("right_T_left", "body_T_left"):
            names += [f"{pair.name}.{transform}.{kind}{axis}" for kind in ("r", "t") for axis in _AXES]
    for single in rig.singles:
        names += [f"{single.left.name}.{name}" for name in _CAMERA_NAMES]
        names += [f"{single.left.name}.body_T_cam.{kind}{axis}" for kind in ("r", "t") for axis in _AXES]
    if rig.imu is not None:
        names += [f"imu.{sensor}_bias.{axis}" for sensor in ("gyro", "accel") for axis in _AXES]
        names += [f"imu.{sensor}_matrix.{element}" for sensor in ("gyro", "accel") for element in _MATRIX]
        names.append("imu.time_offset_s")
    return names


def n_camera_parameters(rig: Rig) -> int:
    """Return the number of a rig's parameters without those of its IMU."""
    return PAIR * len(rig.pairs) + SINGLE * len(rig.singles)


def slices_of_groups(rig: Rig) -> list[slice]:
    """Return the slice of the parameters of each pair and single camera."""
    sizes = [PAIR] * len(rig.pairs) + [SINGLE] * len(rig.singles)
    ends = np.cumsum(sizes).tolist()
    return [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]


def extrinsics_of(rig: Rig, j: int) -> slice:
    """Return the slice of the parameters (6,) of the extrinsics of a pair's left camera, or of a single camera."""
    end = slices_of_groups(rig)[j].stop
    return slice(end - 6, end)


def moved_cameras(rig: Rig, difference: Float) -> Rig:
    """Return a rig whose cameras differ by a vector (`n_camera_parameters`,)."""
    return RigCalibration.of(rig).moved(difference).applied_to(rig)


def has_coefficient(camera: Camera) -> Bool:
    """Return which of the first coefficients (DISTORTION,) a camera's model has."""
    return np.arange(DISTORTION) < len(COEFFICIENTS[camera.model])


def about_origin(rig: Rig, j: int) -> Float:
    """Return the derivatives (6, 6) of d with respect to the parameters of extrinsics, for ``exp(d) body_T_left``."""
    rows = np.eye(6)
    rows[3:, :3] = skew(rig.groups[j].left.body_T_cam[:3, 3])
    return rows


def depths_of_pair(rig: Rig, j: int) -> Float:
    """Return the derivatives (2, `n_camera_parameters`) of what a pair's calibration adds to its inverse depths.

    The first row is the offset of all of them, 1/m, in the middle of the image; the second one is a share of each.
    """
    rows, pair = np.zeros((2, n_camera_parameters(rig))), rig.pairs[j]
    own = rows[:, slices_of_groups(rig)[j]]
    right_T_left = pair.right.cam_T_body @ pair.left.body_T_cam
    right_R_left, baseline = right_T_left[:3, :3], right_T_left[:3, 3]
    far = right_R_left[:, 2]  # what is far in the middle of the left image, seen by the right camera
    projection = (np.eye(3)[:2] - np.outer(far[:2] / far[2], np.eye(3)[2])) / far[2]
    by_inverse_depth = projection @ baseline
    towards = by_inverse_depth / (by_inverse_depth @ by_inverse_depth)
    own[0, CAMERA : CAMERA + 2] = -towards * far[:2] / far[2] / pair.right.focal_px
    own[0, CAMERA + 2 : CAMERA + INTRINSICS] = -towards / pair.right.focal_px
    own[0, 2:INTRINSICS] = towards @ projection @ right_R_left[:, :2] / pair.left.focal_px
    own[0, STEREO : STEREO + ROTATION] = towards @ projection @ right_R_left @ skew(np.eye(3)[2])
    own[1, STEREO + ROTATION : BODY] = -towards @ projection
    return rows


def relative_to_first(rig: Rig, j: int) -> Float:
    """Return the derivatives (6, `n_camera_parameters`) of a group's pose in body relative to that of group 0.

    If body turns or moves against all cameras, their extrinsics change, but none of these differences does.
    """
    rows = np.zeros((6, n_camera_parameters(rig)))
    first, own = rows[:, extrinsics_of(rig, 0)], rows[:, extrinsics_of(rig, j)]
    first -= np.eye(6)
    own += np.eye(6)
    first[3:, :3] += skew(rig.groups[j].left.body_T_cam[:3, 3] - rig.groups[0].left.body_T_cam[:3, 3])
    return rows


class RigCalibration(NamedTuple):
    """Calibration of G pairs and single cameras, as arrays for kernels.

    Index 0 of two is the left camera, 1 the right one; a single camera takes the place of both.

    Attributes:
        models: (G, 2) numbers of the camera models.
        intrinsics: (G, 2, 4) ``[fx, fy, cx, cy]``, pixels.
        distortion: (G, 2, 8).
        right_T_left: (G, 4, 4).
        body_T_left: (G, 4, 4).
        is_single: (G,) whether it is a single camera.
    """

    models: Int
    intrinsics: Float
    distortion: Float
    right_T_left: Float
    body_T_left: Float
    is_single: Bool

    @staticmethod
    def of(rig: Rig) -> RigCalibration:
        """Collect the arrays of a rig."""
        cameras = [(group.cameras[0], group.cameras[-1]) for group in rig.groups]
        return RigCalibration(
            np.array([[camera.model_number for camera in both] for both in cameras], dtype=np.int64),
            np.array([[camera.intrinsics for camera in both] for both in cameras]),
            np.array([[camera.distortion for camera in both] for both in cameras]),
            np.array([both[1].cam_T_body @ both[0].body_T_cam for both in cameras]),
            np.array([left.body_T_cam for left, _ in cameras]),
            np.array([isinstance(group, SingleCamera) for group in rig.groups]),
        )

    @property
    def columns(self) -> Int:
        """Indices of the parameters (C,) in a vector (G * PAIR,) where single cameras have as many as pairs."""
        of_pair, of_single = np.arange(PAIR), np.r_[LEFT:CAMERA, BODY:PAIR]
        return np.concatenate(
            [j * PAIR + (of_single if is_single else of_pair) for j, is_single in enumerate(self.is_single)]
        )

    def moved(self, difference: Float) -> RigCalibration:
        """Return the calibration that differs from this one by a vector (`n_camera_parameters`,)."""
        each = np.zeros((len(self.models), PAIR))
        each.ravel()[self.columns] = difference
        right_T_left, body_T_left = self.right_T_left.copy(), self.body_T_left.copy()
        for j, of_pair in enumerate(each):
            stereo, body = of_pair[STEREO:BODY], of_pair[BODY:]
            right_T_left[j, :3, :3] = right_T_left[j, :3, :3] @ so3_exp(stereo[:3].copy())
            right_T_left[j, :3, 3] += stereo[3:]
            body_T_left[j, :3, :3] = so3_exp(body[:3].copy()) @ body_T_left[j, :3, :3]
            body_T_left[j, :3, 3] += body[3:]
        cameras, distortion = each[:, :STEREO].reshape(-1, 2, CAMERA), self.distortion.copy()
        distortion[:, :, :DISTORTION] += cameras[:, :, INTRINSICS:]
        return RigCalibration(
            self.models,
            self.intrinsics + cameras[:, :, :INTRINSICS],
            distortion,
            right_T_left,
            body_T_left,
            self.is_single,
        )

    def applied_to(self, rig: Rig) -> Rig:
        """Return a rig of the same cameras with this calibration."""
        pairs, singles = [], []
        for j, group in enumerate(rig.groups):
            body_T_left = self.body_T_left[j]
            left = self._camera(group.left, j, 0, body_T_left)
            if isinstance(group, StereoPair):
                body_T_right = body_T_left @ np.linalg.inv(self.right_T_left[j])
                pairs.append(StereoPair(group.name, left, self._camera(group.right, j, 1, body_T_right)))
            else:
                singles.append(SingleCamera(left))
        return replace(rig, pairs=tuple(pairs), singles=tuple(singles))

    def _camera(self, camera: Camera, j: int, which: int, body_T_cam: Float) -> Camera:
        return replace(
            camera,
            intrinsics=self.intrinsics[j, which],
            distortion=self.distortion[j, which],
            body_T_cam=body_T_cam,
        )
