"""Noise of corners' positions, estimated from the residuals of an adjustment."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.self_calibration.bundle import Tracks

_MIN_SIGMA_PX = 0.12  # errors of registration that all tracks share do not show in residuals
_NOISE_FACTOR = 2.0  # on the noise that residuals show: observations of one track are correlated
_RAYLEIGH_MEDIAN = 1.1774  # median of the norm of two standard normal variables
_MIN_OBSERVATIONS = 10  # least number of a view's observations to estimate its noise
_MIN_EXCESS = 1.5  # ratio of the noise that a view shows to the one that was assumed


def pixel_noise(errors2: Float, sigma_px: float | Float) -> float:
    """Return the standard deviation of a corner's position for the next adjustment, px.

    Args:
        errors2: squared errors of the views, whitened by the noise that was assumed; NaN where there is no view.
        sigma_px: noise that was assumed, of all or of each.
    """
    return max(_shown_noise(errors2, sigma_px), _MIN_SIGMA_PX)


def noise_of_views(tracks: Tracks, errors2: Float) -> Float:
    """Return the noise (N,) of each observation, px.

    A view is what one pair or camera sees at one keyframe. If its residuals show clearly more noise than was assumed,
    it gets its own: over-exposed and blurred images lie among sharp ones.

    Args:
        tracks: tracks, with the noise that was assumed.
        errors2: (N, 2) squared errors, whitened by it; NaN where there is no right image.
    """
    noise_px, pair = tracks.sigma_px.copy(), np.repeat(tracks.pair, np.diff(tracks.rows))
    for j in np.unique(pair):
        for k in np.unique(tracks.keyframe[pair == j]):
            of_view = (pair == j) & (tracks.keyframe == k)
            if np.count_nonzero(of_view) >= _MIN_OBSERVATIONS:
                assumed_px = tracks.sigma_px[of_view]
                shown_px = _shown_noise(errors2[of_view], assumed_px[:, None])
                noise_px[of_view] = np.where(shown_px > _MIN_EXCESS * assumed_px, shown_px, assumed_px)
    return noise_px


def _shown_noise(errors2: Float, sigma_px: float | Float) -> float:
    """Return the noise that whitened errors show, px; at least one of them must be known."""
    return _NOISE_FACTOR * float(np.sqrt(np.nanmedian(errors2 * np.square(sigma_px)))) / _RAYLEIGH_MEDIAN
