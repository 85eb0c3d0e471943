"""Noise models of gtsam's factors."""

from __future__ import annotations

import gtsam

from graphvio.arrays import Float


def gaussian(covariance: Float) -> gtsam.noiseModel.Gaussian:
    """A noise of a full covariance (N, N).

    By default gtsam takes a matrix whose elements off the diagonal are below 1e-9 for a diagonal one: correlations of
    rotations known to 0.03 mrad and of translations known to 0.03 mm would be lost.
    """
    return gtsam.noiseModel.Gaussian.Covariance(covariance, False)
