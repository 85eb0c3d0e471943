"""Time shifts between the IMU and each camera, as Kalibr's ``timeshift_cam_imu`` gives them.

Cameras that are triggered together have the same time shift, apart from calibration errors. Devices that run
independently have one each: the IMU's time offset is then the shift of the rig's first pair or camera, and the stamps
of the others are corrected to the clock of that one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from graphvio.errors import RigError
from graphvio.rig import CameraGroup, Rig

MAX_DIFFERENCE_S = 5e-3
"""Largest difference between the time shifts of cameras that are triggered together."""
STAMP_DECIMALS = 9
"""Decimals of a stamp offset in seconds, since stamps are in nanoseconds."""


def with_time_shifts(rig: Rig, given_s: Mapping[str, float | None], path: Path) -> Rig:
    """Return a rig with the time shifts of its cameras, ``t_imu = stamp + shift``.

    If all shifts agree within 5 ms, their mean is the IMU's time offset. Otherwise each pair gets the mean of its two
    cameras, and each single camera its own.

    Args:
        rig: the rig, without time offsets.
        given_s: time shifts of the cameras in the file, seconds, by the camera's name; None where a shift is missing,
            which counts as 0.
        path: path of the file, for messages.

    Raises:
        RigError: if the shifts do not agree within 5 ms, and one is missing, or those of a pair's left and right camera
            differ by more than 5 ms.
    """
    shifts_s = {name: 0.0 if shift is None else shift for name, shift in given_s.items()}
    shifts = list(shifts_s.values())
    if max(shifts) - min(shifts) <= MAX_DIFFERENCE_S:
        imu = None if rig.imu is None else replace(rig.imu, time_offset_s=float(np.mean(shifts)))
        return replace(rig, imu=imu)
    missing = [name for name, shift in given_s.items() if shift is None]
    if missing:
        raise RigError(f"{path}: {missing[0]} has no timeshift_cam_imu, and other cameras have different ones; add it")
    of_group = [_shift_of(group, shifts_s, path) for group in rig.groups]
    of_camera = {
        camera.name: shift for group, shift in zip(rig.groups, of_group, strict=True) for camera in group.cameras
    }
    first = of_group[0]
    rig = rig.with_cameras(
        lambda camera: replace(camera, stamp_offset_s=round(of_camera[camera.name] - first, STAMP_DECIMALS))
    )
    return replace(rig, imu=None if rig.imu is None else replace(rig.imu, time_offset_s=first))


def _shift_of(group: CameraGroup, shifts_s: Mapping[str, float], path: Path) -> float:
    shifts = [shifts_s[camera.name] for camera in group.cameras]
    if max(shifts) - min(shifts) > MAX_DIFFERENCE_S:
        left, right = (camera.name for camera in group.cameras)
        raise RigError(
            f"{path}: timeshift_cam_imu differs by {1e3 * (max(shifts) - min(shifts)):.1f} ms between {left} and "
            f"{right}, which are a stereo pair; graphvio needs left and right that are triggered together: synchronise "
            "them, or correct their stamps"
        )
    return float(np.mean(shifts))
