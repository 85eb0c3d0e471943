"""Textures with their mipmaps, packed into one array that the renderer samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphvio.arrays import Float, Int

Map = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Atlas:
    """All textures with their mipmaps.

    Attributes:
        texels: (T,) float32 reflectance; level k of texture i starts at ``starts[i, k]``, row by row.
        starts: (n, levels) int64.
        sides: (n,) int64 texels of a side of level 0; level k has ``sides >> k``.
        tile_m: (n,) metres that one repetition covers.
        numbers: name -> index.
    """

    texels: Map
    starts: Int
    sides: Int
    tile_m: Float
    numbers: dict[str, int]


def pack(maps: dict[str, tuple[Map, float]]) -> Atlas:
    """An atlas of named maps, each (side, side) with the metres that one repetition covers."""
    levels = max(int(m.shape[0]).bit_length() for m, _ in maps.values())
    starts = np.zeros((len(maps), levels), dtype=np.int64)
    chunks: list[Map] = []
    end = 0
    for i, (texture, _) in enumerate(maps.values()):
        level = texture.astype(np.float32)
        for k in range(levels):
            if level.shape[0] > 0:
                starts[i, k] = end
                chunks.append(level.ravel())
                end += level.size
            half = level.shape[0] // 2
            level = level.reshape(half, 2, half, 2).mean(axis=(1, 3)) if half else level[:0]
    return Atlas(
        texels=np.concatenate(chunks),
        starts=starts,
        sides=np.array([m.shape[0] for m, _ in maps.values()], dtype=np.int64),
        tile_m=np.array([tile for _, tile in maps.values()]),
        numbers={name: i for i, name in enumerate(maps)},
    )
