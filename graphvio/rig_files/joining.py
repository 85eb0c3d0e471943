"""Joins calibrations of several pairs, which share no view and so are calibrated one by one, to one rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphvio.errors import RigError
from graphvio.geometry import se3, se3_inverse, so3_exp
from graphvio.rig import CameraGroup, Rig, SingleCamera, StereoPair
from graphvio.rig_files.time_shifts import MAX_DIFFERENCE_S, STAMP_DECIMALS


def joined_rig(rigs: Sequence[Rig], name: str) -> tuple[Rig, tuple[str, ...]]:
    """Join rigs to one, whose body and IMU are the first one's.

    Rigs with an IMU are taken to have the same one, so that the places of their cameras are known. Of a rig without
    it the place is guessed, for `graphvio calibrate` to find: at the first left camera, turned about its vertical by
    equal steps, so that two look forwards and backwards. Where names repeat, cameras are named ``cam0``, ``cam1`` and
    so on in the order of the rigs, and pairs ``pair0``, ``pair1`` ...

    Where time offsets to the IMU differ by more than 5 ms, rigs are not triggered together: the first one's offset is
    the IMU's, and by the others' differences from it the stamps of their cameras are corrected.

    Args:
        rigs: at least one.
        name: of the rig.

    Returns:
        The rig, and the names of the pairs and single cameras whose place is guessed.

    Raises:
        RigError: if only a later rig has an IMU.
    """
    first, *others = rigs
    if first.imu is None and any(rig.imu is not None for rig in others):
        raise RigError(
            f"{name}: the first calibration has no IMU, but another one has; give the one with the IMU first"
        )
    groups: list[CameraGroup] = []
    guessed = []
    for k, rig in enumerate(_on_one_clock(rigs)):
        is_known = k == 0 or rig.imu is not None
        guessed += [len(groups) + i for i in range(len(rig.groups)) if not is_known]
        groups += (rig if is_known else _turned(rig, first, k / len(rigs))).groups
    groups = _named_apart(groups)
    pairs = tuple(group for group in groups if isinstance(group, StereoPair))
    singles = tuple(group for group in groups if isinstance(group, SingleCamera))
    joined = Rig(pairs, first.imu, name, first.calibration_sigmas, singles)
    return joined, tuple(groups[i].name for i in guessed)


def _on_one_clock(rigs: Sequence[Rig]) -> Sequence[Rig]:
    """Correct the stamps of cameras to the clock of the first rig's, where time offsets to the IMU differ."""
    offsets_s = [rig.imu.time_offset_s if rig.imu is not None else None for rig in rigs]
    known_s = [offset_s for offset_s in offsets_s if offset_s is not None]
    if not known_s or max(known_s) - min(known_s) <= MAX_DIFFERENCE_S:
        return rigs
    return [
        rig if offset_s is None else _later(rig, offset_s - known_s[0])
        for rig, offset_s in zip(rigs, offsets_s, strict=True)
    ]


def _later(rig: Rig, seconds: float) -> Rig:
    """Return a rig whose cameras' corrected stamps are so much later."""
    return rig.with_cameras(
        lambda camera: replace(camera, stamp_offset_s=round(camera.stamp_offset_s + seconds, STAMP_DECIMALS))
    )


def _turned(rig: Rig, first: Rig, share: float) -> Rig:
    """Put a rig's first camera at another one's place, turned about that camera's vertical by a share of a turn."""
    left0_R_left = so3_exp(np.array([0.0, 2.0 * np.pi * share, 0.0]))
    body_T_left = first.cameras[0].body_T_cam @ se3(left0_R_left, np.zeros(3))
    body_T_body = body_T_left @ se3_inverse(rig.cameras[0].body_T_cam)
    return rig.with_cameras(lambda camera: replace(camera, body_T_cam=body_T_body @ camera.body_T_cam))


def _named_apart(groups: Sequence[CameraGroup]) -> list[CameraGroup]:
    """Return groups of different names, with cameras of different names."""
    cameras = [camera.name for group in groups for camera in group.cameras]
    is_renamed = len(set(cameras)) < len(cameras)
    is_pair_renamed = len({group.name for group in groups}) < len(groups)
    numbers = iter(range(len(cameras)))
    apart: list[CameraGroup] = []
    for k, group in enumerate(groups):
        own = [replace(each, name=f"cam{next(numbers)}") if is_renamed else each for each in group.cameras]
        name = f"pair{k}" if is_pair_renamed else group.name
        apart.append(StereoPair(name, *own) if isinstance(group, StereoPair) else SingleCamera(*own))
    return apart
