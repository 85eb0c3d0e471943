"""Noise of corners' positions, as the residuals of an adjustment show it."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.self_calibration.bundle import Tracks

_MIN_SIGMA_PX = 0.12  # errors of registration that all tracks share do not show in residuals
_NOISE_FACTOR = 2.0  # on the noise that residuals show: observations of one track are correlated
_RAYLEIGH_MEDIAN = 1.1774  # of the norm of two standard normal variables
_MIN_OBSERVATIONS = 10  # of a view, before its noise is judged
_MIN_EXCESS = 1.5  # ratio of the noise that a view shows to the one that was assumed


def pixel_noise(errors2: Float, sigma_px: float | Float) -> float:
    """Return the standard deviation of a corner's position for the next adjustment, px.

    Args:
        errors2: squared errors of the views, whitened by the noise that was assumed; NaN where there is no view.
        sigma_px: noise that was assumed, of all or of each.
    """
    noise = float(np.sqrt(np.nanmedian(errors2 * np.square(sigma_px)))) / _RAYLEIGH_MEDIAN
    return max(_NOISE_FACTOR * noise, _MIN_SIGMA_PX)


def noise_of_views(tracks: Tracks, errors2: Float) -> Float:
    """Return the noise (N,) of each observation, px.

    A view, what one pair or camera sees at one keyframe, whose residuals show clearly more noise than was assumed gets
    its own: over-exposed and blurred images lie among sharp ones.

    Args:
        tracks: with the noise that was assumed.
        errors2: (N, 2) squared errors, whitened by it; NaN where there is no right image.
    """
    view = np.repeat(tracks.pair, np.diff(tracks.rows)) * (1 + tracks.keyframe.max(initial=0)) + tracks.keyframe
    squares = errors2 * np.square(tracks.sigma_px)[:, None]
    shown_px = _NOISE_FACTOR * np.sqrt(_medians(squares.ravel(), np.repeat(view, 2))) / _RAYLEIGH_MEDIAN
    is_judged = np.bincount(view)[view] >= _MIN_OBSERVATIONS
    is_noisier = is_judged & (shown_px[view] > _MIN_EXCESS * tracks.sigma_px)
    return np.where(is_noisier, shown_px[view], tracks.sigma_px)


def _medians(values: Float, group: Int) -> Float:
    """Return the medians (G,) of values (N,) in groups of 0 to G - 1; NaN is left out, and the result of nothing."""
    n_groups, known = group.max(initial=-1) + 1, ~np.isnan(values)
    values, group = values[known], group[known]
    order = np.lexsort((values, group))
    counts = np.bincount(group, minlength=n_groups)
    firsts = np.cumsum(counts) - counts
    medians = np.full(len(counts), np.nan)
    filled = counts > 0
    lower, upper = (firsts + (counts - 1) // 2)[filled], (firsts + counts // 2)[filled]
    medians[filled] = 0.5 * (values[order[lower]] + values[order[upper]])
    return medians
