"""Scene ``stairs``: along a hall, up a flight of stairs, over a landing, up another and along the upper floor."""

import numpy as np

from graphvio.simulation.motion import Gait, Walk
from graphvio.simulation.scenes import furniture
from graphvio.simulation.world import Lamp, Scene, World

_RISE_M, _TREAD_M = 0.17, 0.29
_FIRST_STEPS, _SECOND_STEPS = 11, 9
_BODY_M = 1.45
_SPEED_MPS = 0.85
_TOP_M = 6.0


def build(duration_s: float, stationary_s: float) -> Scene:
    """Build a hall and a first flight of stairs along x, and a second flight and an upper floor along y."""
    world = World(ambient=0.42)
    x_top = _FIRST_STEPS * _TREAD_M
    landing = _FIRST_STEPS * _RISE_M
    x_far = x_top + 2.2
    y_top = 1.1 + _SECOND_STEPS * _TREAD_M
    upper = landing + _SECOND_STEPS * _RISE_M
    y_far = y_top + 8.0
    _shell(world, x_top, x_far, y_far)
    world.floor((-8.0, 0.0), (-1.1, 1.1), 0.0, "tiles")
    world.floor((x_top, x_far), (-1.1, 1.1), landing, "carpet")
    world.floor((x_top, x_far), (y_top, y_far), upper, "planks")
    for k in range(_FIRST_STEPS):
        x, z = k * _TREAD_M, (k + 1) * _RISE_M
        world.wall((x, 1.1), (x, -1.1), z - _RISE_M, z, "concrete", tint=1.3)
        if k < _FIRST_STEPS - 1:
            world.floor((x, x + _TREAD_M), (-1.1, 1.1), z, "wood")
            world.floor((x, x + 0.05), (-1.1, 1.1), z + 0.002, "stripes", tint=1.4)
    for k in range(_SECOND_STEPS):
        y, z = 1.1 + k * _TREAD_M, landing + (k + 1) * _RISE_M
        world.wall((x_top, y), (x_far, y), z - _RISE_M, z, "concrete", tint=1.3)
        if k < _SECOND_STEPS - 1:
            world.floor((x_top, x_far), (y, y + _TREAD_M), z, "wood")
            world.floor((x_top, x_far), (y, y + 0.05), z + 0.002, "stripes", tint=1.4)
    middle = 0.5 * (x_top + x_far)
    path = [
        (-6.0, 0.0, 0.0),
        (-0.2, 0.0, 0.0),
        (x_top - 0.2, 0.0, landing),
        (middle, 0.0, landing),
        (middle, 0.9, landing),
        (middle, y_top - 0.2, upper),
        (middle, y_far - 1.6, upper),
    ]
    gait = Gait(steps_hz=1.6, vertical_m=0.026, lateral_m=0.022, pitch_rad=0.018)
    walk = Walk(np.array(path) + np.array([0.0, 0.0, _BODY_M]), _SPEED_MPS, duration_s, stationary_s, gait)
    return Scene("stairs", world, walk.motion)


def _shell(world: World, x_top: float, x_far: float, y_far: float) -> None:
    world.wall((-8.0, 1.1), (x_top, 1.1), 0.0, _TOP_M, "plaster")
    world.wall((x_top, 1.1), (x_top, y_far), 0.0, _TOP_M, "brick")
    world.wall((x_top, y_far), (x_far, y_far), 0.0, _TOP_M, "concrete")
    world.wall((x_far, y_far), (x_far, -1.1), 0.0, _TOP_M, "plaster")
    world.wall((x_far, -1.1), (-8.0, -1.1), 0.0, _TOP_M, "brick")
    world.wall((-8.0, -1.1), (-8.0, 1.1), 0.0, _TOP_M, "concrete")
    world.ceiling((-8.0, x_far), (-1.1, 1.1), _TOP_M, "ceiling")
    world.ceiling((x_top, x_far), (1.1, y_far), _TOP_M, "ceiling")
    furniture.pictures(world, (-7.8, 1.1), (0.0, 1.1), first=0)
    furniture.pictures(world, (0.0, -1.1), (-7.8, -1.1), first=4)
    furniture.pictures(world, (x_far, -1.1), (x_top, -1.1), first=5, z0=3.1)
    furniture.pictures(world, (0.2, 1.1), (x_top, 1.1), first=6, z0=2.6)
    furniture.pictures(world, (x_far, 3.0), (x_far, -1.0), first=2, z0=3.2)
    furniture.pictures(world, (x_top, 3.0), (x_top, y_far), first=3, z0=4.4)
    furniture.pictures(world, (x_far, y_far), (x_far, 3.4), first=7, z0=4.4)
    furniture.pictures(world, (x_top, y_far), (x_far, y_far), first=1, z0=4.3)
    world.poster((-8.0, -0.5), (-8.0, 0.5), 0.02, 2.1, "door")
    world.box((-3.0, -0.9, 0.0), (0.9, 0.3, 0.45), "wood")
    world.box((-6.5, 0.9, 0.0), (1.2, 0.3, 1.8), "lockers")
    for x in (-6.0, -2.5):
        world.lamps.append(Lamp(np.array([x, 0.0, 3.6]), 1.9))
    world.lamps.append(Lamp(np.array([x_top - 1.0, 0.0, 4.6]), 1.9))
    world.lamps.append(Lamp(np.array([0.5 * (x_top + x_far), 1.6, 5.7]), 1.6))
    for y in (5.0, 8.0, 11.0):
        world.lamps.append(Lamp(np.array([0.5 * (x_top + x_far), y, 5.7]), 1.3))
