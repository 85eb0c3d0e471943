"""A smooth random texture whose grey is known at any place, not only at pixels: a sum of waves."""

import numpy as np

from graphvio.arrays import Float, Image

_WAVES = 80


def waves(x: Float, y: Float, seed: int = 0) -> Float:
    """Texture at (x, y), of zero mean, rms 1, and a wavelength of some 25 pixels."""
    rng = np.random.default_rng(seed)
    grey = np.zeros(np.shape(x))
    for _ in range(_WAVES):
        kx, ky = rng.normal(0.0, 0.25, 2)
        phase = kx * x + ky * y + rng.uniform(0.0, 2.0 * np.pi)
        grey += np.cos(phase.astype(np.float32))  # much sooner done; it is off by a thousandth of a grey level
    return np.asarray(grey / np.sqrt(0.5 * _WAVES))


def picture(grey: Float, mean: float = 128.0, contrast: float = 45.0) -> Image:
    """An image of a texture, with so many grey levels rms."""
    return np.asarray(np.clip(np.round(mean + contrast * grey), 0, 255), dtype=np.uint8)
