"""Rendered recordings to calibrate from: the paper's rig in the calibration room, carried in several ways."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from recordings import half_size_rig
from rendered import copy_part, rendered_once

from graphvio.arrays import Float
from graphvio.geometry import se3_exp
from graphvio.rig import Rig
from graphvio.simulation import Simulator, build_scene, write_recording
from graphvio.simulation.motion import Motion

Course = Callable[[Float], Float]
"""``[x, y, z, yaw, pitch, roll]`` (N, 6) of body in the room at times (N,)."""


def planar(t: Float) -> Float:
    """A cart that drives a curve."""
    return _course(t, x=0.9 * np.cos(0.7 * t), y=0.9 * np.sin(0.7 * t), yaw=0.8 * np.sin(1.1 * t) + 0.5 * t)


def on_the_spot(t: Float) -> Float:
    """Turned about the vertical through body, and not moved."""
    return _course(t, yaw=0.9 * np.sin(1.1 * t))


def straight(t: Float) -> Float:
    """Moved about, and not turned."""
    return _course(t, x=0.5 * np.sin(0.9 * t), y=0.4 * np.sin(1.3 * t), z=0.2 * np.sin(0.7 * t))


def _course(
    t: Float, x: Float | float = 0.0, y: Float | float = 0.0, z: Float | float = 0.0, yaw: Float | float = 0.0
) -> Float:
    zero = np.zeros_like(t)
    level = 1.45 + zero
    return np.column_stack([zero + x, zero + y, level + z, zero + yaw, zero, zero])


_WHOLE_S: dict[Course | None, float] = {None: 12.0, planar: 6.0}  # of walks that tests use parts of


def walk_simulator(duration_s: float, course: Course | None = None, trigger_offset_ms: float = 0.0) -> Simulator:
    """Of 320x240 images; without a course the rig is turned about all axes while it is carried around."""
    scene = build_scene("calibration", duration_s, 0.0)
    if course is not None:
        scene = replace(scene, motion=Motion(course, duration_s))
    return Simulator(scene, half_size_rig(), 1, trigger_offset_ms=trigger_offset_ms)


def recorded(folder: Path, duration_s: float, course: Course | None = None, trigger_offset_ms: float = 0.0) -> Path:
    """Write a recording of what the simulator sees into a folder, and return the folder."""
    whole_s = _WHOLE_S.get(course, duration_s) if trigger_offset_ms == 0.0 else duration_s

    def write(cached: Path) -> None:
        write_recording(walk_simulator(whole_s, course, trigger_offset_ms), cached)

    name = "circle" if course is None else course.__name__
    whole = rendered_once("walk", write, name, whole_s, trigger_offset_ms)
    if duration_s == whole_s:
        shutil.copytree(whole, folder)
    else:
        copy_part(whole, folder, duration_s)
    return folder


def misplacement(degrees: float, metres: float) -> Float:
    """An error (4, 4) of ``body_T_cam``, from the left."""
    turn, shift = np.deg2rad(degrees) * np.array([0.6, -0.64, 0.48]), metres * np.array([0.48, 0.6, 0.64])
    return se3_exp(np.concatenate([turn, shift]))


def with_wrong_place(rig: Rig, degrees: float, metres: float) -> Rig:
    """The rig with a second pair that is elsewhere."""
    error = misplacement(degrees, metres)
    other = rig.pairs[1]
    left, right = (replace(each, body_T_cam=error @ each.body_T_cam) for each in (other.left, other.right))
    return replace(rig, pairs=(rig.pairs[0], replace(other, left=left, right=right)))
