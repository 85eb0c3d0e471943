"""Furniture, pictures, doors and people for indoor scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3
from graphvio.simulation.default_rig import rotation_zyx
from graphvio.simulation.world import MovingPart, World, box_faces

_PICTURES = ["poster0", "painting0", "poster1", "notices", "poster2", "painting1", "poster3", "window", "poster4"]
_HIP_M = 0.86
_SHOULDER_M = 1.42
_SWING_RAD = 0.45


def table(world: World, x: float, y: float, yaw: float, length: float = 1.6, width: float = 0.8) -> None:
    """Add a table with a few objects on it."""
    c, s = np.cos(yaw), np.sin(yaw)

    def at(along: float, across: float) -> tuple[float, float]:
        return x + c * along - s * across, y + s * along + c * across

    for sx in (-0.5, 0.5):
        for sy in (-0.5, 0.5):
            world.box((*at(sx * (length - 0.1), sy * (width - 0.1)), 0.0), (0.06, 0.06, 0.70), "wood", yaw)
    world.box((x, y, 0.70), (length, width, 0.04), "wood", yaw, tint=1.5)
    world.box((*at(-0.45, 0.1), 0.74), (0.30, 0.22, 0.20), "books", yaw + 0.3)
    world.box((*at(0.35, -0.05), 0.74), (0.05, 0.52, 0.34), "lockers", yaw + 0.4, front="painting1")
    world.box((*at(0.0, 0.2), 0.74), (0.12, 0.12, 0.16), "stripes", yaw + 0.8)


def chair(world: World, x: float, y: float, yaw: float) -> None:
    """Add a chair that faces along yaw."""
    c, s = np.cos(yaw), np.sin(yaw)
    world.box((x, y, 0.42), (0.44, 0.44, 0.06), "fabric", yaw)
    world.box((x - 0.2 * c, y - 0.2 * s, 0.48), (0.05, 0.44, 0.45), "fabric", yaw)
    for a, b in ((-0.2, -0.2), (-0.2, 0.2), (0.2, -0.2), (0.2, 0.2)):
        world.box((x + c * a - s * b, y + s * a + c * b, 0.0), (0.04, 0.04, 0.42), "wood", yaw)


def bookcase(world: World, x: float, y: float, yaw: float, width: float = 1.2) -> None:
    """Add a bookcase that faces along yaw."""
    world.box((x, y, 0.0), (0.35, width, 2.0), "wood", yaw, front="books")


def sofa(world: World, x: float, y: float, yaw: float) -> None:
    """Add a sofa that faces along yaw."""
    c, s = np.cos(yaw), np.sin(yaw)
    world.box((x, y, 0.0), (0.85, 1.9, 0.42), "fabric", yaw)
    world.box((x - 0.34 * c, y - 0.34 * s, 0.42), (0.2, 1.9, 0.45), "fabric", yaw, tint=0.8)
    for side in (-0.5, 0.45):
        world.box((x - s * side, y + c * side, 0.42), (0.12, 0.42, 0.36), "stripes", yaw + 0.1)


def pictures(
    world: World,
    start: tuple[float, float],
    end: tuple[float, float],
    first: int,
    spacing_m: float = 1.7,
    z0: float = 1.05,
    height_m: float = 0.95,
) -> None:
    """Add a row of pictures along a wall from start to end, in the wall's direction."""
    a, b = np.array(start), np.array(end)
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    random = np.random.default_rng([7, first])
    for k in range(int(length / spacing_m)):
        middle = (k + 0.5) * spacing_m + random.uniform(-0.25, 0.25)
        width = height_m * random.uniform(0.7, 1.25)
        low = z0 + random.uniform(-0.2, 0.25)
        p, q = a + (middle - 0.5 * width) * along, a + (middle + 0.5 * width) * along
        high = low + height_m * random.uniform(0.75, 1.1)
        world.poster(
            (float(p[0]), float(p[1])), (float(q[0]), float(q[1])), low, high,
            _PICTURES[(first + k) % len(_PICTURES)], tint=float(random.uniform(0.8, 1.1)),
        )  # fmt: skip


def door_leaf(
    world: World, hinge: tuple[float, float], width: float, closed_yaw: float, angle: Callable[[float], float]
) -> None:
    """Add a door that turns about a vertical hinge.

    Args:
        world: world to which it is added.
        hinge: (x, y), metres.
        width: width of the door, metres.
        closed_yaw: direction from the hinge to the lock when the door is closed, rad.
        angle: returns how far the door is open at a time in seconds, rad.
    """
    faces = box_faces((0.045, width, 2.08), "wood", front="door")
    shifted = tuple(replace(face, origin=face.origin + np.array([0.0, 0.5 * width, 0.0])) for face in faces)

    def pose(time_s: float) -> Float:
        yaw = closed_yaw - 0.5 * np.pi + angle(time_s)
        return se3(rotation_zyx(yaw, 0.0, 0.0), np.array([*hinge, 0.01]))

    world.moving.append(MovingPart(shifted, pose))


def person(world: World, track: Callable[[float], tuple[float, float, float]], number: int) -> None:
    """Add a person.

    Args:
        world: world to which the person is added.
        track: returns (x, y, yaw) at a time in seconds, metres and radians.
        number: selects clothes and height.
    """
    shirt = ("stripes", "fabric", "poster2", "cloth", "notices")[number % 5]
    tint = 0.7 + 0.12 * (number % 4)
    tall = 0.94 + 0.03 * (number % 5)

    def limb(size: tuple[float, float, float], side: float, top: float, swing: float, texture: str) -> None:
        """Add a box that hangs from a joint at height ``top``, ``side`` to the left, and swings with the steps."""
        length = size[2]
        faces = box_faces(size, texture, tint=tint, shift=(0.17 * number, 0.31 * number))
        hung = tuple(replace(face, origin=face.origin - np.array([0.0, 0.0, length])) for face in faces)

        def pose(time_s: float) -> Float:
            x, y, yaw = track(time_s)
            pitch = swing * _SWING_RAD * np.sin(2.0 * np.pi * 0.9 * time_s + number)
            world_T_person = se3(rotation_zyx(yaw, 0.0, 0.0), np.array([x, y, 0.0]))
            return world_T_person @ se3(rotation_zyx(0.0, pitch, 0.0), np.array([0.0, side, top * tall]))

        world.moving.append(MovingPart(hung, pose))

    limb((0.15, 0.16, _HIP_M), 0.1, _HIP_M, 1.0, "cloth")
    limb((0.15, 0.16, _HIP_M), -0.1, _HIP_M, -1.0, "cloth")
    limb((0.10, 0.10, 0.62), 0.28, _SHOULDER_M, -0.8, shirt)
    limb((0.10, 0.10, 0.62), -0.28, _SHOULDER_M, 0.8, shirt)
    limb((0.24, 0.44, 0.60), 0.0, _SHOULDER_M + 0.04, 0.0, shirt)
    head = box_faces((0.21, 0.17, 0.25), "cloth", front="head", tint=tint)

    def head_pose(time_s: float) -> Float:
        x, y, yaw = track(time_s)
        return se3(rotation_zyx(yaw, 0.0, 0.0), np.array([x, y, 1.50 * tall]))

    world.moving.append(MovingPart(head, head_pose))
