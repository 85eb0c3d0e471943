"""Grouping of a calibration's cameras into stereo pairs, by the overlap of their views."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from graphvio.errors import RigError
from graphvio.rig import (
    MAX_AXES_ANGLE_DEG,
    Camera,
    Imu,
    Rig,
    SingleCamera,
    StereoPair,
    axes_angle_deg,
    checked_views,
    overlap,
)
from graphvio.wording import listed

_MIN_OVERLAP = 0.25


def grouped_rig(cameras: Sequence[Camera], imu: Imu | None, name: str, path: Path) -> Rig:
    """Form a rig of the cameras of a file: pairs (0, 1), (2, 3) and so on if the views of each overlap by a quarter.

    Otherwise the cameras that overlap most form pairs, and the others are single cameras; with an IMU, all of them may
    be single cameras. Two cameras always form a pair, unless there is an IMU and their views do not overlap at all or
    their optical axes are more than 45 degrees apart.

    Args:
        cameras: the cameras, in the order of the file.
        imu: the rig's IMU, or None.
        name: name of the rig.
        path: path of the file, for messages.

    Raises:
        RigError: if no two cameras overlap and there is no IMU, or the cameras do not describe a usable rig.
    """
    if not cameras:
        raise RigError(f"{path}: describes no camera; give a rig.yaml, or a calibration of at least two cameras")
    if len(cameras) == 1 and imu is None:
        raise RigError(
            f"{path}: has one camera, {cameras[0].name}, and no IMU, so that the scale cannot be known; graphvio needs "
            "a stereo pair or an IMU"
        )
    couples = [(i, i + 1) for i in range(0, len(cameras) - 1, 2)]
    if len(cameras) == 2 and imu is not None and _look_apart(*cameras):
        couples = []
    elif len(cameras) > 2 and (
        len(cameras) % 2 or any(overlap(cameras[i], cameras[j]) < _MIN_OVERLAP for i, j in couples)
    ):
        couples = _overlapping(cameras)
        if not couples and imu is None:
            names = listed(camera.name for camera in cameras)
            raise RigError(
                f"{path}: no two of the cameras {names} share a view, and there is no IMU; check the direction of "
                "body_T_cam, or write a rig.yaml that says which cameras form pairs"
            )
    pairs = [StereoPair(f"pair{k}", cameras[i], cameras[j]) for k, (i, j) in enumerate(couples)]
    paired = {i for couple in couples for i in couple}
    singles = [SingleCamera(camera) for i, camera in enumerate(cameras) if i not in paired]
    return checked_views(Rig(tuple(pairs), imu, name, singles=tuple(singles)))


def _look_apart(one: Camera, other: Camera) -> bool:
    """Return whether two cameras cannot be a pair: their views do not overlap, or their axes are too far apart."""
    return axes_angle_deg(one, other) > MAX_AXES_ANGLE_DEG or overlap(one, other) == 0.0


def _overlapping(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """Match cameras whose views overlap and whose axes are nearly parallel, largest overlap first, each at most once.

    Raises:
        RigError: if two cameras have the same pose.
    """
    shares = {(i, j): overlap(cameras[i], cameras[j]) for i, j in combinations(range(len(cameras)), 2)}
    for i, j in shares:
        if np.allclose(cameras[i].body_T_cam, cameras[j].body_T_cam, rtol=0.0, atol=1e-9):
            raise RigError(f"cameras {cameras[i].name} and {cameras[j].name} have the same body_T_cam; correct one")
    couples: list[tuple[int, int]] = []
    for (i, j), share in sorted(shares.items(), key=lambda item: (-item[1], item[0])):
        is_stereo = share >= _MIN_OVERLAP and axes_angle_deg(cameras[i], cameras[j]) <= MAX_AXES_ANGLE_DEG
        if is_stereo and not {i, j} & {k for couple in couples for k in couple}:
            couples.append((i, j))
    return sorted(couples)
