"""A furnished room of 10 x 8 x 3 metres, walked in two rounds that end where they began."""

import numpy as np

from graphvio.simulation.scenes import furniture
from graphvio.simulation.scenes.scene import Scene
from graphvio.simulation.walking import Walk
from graphvio.simulation.world import Lamp, World

_HEIGHT_M = 3.0
_BODY_Z_M = 1.45
_SPEED_MPS = 1.05  # so that two rounds and a moment of rest fill 40 s


def build(duration_s: float, rest_s: float) -> Scene:
    """Two rounds about the table in the middle."""
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
    walk = Walk(_loop(), _SPEED_MPS, duration_s, rest_s)
    return Scene("room", world, walk.motion)


def _loop() -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Two rounds along a rectangle, from the middle of its long side and back to it."""
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
