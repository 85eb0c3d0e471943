"""Scenes ``room``, two rounds in a furnished room, and ``calibration``, a textured room with strong rotations."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.simulation.motion import Motion, Walk
from graphvio.simulation.scenes import furniture
from graphvio.simulation.world import Lamp, Scene, World

_HEIGHT_M = 3.0
_BODY_Z_M = 1.45
_SPEED_MPS = 1.05  # so that two rounds and a moment of standstill fill 40 s
_CALIBRATION_HALF_M = 3.2
_START_S = 1.5  # time from standstill to full motion


def build_room(duration_s: float, stationary_s: float) -> Scene:
    """Build a furnished room of 10 x 8 x 3 metres, with two rounds about the table that end where they began."""
    world = World(ambient=0.42)
    outline = [(-5.0, -4.0), (-5.0, 4.0), (5.0, 4.0), (5.0, -4.0)]
    world.outline(outline, 0.0, _HEIGHT_M, ("brick", "plaster", "plaster", "concrete"))
    world.floor((-5.0, 5.0), (-4.0, 4.0), 0.0, "planks")
    world.floor((-1.8, 1.8), (-1.2, 1.2), 0.01, "carpet")
    world.ceiling((-5.0, 5.0), (-4.0, 4.0), _HEIGHT_M, "ceiling")
    for i in range(4):
        a, b = outline[i], outline[(i + 1) % 4]
        furniture.pictures(world, a, b, first=3 * i)
    _furnish(world)
    for x in (-2.5, 2.5):
        for y in (-1.8, 1.8):
            world.lamps.append(Lamp(np.array([x, y, _HEIGHT_M - 0.25]), 2.1))
    walk = Walk(_loop(), _SPEED_MPS, duration_s, stationary_s)
    return Scene("room", world, walk.motion)


def _loop() -> Float:
    """Return the corners of two rounds along a rectangle, from the middle of its long side and back to it."""
    ring = [(2.6, 2.1), (-2.6, 2.1), (-2.6, -2.1), (2.6, -2.1)]
    corners = [(0.0, -2.1), *[ring[(k + 3) % 4] for k in range(8)], (0.0, -2.1)]
    return np.array([[x, y, _BODY_Z_M] for x, y in corners])


def _furnish(world: World) -> None:
    furniture.table(world, 0.0, 0.0, 0.15, 2.0, 1.0)
    for x, y, yaw in ((-0.6, -0.85, 1.5), (0.6, -0.9, 1.7), (0.1, 0.95, -1.6), (-1.4, 0.0, 0.1)):
        furniture.chair(world, x, y, yaw)
    furniture.bookcase(world, -4.78, 1.2, 0.0)
    furniture.bookcase(world, -4.78, -0.1, 0.0)
    furniture.bookcase(world, 4.78, -1.6, np.pi, 1.4)
    furniture.sofa(world, 1.2, 3.5, -0.5 * np.pi)
    furniture.sofa(world, 4.4, 1.7, np.pi)
    furniture.table(world, -2.4, 3.5, 0.0)
    furniture.chair(world, -2.2, 3.0, 1.4)
    world.box((-1.6, -3.72, 0.0), (1.8, 0.5, 0.9), "lockers")
    world.box((-1.3, -3.72, 0.9), (0.3, 0.3, 0.3), "stripes", 0.5)
    world.box((2.4, -3.7, 0.0), (0.9, 0.5, 1.3), "wood", 0.0, tint=1.3)
    world.box((2.4, -3.7, 1.3), (0.5, 0.3, 0.35), "books", 0.2)
    world.box((4.5, -3.5, 0.0), (0.45, 0.45, 0.7), "fabric", 0.6)
    world.box((-4.5, -3.4, 0.0), (0.5, 0.5, 1.1), "stripes", 0.3)
    world.box((-4.4, 3.4, 0.0), (0.6, 0.6, 1.8), "wood", 0.0)


def build_calibration(duration_s: float, stationary_s: float) -> Scene:
    """Build a slow circle in a small room, with up to 30 degrees of pitch and roll, and full turns of yaw."""
    world = World(ambient=0.42)
    h = _CALIBRATION_HALF_M
    outline = [(-h, -h), (-h, h), (h, h), (h, -h)]
    world.outline(outline, 0.0, _HEIGHT_M, ("brick", "concrete", "plaster", "brick"))
    world.floor((-h, h), (-h, h), 0.0, "tiles")
    world.ceiling((-h, h), (-h, h), _HEIGHT_M, "ceiling")
    for i in range(4):
        a, b = outline[i], outline[(i + 1) % 4]
        furniture.pictures(world, a, b, first=2 * i, spacing_m=1.2, z0=1.5, height_m=0.9)
        furniture.pictures(world, a, b, first=2 * i + 5, spacing_m=1.3, z0=0.4, height_m=0.7)
    world.poster((h, 0.45), (h, -0.45), 1.05, 1.95, "checkerboard")
    furniture.bookcase(world, -h + 0.2, 1.9, 0.0)
    furniture.table(world, 2.3, 2.2, 0.8)
    furniture.sofa(world, -0.4, -2.65, 0.5 * np.pi)
    furniture.chair(world, 2.4, -2.3, 2.2)
    for x in (-1.5, 1.5):
        for y in (-1.5, 1.5):
            world.lamps.append(Lamp(np.array([x, y, _HEIGHT_M - 0.2]), 1.3))

    def course(times: Float) -> Float:
        """See `Motion`."""
        t = np.clip(times - (stationary_s if stationary_s > 0.0 else -_START_S), 0.0, None)
        # The time of the motion is warped so that it begins smoothly, from a true standstill.
        r = np.minimum(t / _START_S, 1.0)
        t = np.where(r < 1.0, _START_S * (r**4 * (2.5 - 3.0 * r + r * r)), t - 0.5 * _START_S)
        around = 0.45 * t
        return np.column_stack(
            [
                0.9 * np.cos(around),
                0.9 * np.sin(around),
                _BODY_Z_M + 0.18 * np.sin(0.83 * t),
                0.55 * np.sin(0.61 * t) + 0.35 * t,
                0.50 * np.sin(1.13 * t) + 0.04 * np.sin(7.1 * t),
                0.50 * np.sin(0.89 * t) + 0.03 * np.sin(9.3 * t),
            ]
        )

    return Scene("calibration", world, Motion(course, duration_s))
