"""Noise models of gtsam's factors, and the part of a motion's covariance that no other motion shares."""

from __future__ import annotations

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.gating import chi_square_quantile
from graphvio.kernels import kernel
from graphvio.linear_algebra import cholesky, eigen, product, solve_lower

_MIN_OWN_SHARE = 0.001  # of a motion's covariance in each direction: keeps it positive definite


def gaussian(covariance: Float) -> gtsam.noiseModel.Gaussian:
    """Return a noise model of a full covariance (N, N).

    By default gtsam takes a matrix whose elements off the diagonal are below 1e-9 for a diagonal one: correlations of
    rotations known to 0.03 mrad and of translations known to 0.03 mm would be lost.
    """
    return gtsam.noiseModel.Gaussian.Covariance(covariance, False)


def robust(noise: gtsam.noiseModel.Gaussian, probability: float) -> gtsam.noiseModel.Base:
    """Return the noise with Huber's kernel, linear beyond the chi-square quantile of ``probability``; 1 disables it."""
    if probability == 1.0:
        return noise
    distance = np.sqrt(chi_square_quantile(probability, noise.dim()))
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(distance), noise)


def isotropic(dimension: int, sigma: float) -> gtsam.noiseModel.Isotropic:
    """Return a noise model with one standard deviation in all directions."""
    return gtsam.noiseModel.Isotropic.Sigma(dimension, sigma)


@kernel
def own_covariance(covariance: Float, shared: Float) -> Float:
    """Return a motion's covariance (6, 6) without the part (6, 6) that it shares with other motions.

    As the rig moves on, the shared part may exceed the covariance a little: a minimum share of the covariance remains.
    """
    root = cholesky(covariance)
    white = solve_lower(root, solve_lower(root, shared).T)
    shares, axes = eigen(np.eye(6) - 0.5 * (white + white.T))
    axes = product(root, axes)
    return product(axes * np.maximum(shares, _MIN_OWN_SHARE), axes.T.copy())
