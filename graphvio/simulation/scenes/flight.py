"""Scene ``flight``: over fields with trees and houses, and cars on the roads between them; it begins in the air."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.simulation.ride import Ride, Vehicle
from graphvio.simulation.scenes import scenery
from graphvio.simulation.world import Scene, World

_DRONE = Vehicle(50.0, lean=1.0 / 9.81, sway_m=(0.05, 0.05, 0.03), sway_hz=0.3, tilt_rad=0.006, tilt_hz=1.0)
_SPEEDS = ((0.0, 0.0), (4.0, 8.0), (38.0, 8.0), (42.0, 0.0))
_HEADINGS = ((4.0, 0.0), (9.0, -15.0), (16.0, 40.0), (21.0, 45.0), (27.0, -20.0), (34.0, 30.0))
_CENTRE = np.array([120.0, 30.0])
_PLOT_M, _ROAD_M = 60.0, 5.0
_PLOTS, _BUILT_PLOTS = 8, (4, 3)  # fields to each side of the centre, and those along x and y with houses and trees


def build(duration_s: float, stationary_s: float) -> Scene:
    """Build a flight of 240 m in 30 s at a height of 50 m, at 8 m/s from the beginning; ``stationary_s`` is ignored."""
    ride = Ride(_SPEEDS, _HEADINGS, _DRONE)
    world = World(ambient=0.8)
    rng = np.random.default_rng(8)
    x, y = _CENTRE.tolist()
    scenery.hills_and_sky(world, (x, y), "field")
    reach = (_PLOTS + 0.5) * _PLOT_M
    world.floor((x - reach, x + reach), (y - reach, y + reach), 0.02, "asphalt")
    for i in range(-_PLOTS, _PLOTS + 1):
        for j in range(-_PLOTS, _PLOTS + 1):
            middle = _CENTRE + _PLOT_M * np.array([i, j])
            _field(world, middle, rng)
            if abs(i) <= _BUILT_PLOTS[0] and abs(j) <= _BUILT_PLOTS[1]:
                _things(world, middle, rng)
    return Scene("flight", world, ride.motion(duration_s, 0.0), rig="drone", rate_hz=20.0)


def _field(world: World, middle: Float, rng: np.random.Generator) -> None:
    half = 0.5 * (_PLOT_M - _ROAD_M)
    (x0, y0), (x1, y1) = (middle - half).tolist(), (middle + half).tolist()
    texture = str(rng.choice(["grass", "field", "soil"]))
    world.floor((x0, x1), (y0, y1), 0.05, texture, float(rng.uniform(0.6, 1.4)))


def _things(world: World, middle: Float, rng: np.random.Generator) -> None:
    """Add houses on one half of a field, trees on the other, and cars on the road along y."""
    flip = rng.choice([-1.0, 1.0], 2)
    for k in range(rng.integers(0, 3)):
        size, yaw = rng.uniform((9.0, 8.0, 3.5), (15.0, 12.0, 8.0)).tolist(), float(rng.uniform(-0.4, 0.4))
        place = middle + flip * np.array([16.0 - 32.0 * k, rng.uniform(10.0, 18.0)])
        scenery.house(world, place, size, yaw, f"facade{rng.integers(2)}", float(rng.uniform(0.7, 1.2)))
    for _ in range(rng.integers(1, 7)):
        place = middle + flip * rng.uniform((-24.0, -24.0), (24.0, 0.0))
        scenery.tree(world, place, float(rng.uniform(4.0, 10.0)), int(rng.integers(20)))
    if rng.random() < 0.5:
        place = middle + np.array([0.5 * _PLOT_M + 1.2, rng.uniform(-24.0, 24.0)])
        scenery.car(world, place, 0.5 * np.pi, float(rng.uniform(0.4, 1.4)))
