"""Lighting of surfaces by lamps, with shadows; computed once for all static surfaces.

The light on a rectangle is computed at a grid of points and interpolated between them.
"""

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.kernels import kernel
from graphvio.simulation.world import Lamp, Rectangle

_GRID_M = 0.25
_REACH_M = 9.0
_LAMP_RADIUS2_M2 = 0.4  # keeps the light finite next to a lamp
_EVEN_LIGHT = 0.62


@dataclass(frozen=True, eq=False)
class LightMap:
    """Light on Q rectangles: values (L,) float32, and grid (Q, 3) with the offset into them, columns (u), rows (v)."""

    values: np.ndarray[tuple[int], np.dtype[np.float32]]
    grid: Int


def light_map(rectangles: list[Rectangle], lamps: list[Lamp], ambient: float) -> LightMap:
    """Compute the light on every rectangle, with the shadows that they cast on each other."""
    grid = np.zeros((len(rectangles), 3), dtype=np.int64)
    points, normals = [], []
    even: list[tuple[int, int, float]] = []
    end = 0
    for i, r in enumerate(rectangles):
        columns, rows = (1, 1) if r.lit_evenly or not lamps else (_cells(r.edge_u), _cells(r.edge_v))
        # The grid ends just before the edge, where a point would lie inside the neighbouring wall.
        u, v = np.meshgrid(np.linspace(0.01, 0.99, columns), np.linspace(0.01, 0.99, rows))
        points.append(r.origin + u.reshape(-1, 1) * r.edge_u + v.reshape(-1, 1) * r.edge_v)
        normals.append(np.repeat(r.normal[None], rows * columns, axis=0))
        grid[i] = end, columns, rows
        if r.lit_evenly:
            even.append((i, end, _EVEN_LIGHT + 0.002 * float(r.normal @ [0.3, 0.7, 1.0])))
        end += rows * columns
    blockers = [np.stack([r.origin, r.edge_u, r.edge_v]) for r in rectangles if r.casts_shadow]
    values = irradiance(
        np.concatenate(points),
        np.concatenate(normals),
        _lamp_array(lamps),
        np.array(blockers).reshape(-1, 3, 3),
    )
    values += ambient
    for _, start, value in even:
        values[start] = value
    return LightMap(values.astype(np.float32), grid)


def light_without_shadow(points: Float, normals: Float, lamps: list[Lamp], ambient: float) -> Float:
    """Compute the light (N,) at points (N, 3) of moving parts with unit normals (N, 3), without shadows."""
    return irradiance(points, normals, _lamp_array(lamps), np.zeros((0, 3, 3))) + ambient


@kernel
def irradiance(points: Float, normals: Float, lamps: Float, blockers: Float) -> Float:
    """Compute the direct light of lamps, with shadows.

    Args:
        points: (N, 3), metres.
        normals: (N, 3) unit normals.
        lamps: (M, 4) position in metres, and power.
        blockers: (B, 3, 3) origin, edge_u, edge_v of rectangles that cast shadows, metres.

    Returns:
        Light (N,), without the ambient part.
    """
    total = np.zeros(len(points))
    for i in range(len(points)):
        for k in range(len(lamps)):
            x = lamps[k, 0] - points[i, 0]
            y = lamps[k, 1] - points[i, 1]
            z = lamps[k, 2] - points[i, 2]
            distance2 = x * x + y * y + z * z
            facing = x * normals[i, 0] + y * normals[i, 1] + z * normals[i, 2]
            if distance2 > _REACH_M * _REACH_M or facing <= 0.0:
                continue
            blocked = False
            for b in range(len(blockers)):
                if _blocks(blockers[b], points[i], x, y, z):
                    blocked = True
                    break
            if not blocked:
                fade = 1.0 - distance2 / (_REACH_M * _REACH_M)  # no step where a lamp's reach ends
                cosine = facing / np.sqrt(distance2)
                total[i] += lamps[k, 3] * cosine * fade * fade / (distance2 + _LAMP_RADIUS2_M2)
    return total


@kernel
def _blocks(rectangle: Float, start: Float, x: float, y: float, z: float) -> bool:
    """Return whether the segment from start along (x, y, z) passes through a rectangle (origin, edge_u, edge_v)."""
    ux, uy, uz = rectangle[1, 0], rectangle[1, 1], rectangle[1, 2]
    vx, vy, vz = rectangle[2, 0], rectangle[2, 1], rectangle[2, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    slope = nx * x + ny * y + nz * z
    if abs(slope) < 1e-12:
        return False
    ox, oy, oz = rectangle[0, 0] - start[0], rectangle[0, 1] - start[1], rectangle[0, 2] - start[2]
    t = (nx * ox + ny * oy + nz * oz) / slope
    if t < 1e-3 or t > 0.999:
        return False
    px, py, pz = t * x - ox, t * y - oy, t * z - oz
    u = (px * ux + py * uy + pz * uz) / (ux * ux + uy * uy + uz * uz)
    v = (px * vx + py * vy + pz * vz) / (vx * vx + vy * vy + vz * vz)
    return bool(0.0 <= u <= 1.0 and 0.0 <= v <= 1.0)


def _cells(edge: Float) -> int:
    return int(np.ceil(np.linalg.norm(edge) / _GRID_M)) + 1


def _lamp_array(lamps: list[Lamp]) -> Float:
    return np.array([[*lamp.position, lamp.power] for lamp in lamps]).reshape(-1, 4)
