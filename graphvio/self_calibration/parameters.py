"""Calibration of a rig as one vector of parameters: its layout, its prior, and rigs that differ by such a vector.

Of a lens, the first five coefficients have a place in it. Those that distorted coordinates are not linear in, and all
others, are kept: see `graphvio.cameras.LINEAR_COEFFICIENTS`.

A vector is the difference from the nominal rig, that of the rig file. Rotations are rotation vectors: that of the right
camera turns the left camera's frame, ``right_R_left Exp(r)``; that of a pair turns it in body, ``Exp(r) body_R_left``.
Single cameras have parameters in a rig without pairs, and none beside pairs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.cameras import COEFFICIENTS, LINEAR_COEFFICIENTS, N_BASIS
from graphvio.geometry import skew, so3_exp
from graphvio.rig import Camera, Rig, SingleCamera, StereoPair

INTRINSICS, DISTORTION, ROTATION, TRANSLATION = 4, N_BASIS, 3, 3
CAMERA = INTRINSICS + DISTORTION
LEFT, RIGHT, STEREO, BODY = 0, CAMERA, 2 * CAMERA, 2 * CAMERA + 6
PAIR = BODY + 6
"""Number of parameters of a pair: left camera, right camera, ``right_T_left``, ``body_T_left``."""
PLACE, SINGLE = CAMERA, CAMERA + 6
"""Where those of ``body_T_cam`` of a single camera begin, after the lens, and how many there are in all."""


_CAMERA_NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "d1", "d2", "d3", "d4", "d5")
_AXES = tuple("xyz")
_MATRIX = tuple(f"{row}{column}" for row in _AXES for column in _AXES)


def parameter_names(rig: Rig) -> list[str]:
    """Return the names of a rig's parameters, in their order: of its cameras, and of its IMU if there is one."""
    names = []
    for camera in single_cameras(rig):
        names += [f"{camera.name}.{name}" for name in _CAMERA_NAMES]
        names += [f"{camera.name}.body_T_cam.{kind}{axis}" for kind in ("r", "t") for axis in _AXES]
    for pair in rig.pairs:
        names += [f"{camera.name}.{name}" for camera in (pair.left, pair.right) for name in _CAMERA_NAMES]
        for transform in ("right_T_left", "body_T_left"):
            names += [f"{pair.name}.{transform}.{kind}{axis}" for kind in ("r", "t") for axis in _AXES]
    if rig.imu is not None:
        names += [f"imu.{sensor}_bias.{axis}" for sensor in ("gyro", "accel") for axis in _AXES]
        names += [f"imu.{sensor}_matrix.{element}" for sensor in ("gyro", "accel") for element in _MATRIX]
        names.append("imu.time_offset_s")
    return names


def single_cameras(rig: Rig) -> list[Camera]:
    """Return the single cameras that have parameters: those of a rig without pairs."""
    return [] if rig.pairs else [single.left for single in rig.singles]


def n_of_cameras(rig: Rig) -> int:
    """Return the number of a rig's parameters without those of its IMU."""
    return PAIR * len(rig.pairs) + SINGLE * len(single_cameras(rig))


def first_place(rig: Rig) -> slice:
    """Return where the parameters (6,) of the place of the first pair, or single camera, in body are."""
    end = PAIR if rig.pairs else SINGLE
    return slice(end - 6, end)


def moved_cameras(rig: Rig, difference: Float) -> Rig:
    """Return a rig whose cameras differ by a vector (P * PAIR,), or (S * SINGLE,) where it has no pairs."""
    if rig.pairs:
        return RigCalibration.of(rig).moved(difference).applied_to(rig)
    singles = []
    for single, own in zip(rig.singles, difference.reshape(-1, SINGLE), strict=True):
        camera, place = single.left, own[PLACE:]
        distortion, body_T_cam = camera.distortion.copy(), camera.body_T_cam.copy()
        distortion[:DISTORTION] += own[INTRINSICS:PLACE]
        body_T_cam[:3, :3] = so3_exp(place[:3].copy()) @ body_T_cam[:3, :3]
        body_T_cam[:3, 3] += place[3:]
        intrinsics = camera.intrinsics + own[:INTRINSICS]
        moved = replace(camera, intrinsics=intrinsics, distortion=distortion, body_T_cam=body_T_cam)
        singles.append(SingleCamera(moved))
    return replace(rig, singles=tuple(singles))


def is_linear(camera: Camera) -> Bool:
    """Return which of a camera's first coefficients (DISTORTION,) are estimated: those that the model is linear in."""
    names, linear = COEFFICIENTS[camera.model], LINEAR_COEFFICIENTS[camera.model]
    return np.array([i < len(names) and names[i] in linear for i in range(DISTORTION)])


def relative_to_first(rig: Rig, j: int) -> Float:
    """Return the derivatives (6, `n_of_cameras`) of a group's rotation and translation in body, seen from group 0.

    Where body turns or moves against all cameras, their places in it change, and none of these differences does.
    """
    place = first_place(rig)
    rows, own_end = np.zeros((6, n_of_cameras(rig))), (j + 1) * place.stop
    first, own = rows[:, place], rows[:, own_end - 6 : own_end]
    first -= np.eye(6)
    own += np.eye(6)
    first[3:, :3] += skew(rig.groups[j].left.body_T_cam[:3, 3] - rig.groups[0].left.body_T_cam[:3, 3])
    return rows


class RigCalibration(NamedTuple):
    """Calibration of P pairs, as kernels take it; index 0 of two is the left camera, 1 the right one.

    Attributes:
        models: (P, 2) numbers of the camera models.
        intrinsics: (P, 2, 4) ``[fx, fy, cx, cy]``, pixels.
        distortion: (P, 2, 8).
        right_T_left: (P, 4, 4).
        body_T_left: (P, 4, 4).
    """

    models: Int
    intrinsics: Float
    distortion: Float
    right_T_left: Float
    body_T_left: Float

    @staticmethod
    def of(rig: Rig) -> RigCalibration:
        """Collect the arrays of a rig."""
        cameras = [(pair.left, pair.right) for pair in rig.pairs]
        return RigCalibration(
            np.array([[camera.model_number for camera in both] for both in cameras], dtype=np.int64),
            np.array([[camera.intrinsics for camera in both] for both in cameras]),
            np.array([[camera.distortion for camera in both] for both in cameras]),
            np.array([pair.right_T_left for pair in rig.pairs]),
            np.array([pair.left.body_T_cam for pair in rig.pairs]),
        )

    def moved(self, difference: Float) -> RigCalibration:
        """Return the calibration that differs from this one by a vector (P * PAIR,)."""
        each = difference.reshape(-1, PAIR)
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
        )

    def applied_to(self, rig: Rig) -> Rig:
        """Return a rig of the same cameras with this calibration."""
        pairs = []
        for j, pair in enumerate(rig.pairs):
            body_T_left = self.body_T_left[j]
            body_T_right = body_T_left @ np.linalg.inv(self.right_T_left[j])
            pairs.append(
                StereoPair(
                    pair.name,
                    self._camera(pair.left, j, 0, body_T_left),
                    self._camera(pair.right, j, 1, body_T_right),
                )
            )
        return replace(rig, pairs=tuple(pairs))

    def _camera(self, camera: Camera, j: int, which: int, body_T_cam: Float) -> Camera:
        return replace(
            camera,
            intrinsics=self.intrinsics[j, which],
            distortion=self.distortion[j, which],
            body_T_cam=body_T_cam,
        )
