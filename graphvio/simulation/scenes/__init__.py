"""Scenes of the simulator by name."""

from __future__ import annotations

from collections.abc import Callable

from graphvio.errors import SourceError
from graphvio.simulation.scenes import corridor, flight, loop, rooms, stairs, street
from graphvio.simulation.world import Scene

_BUILDERS: dict[str, tuple[Callable[[float, float], Scene], float]] = {
    "calibration": (rooms.build_calibration, 40.0),
    "corridor": (corridor.build, 60.0),
    "flight": (flight.build, 30.0),
    "loop": (loop.build, 73.0),
    "room": (rooms.build_room, 40.0),
    "stairs": (stairs.build, 30.0),
    "street": (street.build, 30.0),
}

SCENE_NAMES = tuple(_BUILDERS)


def build_scene(name: str, duration_s: float | None = None, stationary_s: float = 1.0) -> Scene:
    """Build a scene by its name.

    Args:
        name: one of `SCENE_NAMES`.
        duration_s: duration of the motion; None for the whole walk. After the end of a walk the body is stationary.
        stationary_s: initial standstill; with 0 the motion begins at walking speed. A flight always begins at speed.

    Raises:
        SourceError: if there is no such scene, or the duration is not positive.
    """
    if name not in _BUILDERS:
        raise SourceError(f"there is no scene {name!r}; choose one of {', '.join(SCENE_NAMES)}")
    build, whole_s = _BUILDERS[name]
    if duration_s is not None and not 0.0 < duration_s < 3600.0:
        raise SourceError(f"a duration of {duration_s} s cannot be simulated; give seconds between 0 and 3600")
    return build(whole_s if duration_s is None else duration_s, stationary_s)
