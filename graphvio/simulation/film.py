"""From radiance to grey values: exposure, vignetting, shot and read noise, 8 bit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import AnyArray, Image
from graphvio.kernels import kernel
from graphvio.simulation.renderer import CameraRays

_VIGNETTING = 0.32  # light lost in the corner of the image
_SHOT_VARIANCE = 0.02  # grey levels squared for every grey level of light: 50 electrons each
_READ_NOISE = 0.7  # grey levels at gain 1


@dataclass(frozen=True)
class Exposure:
    """How the sensor is driven: ``light`` of the scene (1 is full), and ``gain`` of the auto-exposure."""

    light: float
    gain: float


class Film:
    """The sensor behind one camera's lens."""

    def __init__(self, rays: CameraRays, sensitivity: float) -> None:
        width, height = rays.camera.size_px
        y, x = np.mgrid[0:height, 0:width]
        fx, fy, cx, cy = rays.camera.intrinsics
        radius2 = ((x - cx) / fx) ** 2 + ((y - cy) / fy) ** 2
        falloff = 1.0 - _VIGNETTING * radius2 / radius2.max()
        self._response = (255.0 * sensitivity * falloff).astype(np.float32)

    def expose(self, radiance: AnyArray, exposure: Exposure, noise: np.random.Generator | None) -> Image:
        """Grey image (H, W) of a radiance (H, W); without noise if there is no generator for it."""
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
