"""Scenery for outdoor scenes: hills under a sky, houses, trees and cars."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphvio.arrays import Float
from graphvio.simulation.world import Rectangle, World

_SKY_M, _LID_M = 1100.0, 950.0  # distance of the sky, and height of its upper end
_RIDGES = ((920.0, 60.0, 130.0), (900.0, 10.0, 60.0))  # distance, lowest and highest top; metres
_FOOT_M = 150.0  # how far a ridge goes down, through the ground


def hills_and_sky(world: World, centre: tuple[float, float], ground: str) -> None:
    """Add a plain with hills at its border, 900 m from the centre, and the sky behind them."""
    rng = np.random.default_rng(11)
    x, y = centre
    for k in range(8):  # the texture is seamless: scaled to each side, it continues on the next one
        a, b = (np.array([*_on_circle(centre, _SKY_M, i / 8), _LID_M]) for i in (k, k + 1))
        world.rectangles.append(Rectangle(a, b - a, np.array([0.0, 0.0, -_LID_M]), "sky", fit=True))
    world.ceiling((x - _SKY_M, x + _SKY_M), (y - _SKY_M, y + _SKY_M), _LID_M, "sky")
    world.floor((x - _SKY_M, x + _SKY_M), (y - _SKY_M, y + _SKY_M), 0.0, ground)
    for distance, low, high in _RIDGES:
        tops = [np.array([*_on_circle(centre, distance, i / 60), rng.uniform(low, high)]) for i in range(60)]
        for a, b in zip(tops, tops[1:] + tops[:1], strict=True):
            shift, tint = (float(rng.random()), 0.0), float(rng.uniform(0.85, 1.05))
            world.rectangles.append(Rectangle(a, b - a, np.array([0.0, 0.0, -_FOOT_M]), "hills", False, shift, tint))


def _on_circle(centre: tuple[float, float], radius: float, part: float) -> tuple[float, float]:
    """Return the point of a circle at a fraction of a turn, clockwise, so that walls along it are seen from inside."""
    angle = -2.0 * np.pi * part
    return centre[0] + radius * float(np.cos(angle)), centre[1] + radius * float(np.sin(angle))


def house(world: World, place: Float, size: Sequence[float], yaw: float, walls: str, tint: float) -> None:
    """Add a house with a flat roof that projects over the walls, at a place (2,), the centre of its ground."""
    length, depth, height = size
    x, y = place.tolist()
    roof_tint = 2.5 - 1.6 * tint  # dark on bright walls
    world.box((x, y, 0.0), (length, depth, height), walls, yaw, tint=tint)
    world.box((x, y, height), (length + 0.8, depth + 0.8, 0.5), "roof", yaw, tint=roof_tint)


def tree(world: World, place: Float, height_m: float, number: int) -> None:
    """Add a tree at a place (2,), with a crown of two turned blocks; the number selects its shape."""
    x, y = place.tolist()
    trunk, tint = 0.4 * height_m, 0.75 + 0.1 * (number % 5)
    wide = (0.5 + 0.04 * (number % 4)) * height_m
    world.box((x, y, 0.0), (0.06 * height_m, 0.06 * height_m, trunk), "wood", 0.0, tint=0.8)
    for k, (low, size, height) in enumerate(((0.0, 1.0, 0.35), (0.12, 0.75, 0.48))):
        corner = (x, y, trunk + low * height_m)
        world.box(corner, (size * wide, size * wide, height * height_m), "leaves", 0.7 * (number + k), tint=tint)


def car(world: World, place: Float, yaw: float, tint: float) -> None:
    """Add a parked car at a place (2,), which faces along yaw."""
    x, y = place.tolist()
    world.box((x, y, 0.0), (1.8, 4.2, 1.4), "cloth", yaw + 0.5 * np.pi, front="car", tint=tint)
