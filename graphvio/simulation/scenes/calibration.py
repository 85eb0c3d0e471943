"""A small room full of texture, and a slow circle with rich rotation about all axes."""

import numpy as np

from graphvio.arrays import Float
from graphvio.simulation.motion import Motion
from graphvio.simulation.scenes import furniture
from graphvio.simulation.scenes.scene import Scene
from graphvio.simulation.world import Lamp, World

_HALF_M = 3.2
_HEIGHT_M = 3.0
_BODY_Z_M = 1.45
_START_S = 1.5  # time to come to full motion


def build(duration_s: float, rest_s: float) -> Scene:
    """The rig is turned by hand: up to 30 degrees in pitch and roll, and all around in yaw."""
    world = World(ambient=0.42)
    h = _HALF_M
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
        """``[x, y, z, yaw, pitch, roll]`` (N, 6) of body in world, metres and radians, at times (N,) in seconds."""
        t = np.clip(times - (rest_s if rest_s > 0.0 else -_START_S), 0.0, None)
        # Motion time runs up smoothly, so that the first moments are truly at rest.
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
