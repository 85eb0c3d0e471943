"""Noise and covariance of a robust fit, from its residuals.

For an influence function ``psi(r) = w r`` the covariance of the minimum is ``E[psi^2] / E[psi']^2`` times the inverse
of the unweighted normal matrix (P. Huber, *Robust Statistics*, 1981, chapter 7).
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.kernels import kernel

_PRIOR_RESIDUALS = 3.0  # weight of the modelled noise, for where there are few points
_EXCESS_INFORMATION = 1.04  # factor by which normal matrices at noisy points are too large, by Monte Carlo
_CUTOFF = 25.0  # squared error over the noise variance: exceeded by one right point in 20,000 (4 degrees of freedom)
_MEDIAN_CHI2_OF_2, _MEDIAN_CHI2_OF_4 = 1.386, 3.357
_MIN_VARIANCE = 0.05
_POINTS_OF_EQUAL_NOISE = 10.0  # weight of the prior that a pair's noise is that of the others
_MAX_RATIO = 4.0  # variance over that of all pairs; a larger one is due to another motion, not to noise


class Influence(NamedTuple):
    """Moments of the residuals.

    Attributes:
        factor: factor on the inverse of the weighted normal matrix, which makes it the covariance.
        weight: mean of ``w``.
        slope: mean of ``psi'``.
        variance: variance of the noise, over the modelled one.
    """

    factor: float
    weight: float
    slope: float
    variance: float


@kernel
def influence(errors2: Float, has_right: Bool, scale: float) -> Influence:
    """Compute the moments of squared whitened errors (N,), of dimension 4 with a right image and 2 without."""
    n = weights = slopes = squares = 0.0
    for i in range(len(errors2)):
        if np.isfinite(errors2[i]):
            d, w = 4.0 if has_right[i] else 2.0, 1.0 / (1.0 + errors2[i] / scale**2)
            n += d
            weights += d * w
            slopes += d * influence_slope(errors2[i], has_right[i], scale)
            squares += w**2 * errors2[i]
    if n == 0.0:
        return Influence(1.0, 1.0, 1.0, 1.0)
    weight, slope = weights / n, slopes / n
    # The mean of 1 / chi^2 of n degrees of freedom is 1 / (n - 2): over n - 2, the inverse variance is unbiased.
    variance = (squares / slope**2 + _PRIOR_RESIDUALS) / (max(n - 6.0, 0.0) + _PRIOR_RESIDUALS - 2.0)
    variance *= _EXCESS_INFORMATION
    return Influence(weight * variance, weight, slope, variance)


@kernel
def influence_slope(error2: float, has_right: bool, scale: float) -> float:
    """Compute the mean of ``psi'`` over the dimensions of a point's error."""
    w = 1.0 / (1.0 + error2 / scale**2)
    return w - 2.0 * w * (1.0 - w) / (4.0 if has_right else 2.0)


@kernel
def noise_variance(errors2: Float, has_right: Bool, largest2: float) -> float:
    """Estimate the variance of most points' noise, over the modelled one, by the median of those below ``largest2``."""
    ratios, near = np.empty(len(errors2)), 0
    for i in range(len(errors2)):
        if errors2[i] < largest2:
            ratios[near] = errors2[i] / (_MEDIAN_CHI2_OF_4 if has_right[i] else _MEDIAN_CHI2_OF_2)
            near += 1
    return max(float(np.median(ratios[:near])), _MIN_VARIANCE) if near > 0 else 1.0


@kernel
def noise_by_pair(errors2: Float, has_right: Bool, pair: Int, pairs: int, largest2: float) -> Float:
    """Estimate the variance of each pair's noise (P,) over that of all points; near 1 for pairs with few points."""
    variances, fitting = np.ones(pairs + 1), np.zeros(pairs + 1)
    for j in range(pairs + 1):  # the last is that of all pairs
        of_pair = (pair == j) | (j == pairs)
        variances[j] = noise_variance(errors2[of_pair], has_right[of_pair], largest2)
        for i in range(len(errors2)):
            fitting[j] += of_pair[i] and errors2[i] < largest2
    ratios = np.ones(pairs)
    for j in range(pairs):
        if 0.0 < fitting[j] < fitting[pairs]:
            own = variances[j] / variances[pairs]
            ratio = (fitting[j] * own + _POINTS_OF_EQUAL_NOISE) / (fitting[j] + _POINTS_OF_EQUAL_NOISE)
            ratios[j] = min(max(ratio, 1.0 / _MAX_RATIO), _MAX_RATIO)
    return ratios


@kernel
def inlier_cutoff(variance: float, largest2: float) -> float:
    """Compute the squared error below which a point is an inlier: by the noise's variance, at most ``largest2``."""
    return min(largest2, _CUTOFF * variance)
