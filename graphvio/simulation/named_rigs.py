"""Rigs that the simulator knows by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import SourceError
from graphvio.geometry import se3
from graphvio.rig import Camera, Imu, Rig, SingleCamera, StereoPair
from graphvio.rig_files import load_rig
from graphvio.simulation.default_rig import default_rig

_SIZE_PX = (640, 480)


def stereo() -> Rig:
    """Return the front pair of the default rig."""
    return default_rig().with_pairs([0])


def stereo_and_back() -> Rig:
    """Return the front pair of the default rig, and one camera that looks back."""
    _, back = default_rig().pairs
    return replace(stereo(), singles=(SingleCamera(back.left),))


def headset() -> Rig:
    """Return four fisheye cameras, 126 degrees wide and 158 diagonally: a pair in front, and one on each side."""
    lens = ("equidistant", np.array([290.0, 290.0, 319.5, 239.5]), np.array([0.0034, 0.0007, -0.0020, 0.0002]))
    left, right, to_left, to_right = (
        Camera(f"cam{k}", lens[0], _SIZE_PX, *lens[1:], _body_T_cam(position_m, yaw_deg, pitch_deg))
        for k, (position_m, yaw_deg, pitch_deg) in enumerate(
            [
                ((0.06, 0.05, 0.02), 8.0, 12.0),
                ((0.06, -0.05, 0.02), -8.0, 12.0),
                ((0.03, 0.08, 0.0), 70.0, 20.0),
                ((0.03, -0.08, 0.0), -70.0, 20.0),
            ]
        )
    )
    sides = SingleCamera(to_left), SingleCamera(to_right)
    return Rig((StereoPair("front", left, right),), Imu(), "headset", singles=sides)


def surround() -> Rig:
    """Return six single cameras on a circle, each 90 degrees wide."""
    lens = ("radial-tangential", np.array([320.0, 320.0, 319.5, 239.5]), np.array([-0.05, 0.01, 0.0, 0.0]))
    cameras = []
    for k in range(6):
        yaw_deg = 60.0 * k
        yaw = np.deg2rad(yaw_deg)
        body_T_cam = _body_T_cam((0.15 * np.cos(yaw), 0.15 * np.sin(yaw), 0.0), yaw_deg, 10.0)
        cameras.append(SingleCamera(Camera(f"cam{k}", lens[0], _SIZE_PX, *lens[1:], body_T_cam)))
    return Rig((), Imu(), "surround", singles=tuple(cameras))


def phone() -> Rig:
    """Return a single camera, 66 degrees wide, with a rolling shutter of 20 ms."""
    lens = ("radial-tangential", np.array([495.0, 495.0, 321.3, 237.8]), np.array([0.08, -0.12, 3e-4, -2e-4]))
    line_time_us = 20e3 / _SIZE_PX[1]
    camera = Camera("cam0", lens[0], _SIZE_PX, *lens[1:], _body_T_cam((0.0, 0.02, 0.06), 0.0, 5.0), None, line_time_us)
    return Rig((), Imu(), "phone", singles=(SingleCamera(camera),))


def car() -> Rig:
    """Return a stereo pair of 1241x376 pixels with a baseline of 0.537 m, as on KITTI's car, in front of the body."""
    intrinsics = np.array([718.856, 718.856, 607.1928, 185.2157])
    lens = ("radial-tangential", (1241, 376), intrinsics, np.zeros(4))
    cameras = (Camera(f"cam{k}", *lens, _body_T_cam((1.0, 0.27 - 0.537 * k, 0.0), 0.0, 0.0)) for k in range(2))
    return Rig((StereoPair("front", *cameras),), Imu(), "car")


def drone() -> Rig:
    """Return a stereo pair of 752x480 pixels with a baseline of 0.11 m, which looks 45 degrees down."""
    intrinsics, distortion = np.array([460.0, 459.1, 382.8, 244.6]), np.array([-0.28, 0.07, 2e-4, 1e-5])
    lens = ("radial-tangential", (752, 480), intrinsics, distortion)
    cameras = (Camera(f"cam{k}", *lens, _body_T_cam((0.1, 0.055 - 0.11 * k, 0.0), 0.0, 45.0)) for k in range(2))
    return Rig((StereoPair("front", *cameras),), Imu(), "drone")


def _body_T_cam(position_m: tuple[float, float, float], yaw_deg: float, pitch_deg: float) -> Float:
    """Return the pose (4, 4) of a camera that is turned from forward by a yaw to the left and a pitch downwards."""
    yaw, pitch = np.deg2rad(yaw_deg), np.deg2rad(pitch_deg)
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    return se3(np.column_stack([right, np.cross(forward, right), forward]), np.array(position_m))


NAMED_RIGS: dict[str, Callable[[], Rig]] = {
    "paper": default_rig,
    "stereo": stereo,
    "stereo+back": stereo_and_back,
    "headset": headset,
    "surround": surround,
    "phone": phone,
    "car": car,
    "drone": drone,
}
"""Functions that return the rig of a name; most scenes have ``paper``."""


def rig_of(name: str) -> Rig:
    """Return the rig of a name in `NAMED_RIGS`, or that of a rig file.

    Raises:
        SourceError: if there is no such rig and no such file.
        RigError: if the file describes no usable rig.
    """
    if name in NAMED_RIGS:
        return NAMED_RIGS[name]()
    if not Path(name).exists():
        raise SourceError(f"there is no rig {name!r}; give a rig file, or one of {', '.join(NAMED_RIGS)}")
    return load_rig(Path(name))
