"""Rendering of camera images: radiance and depth along the rays, and the grey values that the sensor makes of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphvio.arrays import AnyArray, Bool, Float, Image
from graphvio.cameras import distort
from graphvio.geometry import se3_inverse
from graphvio.kernels import kernel
from graphvio.rig import Camera
from graphvio.simulation.raycast import TILE_PX, first_hits, ray_coefficients, shade, tile_lists
from graphvio.simulation.surfaces import Surfaces
from graphvio.simulation.textures import Atlas
from graphvio.simulation.world import Exposure

_VIGNETTING = 0.32  # light lost in the corner of the image
_SHOT_VARIANCE = 0.02  # grey levels squared per grey level of light: 50 electrons per grey level
_READ_NOISE = 0.7  # grey levels at gain 1


@dataclass(frozen=True, eq=False)
class RenderedView:
    """One rendered view, without noise.

    Attributes:
        radiance: (H, W) float32, 1 for a white surface in full light.
        depth: (H, W) metres along the camera's z axis, at each pixel's centre; infinite where there is no surface.
        is_moving: (H, W) whether the surface belongs to a moving part.
    """

    radiance: NDArray[np.float32]
    depth: Float
    is_moving: Bool


class CameraRays:
    """Rays of a camera's pixels, computed once and exact for its distortion.

    Pixels without a ray, such as those of a fisheye that are more than 80 degrees from its axis, stay black.

    Args:
        camera: a camera of the rig.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        width, height = camera.size_px
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
        rays, has_ray = camera.unproject(pixels.astype(np.float64))
        self._has_ray = has_ray.reshape(height, width)
        self.rays = rays.reshape(height, width, 2)
        slopes = _ray_slopes(camera.model_number, camera.intrinsics, camera.distortion, rays)
        self.slopes = slopes.reshape(height, width, 2, 2)
        self.tile_boxes = _tile_boxes(self.rays, self.slopes, TILE_PX if camera.line_time_us == 0.0 else 1)

    def render(self, surfaces: Surfaces, atlas: Atlas, world_T_cam: Float) -> RenderedView:
        """Render surfaces as seen from ``world_T_cam`` (4, 4), or (H, 4, 4) for the lines of a rolling shutter."""
        poses = world_T_cam.reshape(-1, 4, 4)
        coefficients = np.array([ray_coefficients(surfaces.corners, se3_inverse(pose)) for pose in poses])
        boxes = np.split(self.tile_boxes, len(poses))
        lists = [tile_lists(each, tiles) for each, tiles in zip(coefficients, boxes, strict=True)]
        ends = np.cumsum([0, *(len(items) for _, items, _ in lists)])
        offsets = np.concatenate(
            [each[:-1] + end for (each, _, _), end in zip(lists, ends, strict=False)] + [ends[-1:]]
        )
        items, bounds = (np.concatenate([each[k] for each in lists]) for k in (1, 2))
        hit, inverse_depth = first_hits(coefficients, offsets, items, bounds, self.rays)
        radiance = shade(
            coefficients, offsets, items, bounds, self.rays, self.slopes, hit,
            surfaces.texture, surfaces.mapping, surfaces.tint, atlas.texels, atlas.offsets, atlas.sides,
            surfaces.light.values, surfaces.light.grid,
        )  # fmt: skip
        radiance[~self._has_ray], hit[~self._has_ray], inverse_depth[~self._has_ray] = 0.0, -1, 0.0
        with np.errstate(divide="ignore"):
            depth = 1.0 / inverse_depth
        return RenderedView(radiance, depth, surfaces.is_moving[hit] & (hit >= 0))


@kernel
def _ray_slopes(model: int, intrinsics: Float, distortion: Float, rays: Float) -> Float:
    """Compute the derivative (N, 2, 2) of rays (N, 2) with respect to the pixel's column and row."""
    slopes = np.empty((len(rays), 2, 2))
    for i in range(len(rays)):
        _, _, a, b, c, d = distort(model, distortion, rays[i, 0], rays[i, 1])
        determinant = a * d - b * c
        slopes[i, 0, 0] = d / (determinant * intrinsics[0])
        slopes[i, 0, 1] = -b / (determinant * intrinsics[1])
        slopes[i, 1, 0] = -c / (determinant * intrinsics[0])
        slopes[i, 1, 1] = a / (determinant * intrinsics[1])
    return slopes


def _tile_boxes(rays: Float, slopes: Float, tile_height: int) -> Float:
    """Compute the extent (T, 4) ``[x0, x1, y0, y1]`` of each tile's rays, with a margin of half a pixel."""
    height, width = rays.shape[:2]
    margin = 0.51 * np.abs(slopes).sum(axis=3)
    tops, lefts = np.arange(0, height, tile_height), np.arange(0, width, TILE_PX)
    low = np.minimum.reduceat(np.minimum.reduceat(rays - margin, tops), lefts, axis=1)
    high = np.maximum.reduceat(np.maximum.reduceat(rays + margin, tops), lefts, axis=1)
    return np.stack([low[..., 0], high[..., 0], low[..., 1], high[..., 1]], axis=-1).reshape(-1, 4)


class Film:
    """Sensor of a camera: exposure, vignetting, shot and read noise, 8 bit.

    Args:
        rays: rays of the camera's pixels.
        sensitivity: grey value of full radiance, as a fraction of white.
    """

    def __init__(self, rays: CameraRays, sensitivity: float) -> None:
        width, height = rays.camera.size_px
        y, x = np.mgrid[0:height, 0:width]
        fx, fy, cx, cy = rays.camera.intrinsics
        radius2 = ((x - cx) / fx) ** 2 + ((y - cy) / fy) ** 2
        falloff = 1.0 - _VIGNETTING * radius2 / radius2.max()
        self._response = (255.0 * sensitivity * falloff).astype(np.float32)

    def expose(self, radiance: AnyArray, exposure: Exposure, noise: np.random.Generator | None) -> Image:
        """Convert a radiance (H, W) to a grey image (H, W), without noise if ``noise`` is None."""
        if noise is None:
            normal = np.zeros(radiance.shape, dtype=np.float32)
        else:
            normal = noise.standard_normal(radiance.shape, dtype=np.float32)
        return _expose(radiance, self._response, exposure.light, exposure.gain, normal, noise is not None)


@kernel
def _expose(radiance: AnyArray, response: AnyArray, light: float, gain: float, normal: AnyArray, noisy: bool) -> Image:
    image = np.empty(radiance.shape, dtype=np.uint8)
    read = gain * _READ_NOISE if noisy else 0.0
    shot = gain * _SHOT_VARIANCE if noisy else 0.0
    for row in range(radiance.shape[0]):
        for column in range(radiance.shape[1]):
            signal = gain * light * radiance[row, column] * response[row, column]
            value = signal + normal[row, column] * np.sqrt(shot * signal + read * read)
            image[row, column] = int(min(max(value + 0.5, 0.0), 255.0))
    return image
