"""Scene ``loop``: office corridors around a closed rectangle, walked around once, then a little farther, and back.

The walk begins in the middle of the south leg and goes along +x, counterclockwise as seen from above, past the starting
point again into a lobby; there it turns and comes back past the starting point. All legs have doors of the same kind,
each with a notice board next to it, and walls of the same three kinds, so that many places differ only in their
pictures, floors and furniture.
"""

from __future__ import annotations

import numpy as np

from graphvio.simulation.motion import Walk
from graphvio.simulation.scenes import furniture
from graphvio.simulation.world import Lamp, Scene, World

_HEIGHT_M = 2.7
_BODY_Z_M = 1.5
_SPEED_MPS = 1.2
_HALF_M = 1.0

_EAST_X = 11.0  # middle of the legs to the east and west; those to the south and north lie at 0 and _NORTH_Y
_NORTH_Y = 11.0
_LOBBY_X = (2.5, 8.5)
_LOBBY_Y = -3.5
_ROUND = [(0.0, 0.0), (_EAST_X, 0.0), (_EAST_X, _NORTH_Y), (-_EAST_X, _NORTH_Y), (-_EAST_X, 0.0), (0.0, 0.0)]
_TURN = [(6.4, 0.0), (6.1, -1.5), (2.8, 0.0)]  # a wide turn in the lobby; one on the spot would be too sharp
_BACK_X = -2.0
_ROUND_M = 4.0 * _EAST_X + 2.0 * _NORTH_Y

_DOOR_M = (1.0, 2.1)
_BOARD_M = 0.8


def build(duration_s: float, stationary_s: float) -> Scene:
    """Build a walk of 82 m: the round of 66 m, 6 m more, the turn, and back to 2 m before the starting point."""
    world = World(ambient=0.42)
    _walls(world)
    _floors(world)
    _furnish(world)
    _light(world)
    path = np.array([(x, y, _BODY_Z_M) for x, y in (*_ROUND, *_TURN, (_BACK_X, 0.0))])
    walk = Walk(path, _SPEED_MPS, duration_s, stationary_s)
    corner_at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    events = {
        "again": (walk.time_at(_ROUND_M), walk.time_at(corner_at[-4])),
        "turn": (walk.time_at(corner_at[-4] - 1.0), walk.time_at(corner_at[-3] + 1.0)),
        "back": (walk.time_at(corner_at[-2]), walk.time_at(corner_at[-1] - 0.01)),  # at the end the time is not unique
    }
    return Scene("loop", world, walk.motion, events=events)


def _walls(world: World) -> None:
    inside, outside = _EAST_X - _HALF_M, _EAST_X + _HALF_M
    low, high = _NORTH_Y - _HALF_M, _NORTH_Y + _HALF_M
    w, (x1, x2) = _HALF_M, _LOBBY_X
    # Each wall from left to right, as seen from the corridor; the legs to the east and west look most alike.
    _wall(world, (-inside, w), (inside, w), ("plaster", "brick", "plaster", "concrete"), first=0)
    _wall(world, (inside, w), (inside, low), ("brick", "plaster"), first=3)
    _wall(world, (inside, low), (-inside, low), ("concrete", "plaster", "brick", "plaster"), first=6)
    _wall(world, (-inside, low), (-inside, w), ("brick", "plaster"), first=3)
    _wall(world, (-outside, -w), (-outside, high), ("plaster", "concrete", "plaster"), first=2)
    _wall(world, (-outside, high), (outside, high), ("brick", "plaster", "concrete", "plaster", "brick"), first=5)
    _wall(world, (outside, high), (outside, -w), ("plaster", "concrete", "plaster"), first=2)
    _wall(world, (outside, -w), (x2, -w), ("brick",), first=8)
    _wall(world, (x1, -w), (-outside, -w), ("concrete", "brick", "plaster"), first=1)
    for a, b, texture, first in (
        ((x2, -w), (x2, _LOBBY_Y), "concrete", 4),
        ((x2, _LOBBY_Y), (x1, _LOBBY_Y), "plaster", 7),
        ((x1, _LOBBY_Y), (x1, -w), "brick", 5),
    ):
        world.wall(a, b, 0.0, _HEIGHT_M, texture)
        furniture.pictures(world, a, b, first)


def _wall(
    world: World, start: tuple[float, float], end: tuple[float, float], textures: tuple[str, ...], first: int
) -> None:
    """Add a wall in equal segments, each with a door in its middle, a board to its right and a picture to its left."""
    a, b = np.array(start), np.array(end)
    along = (b - a) / np.linalg.norm(b - a)
    half = 0.5 * float(np.linalg.norm(b - a)) / len(textures)
    door, board = 0.5 * _DOOR_M[0], 0.5 * _DOOR_M[0] + 0.3

    def at(middle: float, offset: float) -> tuple[float, float]:
        x, y = a + (middle + offset) * along
        return float(x), float(y)

    for k, texture in enumerate(textures):
        m = (2 * k + 1) * half
        world.wall(at(m, -half), at(m, half), 0.0, _HEIGHT_M, texture)
        world.poster(at(m, -door), at(m, door), 0.02, _DOOR_M[1], "door")
        world.poster(at(m, board), at(m, board + _BOARD_M), 1.15, 1.85, "notices")
        furniture.pictures(world, at(m, 0.1 - half), at(m, -door - 0.1), first + 3 * k, spacing_m=1.45)


def _floors(world: World) -> None:
    inside, outside = _EAST_X - _HALF_M, _EAST_X + _HALF_M
    low, high = _NORTH_Y - _HALF_M, _NORTH_Y + _HALF_M
    w = _HALF_M
    for x, y, texture in (
        ((-outside, outside), (-w, w), "tiles"),
        ((-outside, outside), (low, high), "carpet"),
        ((inside, outside), (w, low), "planks"),
        ((-outside, -inside), (w, low), "planks"),
        (_LOBBY_X, (_LOBBY_Y, -w), "carpet"),
    ):
        world.floor(x, y, 0.0, texture)
        world.ceiling(x, y, _HEIGHT_M, "ceiling")


def _furnish(world: World) -> None:
    """Add furniture along the walls and between the doors, so that more than a metre remains to walk in."""
    furniture.sofa(world, 5.8, -3.0, 0.5 * np.pi)
    furniture.table(world, 3.6, -3.05, 0.0, 1.2, 0.7)
    furniture.bookcase(world, 8.3, -2.4, np.pi)
    world.box((-7.0, -0.85, 0.0), (1.2, 0.28, 1.8), "lockers")
    world.box((1.2, 0.86, 0.0), (1.0, 0.26, 0.45), "wood")
    world.box((-8.3, 0.86, 0.0), (0.5, 0.26, 1.1), "stripes")
    x, y = _EAST_X, _NORTH_Y
    world.box((x + 0.85, 3.2, 0.0), (0.28, 1.2, 1.8), "wood", front="books")
    world.box((x - 0.86, 5.4, 0.0), (0.26, 1.1, 0.45), "wood")
    world.box((-x - 0.85, 3.6, 0.0), (0.28, 1.4, 1.2), "lockers")
    world.box((-x + 0.86, 5.5, 0.0), (0.26, 0.5, 0.9), "stripes")
    world.box((5.0, y - 0.86, 0.0), (1.1, 0.26, 0.45), "fabric")
    world.box((2.4, y + 0.85, 0.0), (1.4, 0.28, 1.8), "lockers")
    world.box((-4.8, y - 0.86, 0.0), (0.5, 0.26, 1.3), "books")
    world.box((-7.4, y + 0.86, 0.0), (1.2, 0.26, 0.8), "wood", tint=1.3)


def _light(world: World) -> None:
    spots = [(x, y) for x in (-_EAST_X, -7.3, -3.7, 0.0, 3.7, 7.3, _EAST_X) for y in (0.0, _NORTH_Y)]
    spots += [(x, y) for x in (-_EAST_X, _EAST_X) for y in (_NORTH_Y / 3.0, _NORTH_Y / 1.5)]
    spots.append((sum(_LOBBY_X) / 2.0, -2.3))
    world.lamps += [Lamp(np.array([x, y, _HEIGHT_M - 0.2]), 1.0) for x, y in spots]
