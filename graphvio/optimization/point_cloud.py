"""Points of a map for other programs: a PLY file of positions and grey values."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from graphvio.arrays import AnyArray, Float
from graphvio.optimization.loops.colmap_library import colmap

_ROW = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]  # as viewers read it
)
_TYPES = {"<f4": "float", "|u1": "uchar"}


class Points(NamedTuple):
    """Points of a frame of the optimisation.

    Attributes:
        positions: (N, 3) in nav, metres.
        grey: (N,) uint8, mean of the images that see the point.
    """

    positions: Float
    grey: AnyArray


def model_points(model: Path) -> Points:
    """Read the points of a COLMAP model, in the order of their ids."""
    points = [point for _, point in sorted(colmap().Reconstruction(model).points3D.items())]
    positions = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    return Points(positions, np.array([point.color[0] for point in points], dtype=np.uint8))


def ply(points: Points) -> bytes:
    """Return points as a binary PLY file."""
    rows = np.zeros(len(points.grey), dtype=_ROW)
    for axis, values in zip("xyz", points.positions.T, strict=True):
        rows[axis] = values
    for channel in ("red", "green", "blue"):
        rows[channel] = points.grey
    properties = [f"property {_TYPES[kind.str]} {name}" for name, (kind, *_) in (_ROW.fields or {}).items()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties, "end_header", ""]
    return "\n".join(header).encode() + rows.tobytes()
