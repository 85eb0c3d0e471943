"""Noise of corners' positions, as the residuals of an adjustment show it."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float

_MIN_SIGMA_PX = 0.12  # errors of registration that all tracks share do not show in residuals
_NOISE_FACTOR = 2.0  # on the noise that residuals show: observations of one track are correlated
_RAYLEIGH_MEDIAN = 1.1774  # of the norm of two standard normal variables


def pixel_noise(errors2: Float, sigma_px: float) -> float:
    """Return the standard deviation of a corner's position for the next adjustment, px.

    Args:
        errors2: squared errors of the views, whitened by the noise that was assumed; NaN where there is no view.
        sigma_px: noise that was assumed.
    """
    noise = float(np.sqrt(np.nanmedian(errors2))) / _RAYLEIGH_MEDIAN * sigma_px
    return max(_NOISE_FACTOR * noise, _MIN_SIGMA_PX)
