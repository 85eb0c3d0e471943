"""The surfaces of a world at one instant, as arrays for the renderer's kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.simulation.lighting import LightMap, light_map, light_without_shadow
from graphvio.simulation.textures import Atlas
from graphvio.simulation.world import Rectangle, World


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The rectangles of a world at one instant.

    Attributes:
        corners: (Q, 3, 3) origin, edge_u, edge_v; metres, frame world.
        texture: (Q,) index in the atlas.
        mapping: (Q, 4) texture repetitions along u, shift along u, and the same for v.
        tint: (Q,) factor of the reflectance.
        light: light on the rectangles.
        is_moving: (Q,) whether the rectangle belongs to a moving part.
    """

    corners: Float
    texture: Int
    mapping: Float
    tint: Float
    light: LightMap
    is_moving: Bool


class PreparedWorld:
    """A world whose static parts and light are computed once, for the surfaces at any time."""

    def __init__(self, world: World, atlas: Atlas) -> None:
        self.atlas = atlas
        self._world = world
        self._light = light_map(world.rectangles, world.lamps, world.ambient)
        parts = [r for part in world.moving for r in part.rectangles]
        everything = [*world.rectangles, *parts]
        self._corners = np.array([[r.origin, r.edge_u, r.edge_v] for r in everything])
        self._texture = np.array([atlas.numbers[r.texture] for r in everything], dtype=np.int64)
        self._mapping = np.array([_mapping(r, atlas) for r in everything])
        self._tint = np.array([r.tint for r in everything])
        self._is_moving = np.arange(len(everything)) >= len(world.rectangles)
        self._part_of = np.repeat(np.arange(len(world.moving)), [len(part.rectangles) for part in world.moving])
        one_cell = len(self._light.values) + np.arange(len(parts))
        self._grid = np.vstack([self._light.grid, np.column_stack([one_cell, np.ones((len(parts), 2), np.int64)])])

    def at(self, time_s: float) -> Surfaces:
        """Compute the surfaces at a time in seconds since the start of the walk."""
        corners, values = self._corners, self._light.values
        if self._world.moving:
            world_T_part = np.array([part.world_T_part(time_s) for part in self._world.moving])[self._part_of]
            local = self._corners[self._is_moving]
            turned = np.einsum("nij,nkj->nki", world_T_part[:, :3, :3], local)
            turned[:, 0] += world_T_part[:, :3, 3]
            corners = np.concatenate([self._corners[~self._is_moving], turned])
            centres = turned[:, 0] + 0.5 * (turned[:, 1] + turned[:, 2])
            normals = np.cross(turned[:, 2], turned[:, 1])
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            light = light_without_shadow(centres, normals, self._world.lamps, self._world.ambient)
            values = np.concatenate([values, light.astype(np.float32)])
        return Surfaces(
            corners, self._texture, self._mapping, self._tint, LightMap(values, self._grid), self._is_moving
        )


def _mapping(rectangle: Rectangle, atlas: Atlas) -> list[float]:
    if rectangle.fit:
        return [1.0, 0.0, 1.0, 0.0]
    tile_m = atlas.tile_m[atlas.numbers[rectangle.texture]]
    along_u = float(np.linalg.norm(rectangle.edge_u) / tile_m)
    along_v = float(np.linalg.norm(rectangle.edge_v) / tile_m)
    return [along_u, rectangle.shift[0], along_v, rectangle.shift[1]]
