"""What a camera of the rig sees: radiance without noise, and the depth that belongs to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphvio.arrays import Bool, Float
from graphvio.cameras import distort
from graphvio.geometry import se3_inverse
from graphvio.kernels import kernel
from graphvio.rig import Camera
from graphvio.simulation.atlas import Atlas
from graphvio.simulation.raycast import TILE_PX, first_hits, ray_coefficients, shade, tile_lists
from graphvio.simulation.surfaces import Surfaces


@dataclass(frozen=True, eq=False)
class View:
    """One rendered view.

    Attributes:
        radiance: (H, W) float32, 1 for a white surface in full light.
        depth: (H, W) metres along the camera's z axis, at each pixel's centre; infinite where nothing is.
        is_moving: (H, W) whether what is seen there moves by itself.
    """

    radiance: NDArray[np.float32]
    depth: Float
    is_moving: Bool


class CameraRays:
    """The rays of a camera's pixels, computed once: exact for its distortion."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        width, height = camera.size_px
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
        rays, valid = camera.unproject(pixels.astype(np.float64))
        if not valid.all():
            raise ValueError(f"camera {camera.name}: {np.count_nonzero(~valid)} pixels have no ray")
        self.rays = rays.reshape(height, width, 2)
        slopes = _ray_slopes(camera.model_number, camera.intrinsics, camera.distortion, rays)
        self.slopes = slopes.reshape(height, width, 2, 2)
        self.tile_boxes = _tile_boxes(self.rays, self.slopes)

    def render(self, surfaces: Surfaces, atlas: Atlas, world_T_cam: Float) -> View:
        """The view from a pose ``world_T_cam`` (4, 4)."""
        coefficients = ray_coefficients(surfaces.corners, se3_inverse(world_T_cam))
        starts, items, bounds = tile_lists(coefficients, self.tile_boxes)
        hit, inverse_depth = first_hits(coefficients, starts, items, bounds, self.rays)
        radiance = shade(
            coefficients, starts, items, bounds, self.rays, self.slopes, hit,
            surfaces.texture, surfaces.mapping, surfaces.tint, atlas.texels, atlas.starts, atlas.sides,
            surfaces.light.values, surfaces.light.grid,
        )  # fmt: skip
        with np.errstate(divide="ignore"):
            depth = 1.0 / inverse_depth
        return View(radiance, depth, surfaces.is_moving[hit] & (hit >= 0))


@kernel
def _ray_slopes(model: int, intrinsics: Float, distortion: Float, rays: Float) -> Float:
    """Derivatives (N, 2, 2) of rays (N, 2) by the pixel's column and row."""
    slopes = np.empty((len(rays), 2, 2))
    for i in range(len(rays)):
        _, _, a, b, c, d = distort(model, distortion, rays[i, 0], rays[i, 1])
        determinant = a * d - b * c
        slopes[i, 0, 0] = d / (determinant * intrinsics[0])
        slopes[i, 0, 1] = -b / (determinant * intrinsics[1])
        slopes[i, 1, 0] = -c / (determinant * intrinsics[0])
        slopes[i, 1, 1] = a / (determinant * intrinsics[1])
    return slopes


def _tile_boxes(rays: Float, slopes: Float) -> Float:
    """Extent (T, 4) ``[x0, x1, y0, y1]`` of the rays of each tile, with half a pixel around it."""
    height, width = rays.shape[:2]
    margin = 0.51 * np.abs(slopes).sum(axis=3)
    low, high = rays - margin, rays + margin
    boxes = []
    for top in range(0, height, TILE_PX):
        for left in range(0, width, TILE_PX):
            tile = np.s_[top : top + TILE_PX, left : left + TILE_PX]
            x0, y0 = low[tile].min(axis=(0, 1))
            x1, y1 = high[tile].max(axis=(0, 1))
            boxes.append([x0, x1, y0, y1])
    return np.array(boxes)
