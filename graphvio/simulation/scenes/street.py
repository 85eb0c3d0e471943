"""Scene ``street``: a ride by car along a street with turns, houses, trees, parked cars, and hills far away.

Objects along the street are placed by their distance along the route and to the side of it.
"""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.simulation.ride import Ride, Vehicle
from graphvio.simulation.scenes import scenery
from graphvio.simulation.world import Scene, World

_CAR = Vehicle(1.65, lean=-0.004, sway_m=(0.0, 0.0, 0.008), sway_hz=1.5, tilt_rad=0.004, tilt_hz=1.2)
_SPEEDS = (
    (0.0, 0.0), (4.0, 10.5), (7.0, 10.5), (8.5, 7.5), (12.0, 7.5), (13.5, 10.5), (16.0, 10.5), (17.5, 7.5), (21.0, 7.5),
    (22.5, 10.5), (30.0, 10.5), (34.0, 0.0),
)  # fmt: skip
_HEADINGS = ((8.0, 0.0), (12.0, 90.0), (17.0, 90.0), (21.0, 0.0), (24.0, 0.0), (26.5, 35.0))
_BEYOND_M = (60.0, 150.0)  # how far the street extends before and after the route
_STEP_M = 2.0
_HOUSES_M = (10.0, 16.0)  # from the route to the facades
_KERB_M = (4.6, 7.0)  # from the route to parked cars and to trees
_WALLS = ("facade0", "facade1", "facade0", "brick")


def build(duration_s: float, stationary_s: float) -> Scene:
    """Build a ride of 250 m in 30 s, at 10 m/s and slower in the turns."""
    ride = Ride(_SPEEDS, _HEADINGS, _CAR)
    world = World(ambient=0.8)
    route = _route(ride.path)
    x, y = route.mean(axis=0).tolist()
    scenery.hills_and_sky(world, (x, y), "asphalt")
    rng = np.random.default_rng(5)
    for side in (1, -1):
        _houses(world, route, side, rng)
        _roadside(world, route, side, rng)
    return Scene("street", world, ride.motion(duration_s, stationary_s), rig="car", rate_hz=10.0)


def _route(path: Float) -> Float:
    """Resample a path (N, 2) in equal steps, and extend it at both ends."""
    ahead = (path[-1] - path[-1000]) / np.linalg.norm(path[-1] - path[-1000])
    whole = np.vstack([[-_BEYOND_M[0], 0.0], path, path[-1] + _BEYOND_M[1] * ahead])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(whole, axis=0), axis=1))])
    return np.column_stack([np.interp(np.arange(0.0, along[-1], _STEP_M), along, whole[:, i]) for i in range(2)])


def _beside(route: Float, along_m: float, aside_m: float) -> tuple[Float, float]:
    """Return a place (2,) to the left of the route, and the street's yaw there."""
    k = min(round(along_m / _STEP_M), len(route) - 2)
    step = route[k + 1] - route[k]
    yaw = float(np.arctan2(step[1], step[0]))
    return route[k] + aside_m * np.array([-np.sin(yaw), np.cos(yaw)]), yaw


def _clear_m(route: Float, place: Float, length: float, depth: float, yaw: float) -> float:
    """Return the distance from a rectangle on the ground, given by its centre (2,), size and yaw, to the route."""
    c, s = np.cos(yaw), np.sin(yaw)
    local = (route - place) @ np.array([[c, -s], [s, c]])
    outside = np.maximum(np.abs(local) - 0.5 * np.array([length, depth]), 0.0)
    return float(np.linalg.norm(outside, axis=1).min())


def _houses(world: World, route: Float, side: int, rng: np.random.Generator) -> None:
    """Add a row of houses, with gaps where the street turns towards it."""
    along, number = 0.0, 0
    while along < _STEP_M * len(route):
        length, depth, height = rng.uniform((9.0, 10.0, 6.0), (22.0, 14.0, 16.0)).tolist()
        away, tint = rng.uniform(*_HOUSES_M) + 0.5 * depth, rng.uniform(0.65, 1.15)
        place, yaw = _beside(route, along + 0.5 * length, side * away)
        if _clear_m(route, place, length, depth, yaw) > _HOUSES_M[0] - 0.5:
            scenery.house(world, place, (length, depth, height), yaw, _WALLS[number % 4], tint)
        along += length + rng.uniform(1.0, 6.0)
        number += 1


def _roadside(world: World, route: Float, side: int, rng: np.random.Generator) -> None:
    """Add parked cars, and trees behind them."""
    for number in range(int(_STEP_M * len(route) / 7.0)):
        (along, size), tint = rng.uniform((0.0, 4.0), (3.0, 8.0)), rng.uniform(0.4, 1.4)
        place, yaw = _beside(route, 7.0 * number + along, side * _KERB_M[number % 2])
        if _clear_m(route, place, 4.2, 2.0, yaw) > 3.0 and rng.random() < 0.75:
            if number % 2:
                scenery.tree(world, place, float(size), number)
            else:
                scenery.car(world, place, yaw, tint)
