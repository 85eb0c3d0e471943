"""Scene ``corridor``: an office building with a door, a crowd, a blank-walled bend and a segment of dimmed lamps.

The walk goes along +x through a door (leg A), a lobby full of people, and into a bend (leg B, to the left and
right again) where walls, floor and ceiling are blank; then along +x where the lamps are dimmed (leg C), and at last
to the left along +y (leg D).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from graphvio.simulation.motion import Walk
from graphvio.simulation.scenes import furniture
from graphvio.simulation.world import Exposure, Lamp, Scene, World

_HEIGHT_M = 2.7
_BODY_Z_M = 1.5
_SPEED_MPS = 1.2
_HALF_M = 1.0

_START_X = -1.0
_DOOR_X = 7.0
_LOBBY_X = (11.0, 20.0)
_LOBBY_HALF_M = 3.5
_BEND_X = 28.0  # middle of leg B, which runs from y = 0 to _C_Y
_C_Y = 3.0
_BLANK_M = 2.6  # blank segment before and after leg B
_D_X = 50.0  # middle of leg D
_END_Y = 27.0
_PATH = [(_START_X, 0.0), (_BEND_X, 0.0), (_BEND_X, _C_Y), (_D_X, _C_Y), (_D_X, _END_Y - 2.0)]

_BLIND_S = (-0.3, 1.0)  # relative to the middle of the bend: when neither pair sees texture
_DIM_LIGHT = 0.12
_DIM_S = (6.0, 10.0)  # after the middle of the bend: when the lamps go down and come back


def build(duration_s: float, stationary_s: float) -> Scene:
    """Build a walk of 76 m; with the default standstill all difficult moments lie within the first 40 s."""
    world = World(ambient=0.42)
    walk = Walk(np.array([(x, y, _BODY_Z_M) for x, y in _PATH]), _SPEED_MPS, duration_s, stationary_s)
    _leg_a(world)
    _bend(world)
    _legs_c_and_d(world)
    _light(world)
    door = _door(world, walk)
    _crowd(world, walk)
    bend_s = walk.time_at(_BEND_X - _START_X + 0.5 * _C_Y)
    dim = (bend_s + _DIM_S[0], bend_s + _DIM_S[1])
    events = {
        "door": door,
        "people": (walk.time_at(_LOBBY_X[0] - _START_X - 4.0), walk.time_at(_LOBBY_X[1] - _START_X + 4.0)),
        "blank": (bend_s + _BLIND_S[0], bend_s + _BLIND_S[1]),
        "dim": dim,
    }
    return Scene("corridor", world, walk.motion, _dimmed(dim), events)


def _leg_a(world: World) -> None:
    w, lobby, h = _HALF_M, _LOBBY_HALF_M, _HEIGHT_M
    x0, (x1, x2), x3 = -4.0, _LOBBY_X, _BEND_X - _BLANK_M
    world.wall((x0, -w), (x0, w), 0.0, h, "brick")
    world.poster((x0, -0.45), (x0, 0.45), 0.02, 2.1, "door")
    for a, b, texture, first in ((x0, _DOOR_X, "plaster", 0), (_DOOR_X, x1, "brick", 3), (x2, x3, "concrete", 6)):
        world.wall((a, w), (b, w), 0.0, h, texture)
        world.wall((b, -w), (a, -w), 0.0, h, texture)
        furniture.pictures(world, (a, w), (b, w), first)
        furniture.pictures(world, (b, -w), (a, -w), first + 4)
    world.wall((x1, w), (x1, lobby), 0.0, h, "brick")
    world.wall((x1, lobby), (x2, lobby), 0.0, h, "plaster")
    world.wall((x2, lobby), (x2, w), 0.0, h, "concrete")
    world.wall((x2, -w), (x2, -lobby), 0.0, h, "concrete")
    world.wall((x2, -lobby), (x1, -lobby), 0.0, h, "plaster")
    world.wall((x1, -lobby), (x1, -w), 0.0, h, "brick")
    furniture.pictures(world, (x1, lobby), (x2, lobby), 1)
    furniture.pictures(world, (x2, -lobby), (x1, -lobby), 5)
    for y0, y1 in ((lobby, w), (-w, -lobby)):
        furniture.pictures(world, (x2, y0), (x2, y1), 2, spacing_m=1.2)
        furniture.pictures(world, (x1, -y0), (x1, -y1), 7, spacing_m=1.2)
    furniture.sofa(world, 13.5, 3.0, -0.5 * np.pi)
    furniture.sofa(world, 17.5, -3.0, 0.5 * np.pi)
    world.box((15.6, 3.2, 0.0), (0.4, 0.4, 0.9), "stripes", 0.3)
    world.box((19.6, 3.1, 0.0), (0.6, 0.6, 1.9), "lockers")
    world.box((11.5, -3.1, 0.0), (0.6, 0.7, 1.8), "wood", front="books")
    world.box((2.5, 0.86, 0.0), (1.6, 0.25, 0.45), "wood")
    world.box((21.6, -0.85, 0.0), (1.2, 0.28, 1.8), "lockers")
    world.floor((x0, x1), (-w, w), 0.0, "tiles")
    world.floor((x1, x2), (-lobby, lobby), 0.0, "planks")
    world.floor((x2, x3), (-w, w), 0.0, "carpet")
    world.ceiling((x0, x1), (-w, w), h, "ceiling")
    world.ceiling((x1, x2), (-lobby, lobby), h, "ceiling")
    world.ceiling((x2, x3), (-w, w), h, "ceiling")


def _bend(world: World) -> None:
    """Add leg B and the ends of the legs on both sides: blank surfaces only."""
    w, h = _HALF_M, _HEIGHT_M
    x0, x1 = _BEND_X - _BLANK_M, _BEND_X + _BLANK_M
    left, right = _BEND_X - w, _BEND_X + w
    outline = [
        (x0, w), (left, w), (left, _C_Y + w), (x1, _C_Y + w),
        (x1, _C_Y - w), (right, _C_Y - w), (right, -w), (x0, -w),
    ]  # fmt: skip
    for i in (0, 1, 2, 4, 5, 6):
        world.wall(outline[i], outline[i + 1], 0.0, h, "blank")
    for x, y in (((x0, left), (-w, w)), ((left, right), (-w, _C_Y + w)), ((right, x1), (_C_Y - w, _C_Y + w))):
        world.floor(x, y, 0.0, "blank")
        world.ceiling(x, y, h, "blank")


def _legs_c_and_d(world: World) -> None:
    w, h = _HALF_M, _HEIGHT_M
    x0, near, far = _BEND_X + _BLANK_M, _D_X - w, _D_X + w
    low, high = _C_Y - w, _C_Y + w
    textures = ("plaster", "brick", "lockers", "plaster")
    for k in range(4):
        a, b = x0 + (near - x0) * k / 4, x0 + (near - x0) * (k + 1) / 4
        c, d = a + (far - near) * k / 4, b + (far - near) * (k + 1) / 4
        world.wall((a, high), (b, high), 0.0, h, textures[k])
        world.wall((d, low), (c, low), 0.0, h, textures[(k + 1) % 4])
        if textures[k] != "lockers":
            furniture.pictures(world, (a, high), (b, high), 2 * k)
        if textures[(k + 1) % 4] != "lockers":
            furniture.pictures(world, (d, low), (c, low), 2 * k + 3)
    for k in range(3):
        a, b = high + (_END_Y - high) * k / 3, high + (_END_Y - high) * (k + 1) / 3
        c, d = low + (_END_Y - low) * k / 3, low + (_END_Y - low) * (k + 1) / 3
        world.wall((near, a), (near, b), 0.0, h, ("concrete", "plaster", "brick")[k])
        world.wall((far, d), (far, c), 0.0, h, ("brick", "concrete", "plaster")[k])
        furniture.pictures(world, (near, a), (near, b), k)
        furniture.pictures(world, (far, d), (far, c), k + 5)
    world.wall((near, _END_Y), (far, _END_Y), 0.0, h, "plaster")
    world.poster((near + 0.2, _END_Y), (far - 0.2, _END_Y), 0.7, 2.2, "window")
    world.box((36.0, _C_Y + 0.85, 0.0), (1.5, 0.28, 0.45), "wood")
    world.box((43.0, _C_Y - 0.85, 0.0), (0.5, 0.28, 1.1), "stripes")
    world.box((_D_X + 0.85, 14.0, 0.0), (0.28, 1.4, 1.8), "wood", front="books")
    world.floor((x0, far), (low, high), 0.0, "tiles")
    world.floor((near, far), (high, _END_Y), 0.0, "carpet")
    world.ceiling((x0, far), (low, high), h, "ceiling")
    world.ceiling((near, far), (high, _END_Y), h, "ceiling")


def _light(world: World) -> None:
    spots = [(x, 0.0) for x in (-2.0, 1.0, 4.0, 8.8, 21.5)]
    spots += [(x, y) for x in (13.0, 15.5, 18.0) for y in (-1.6, 1.6)]
    spots += [(x, _C_Y) for x in (33.0, 36.5, 40.0, 43.5, 47.0)]
    spots += [(_D_X, y) for y in (6.5, 10.0, 13.5, 17.0, 20.5, 24.0)]
    world.lamps += [Lamp(np.array([x, y, _HEIGHT_M - 0.2]), 1.0) for x, y in spots]


def _door(world: World, walk: Walk) -> tuple[float, float]:
    """Add a wall whose door opens as the walker comes; returns the times when it begins and stops moving, seconds."""
    width = 1.2
    side = _HALF_M - 0.5 * width
    for sign in (-1.0, 1.0):
        world.box((_DOOR_X, sign * (_HALF_M - 0.5 * side), 0.0), (0.1, side, _HEIGHT_M), "concrete")
    world.box((_DOOR_X, 0.0, 2.1), (0.1, width, _HEIGHT_M - 2.1), "concrete")
    start = walk.time_at(_DOOR_X - _START_X - 3.4)
    end = start + 2.2
    leaf = 1.5

    def angle(time_s: float) -> float:
        return leaf * _eased((time_s - start) / (end - start))

    furniture.door_leaf(world, (_DOOR_X, -0.5 * width), width, 0.5 * np.pi, lambda t: -angle(t))
    return start, end


def _crowd(world: World, walk: Walk) -> None:
    """Add people who cross the lobby, each shortly ahead of or behind the walker."""
    reach, pace = 2.3, 1.15
    for number in range(11):
        x = _LOBBY_X[0] + 0.7 + 0.76 * number
        lead_s = (1.5, -1.4, 1.9, 1.3, -1.8)[number % 5]
        crossing_s = walk.time_at(x - _START_X) - lead_s
        sense = 1.0 if number % 2 == 0 else -1.0
        furniture.person(world, _pacing(x, crossing_s, reach, pace * sense), number)


def _pacing(x: float, crossing_s: float, reach: float, pace: float) -> Callable[[float], tuple[float, float, float]]:
    """Return a track back and forth across the lobby at one x, which crosses the lobby's middle at a given time."""

    def track(time_s: float) -> tuple[float, float, float]:
        phase = pace / reach * (time_s - crossing_s)
        turn = np.tanh(6.0 * np.cos(phase) * np.sign(pace))
        return x, reach * float(np.sin(phase)), 0.5 * np.pi * float(turn)

    return track


def _dimmed(dim: tuple[float, float]) -> Callable[[float], Exposure]:
    """Return the exposure of lamps that are dimmed for a while; the automatic gain compensates a part of it."""

    def exposure(time_s: float) -> Exposure:
        down = _eased((time_s - dim[0]) / 0.6) - _eased((time_s - dim[1]) / 0.6)
        light = 1.0 - (1.0 - _DIM_LIGHT) * down
        return Exposure(light, light**-0.45)

    return exposure


def _eased(x: float) -> float:
    """Ease from 0 at x = 0 to 1 at x = 1, with no jerk at the ends."""
    x = min(max(x, 0.0), 1.0)
    return x * x * x * (10.0 + x * (6.0 * x - 15.0))
