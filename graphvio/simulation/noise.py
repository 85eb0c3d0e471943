"""Seamless noise for textures."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SIDE = 512

Rng = np.random.Generator
Map = NDArray[np.float32]


def noise(rng: Rng, coarsest: int, octaves: int, gain: float = 0.6) -> Map:
    """Sample seamless noise (SIDE, SIDE) of unit standard deviation.

    Args:
        rng: random generator.
        coarsest: cells along a side in the first octave; each octave is twice as fine as the one before.
        octaves: number of octaves.
        gain: amplitude of an octave relative to the one before.
    """
    total = np.zeros((SIDE, SIDE), dtype=np.float32)
    amplitude, cells = 1.0, coarsest
    for _ in range(octaves):
        lattice = np.pad(rng.standard_normal((cells, cells)).astype(np.float32), 2, mode="wrap")
        scale = SIDE // cells
        wide = cv2.resize(lattice, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        total += amplitude * wide[2 * scale : 2 * scale + SIDE, 2 * scale : 2 * scale + SIDE]
        amplitude *= gain
        cells = min(2 * cells, SIDE)
    return np.asarray(total / total.std(), dtype=np.float32)
