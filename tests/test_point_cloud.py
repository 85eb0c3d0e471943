"""points.ply, read back by its header, and its points compared with COLMAP's model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphvio.arrays import AnyArray
from graphvio.optimization.exchange import Points, model_points, ply

_TYPES = {"float": "<f4", "uchar": "u1"}


def read_ply(data: bytes) -> AnyArray:
    """Read a file by its own header, as other programs do."""
    header, end, body = data.partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert end
    count = int(next(line for line in lines if line.startswith("element vertex")).split()[2])
    fields = [(name, _TYPES[kind]) for _, kind, name in (line.split() for line in lines if line.startswith("property"))]
    rows = np.frombuffer(body, dtype=fields)
    assert len(rows) == count
    return rows


@pytest.mark.parametrize("count", [0, 1, 100])
def test_ply_holds_positions_and_grey(count: int) -> None:
    rng = np.random.default_rng(count)
    points = Points(rng.normal(size=(count, 3)), rng.integers(0, 256, count).astype(np.uint8))
    rows = read_ply(ply(points))
    for k, axis in enumerate("xyz"):
        np.testing.assert_allclose(rows[axis], points.positions[:, k], rtol=1e-6)
    for channel in ("red", "green", "blue"):
        np.testing.assert_array_equal(rows[channel], points.grey)


def test_model_points_are_colmap_s_in_order(tmp_path: Path) -> None:
    pycolmap: Any = pytest.importorskip("pycolmap", reason="pycolmap is not installed: the extra maps")
    model, rng = pycolmap.Reconstruction(), np.random.default_rng(0)
    positions, grey = rng.normal(size=(5, 3)), np.array([7, 50, 200, 255, 0], dtype=np.uint8)
    for position, value in zip(positions, grey, strict=True):
        model.add_point3D(position, pycolmap.Track(), np.full(3, value, dtype=np.uint8))
    model.write(tmp_path)
    points = model_points(tmp_path)
    np.testing.assert_allclose(points.positions, positions)
    np.testing.assert_array_equal(points.grey, grey)
