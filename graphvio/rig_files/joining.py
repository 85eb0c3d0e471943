"""Joins the calibrations of several rigs, which share no view and so are calibrated one by one, to one rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphvio.errors import RigError
from graphvio.geometry import se3, se3_inverse, so3_exp
from graphvio.rig import CameraGroup, Rig, SingleCamera, StereoPair
from graphvio.rig_files.time_shifts import MAX_DIFFERENCE_S, STAMP_DECIMALS


def joined_rig(rigs: Sequence[Rig], name: str) -> tuple[Rig, tuple[str, ...]]:
    """Join rigs to one, with the body frame and the IMU of the first rig.

    All rigs with an IMU are taken to have the same one, so that the poses of their cameras in body are known. The pose
    of a rig without an IMU is a guess, to be estimated by `graphvio calibrate`: its first camera is put at the position
    of the first rig's first camera, and turned about that camera's y axis by equal steps, so that of two rigs one looks
    forwards and one backwards. Where names repeat, cameras are named ``cam0``, ``cam1`` and so on in the order of the
    rigs, and pairs ``pair0``, ``pair1`` ...

    Where the time offsets of the rigs differ by more than 5 ms, they are taken as not triggered together: the IMU keeps
    the time offset of the first rig, and the stamps of the other rigs' cameras are corrected by the difference.

    Args:
        rigs: the rigs, at least one.
        name: name of the joined rig.

    Returns:
        The rig, and the names of the pairs and single cameras whose pose is a guess.

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
    """Correct the stamps of all rigs to the clock of the first rig's cameras, if time offsets to the IMU differ."""
    offsets_s = [rig.imu.time_offset_s if rig.imu is not None else None for rig in rigs]
    known_s = [offset_s for offset_s in offsets_s if offset_s is not None]
    if not known_s or max(known_s) - min(known_s) <= MAX_DIFFERENCE_S:
        return rigs
    return [
        rig if offset_s is None else _later(rig, offset_s - known_s[0])
        for rig, offset_s in zip(rigs, offsets_s, strict=True)
    ]


def _later(rig: Rig, seconds: float) -> Rig:
    """Return a rig with the given seconds added to the stamp offset of each camera."""
    return rig.with_cameras(
        lambda camera: replace(camera, stamp_offset_s=round(camera.stamp_offset_s + seconds, STAMP_DECIMALS))
    )


def _turned(rig: Rig, first: Rig, share: float) -> Rig:
    """Put a rig at the first camera of another one, turned about that camera's y axis by a share of a full turn."""
    left0_R_left = so3_exp(np.array([0.0, 2.0 * np.pi * share, 0.0]))
    body_T_left = first.cameras[0].body_T_cam @ se3(left0_R_left, np.zeros(3))
    body_T_body = body_T_left @ se3_inverse(rig.cameras[0].body_T_cam)
    return rig.with_cameras(lambda camera: replace(camera, body_T_cam=body_T_body @ camera.body_T_cam))


def _named_apart(groups: Sequence[CameraGroup]) -> list[CameraGroup]:
    """Return the groups with unique names; cameras, or pairs, are renamed only if any of their names repeat."""
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
