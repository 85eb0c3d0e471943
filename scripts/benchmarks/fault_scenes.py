"""Recordings that the campaign of faults runs on: the simulator's scenes and two of its own, rendered once and kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.recordings import rendered_once
from graphvio.simulation import SCENE_NAMES, Simulator, build_scene, write_recording
from graphvio.simulation.motion import Walk
from graphvio.simulation.noise import Map
from graphvio.simulation.textures import Atlas, checkerboard, pack, standard_atlas
from graphvio.simulation.world import Lamp, Scene, World

CORRIDOR_S = 38.0
"""Until after the door, the crowd, the blank bend and the failing lamps."""

_HEIGHT_M = 2.8
_BODY_Z_M = 1.45
_SPEED_MPS = 1.0
_RATE_HZ = 20.0


def recording(data: Path, scene: str, duration_s: float, seed: int = 0) -> Path:
    """The folder of a rendered scene; it is rendered when it is not there yet, or the simulator has changed.

    Args:
        data: folder of all renders.
        scene: of the simulator's, or ``repeating`` or ``bare``.
        duration_s: length of the walk.
        seed: of the noise.

    Raises:
        GraphvioError: if it cannot be made.
    """

    def render(folder: Path) -> None:
        write_recording(_simulator(scene, duration_s, seed), folder)

    return rendered_once(data / "faults", scene, f"{duration_s:g}s-seed{seed}", render, Path(__file__))


def texture_map(name: str) -> Map:
    """Reflectance (side, side) of one of the simulator's textures."""
    atlas = standard_atlas()
    number = atlas.numbers[name]
    side, start = int(atlas.sides[number]), int(atlas.offsets[number, 0])
    return atlas.texels[start : start + side * side].reshape(side, side)


def _simulator(scene: str, duration_s: float, seed: int) -> Simulator:
    if scene in SCENE_NAMES:
        return Simulator(build_scene(scene, duration_s), seed=seed, rate_hz=_RATE_HZ)
    if scene == "repeating":
        return Simulator(_repeating(duration_s), seed=seed, rate_hz=_RATE_HZ, atlas=_grids())
    if scene == "bare":
        return Simulator(_bare(duration_s), seed=seed, rate_hz=_RATE_HZ)
    raise ValueError(f"there is no scene {scene!r}")


def _grids() -> Atlas:
    """Perfectly periodic textures: squares of 20 and 8 cm, and bars."""
    bars = np.broadcast_to(np.where(np.arange(512) * 16 // 512 % 2, 0.2, 0.75).astype(np.float32), (512, 512))
    return pack(
        {
            "squares": (checkerboard(8), 1.6),
            "small squares": (checkerboard(16), 1.28),
            "bars": (np.ascontiguousarray(bars), 1.6),
        }
    )


def _repeating(duration_s: float) -> Scene:
    """A hall that is tiled all over with the same squares, as bathrooms and underpasses are."""
    world = World(ambient=0.9)
    world.outline(_outline(), 0.0, _HEIGHT_M, ("small squares", "squares", "small squares", "bars"))
    world.floor((-4.0, 4.0), (-3.0, 3.0), 0.0, "squares")
    world.ceiling((-4.0, 4.0), (-3.0, 3.0), _HEIGHT_M, "small squares")
    return Scene("repeating", world, _round(duration_s).motion)


def _bare(duration_s: float) -> Scene:
    """A blank room with one picture on each wall and a cupboard: few points, often in one corner of the view."""
    world = World(ambient=0.5)
    outline = _outline()
    world.outline(outline, 0.0, _HEIGHT_M, ("blank",) * 4)
    world.floor((-4.0, 4.0), (-3.0, 3.0), 0.0, "blank")
    world.ceiling((-4.0, 4.0), (-3.0, 3.0), _HEIGHT_M, "blank")
    for i, name in enumerate(("poster0", "window", "painting1", "notices")):
        a, b = np.array(outline[i]), np.array(outline[(i + 1) % 4])
        p, q = a + 0.45 * (b - a), a + 0.60 * (b - a)
        world.poster((float(p[0]), float(p[1])), (float(q[0]), float(q[1])), 0.9, 1.8, name)
    world.box((3.4, 2.6, 0.0), (0.6, 0.5, 1.1), "wood", 0.3)
    world.lamps.append(Lamp(np.array([0.0, 0.0, _HEIGHT_M - 0.2]), 1.5))
    return Scene("bare", world, _round(duration_s).motion)


def _outline() -> list[tuple[float, float]]:
    return [(-4.0, -3.0), (-4.0, 3.0), (4.0, 3.0), (4.0, -3.0)]


def _round(duration_s: float) -> Walk:
    ring = [(-1.5, -1.0), (1.8, -1.2), (2.0, 1.2), (-2.0, 1.4), (-1.8, -1.0), (1.8, -1.2)]
    return Walk(np.array([(x, y, _BODY_Z_M) for x, y in ring]), _SPEED_MPS, duration_s)
