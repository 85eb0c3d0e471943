"""What the images say of the calibration, and how wrong they say that the rig file is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float

_SCALES = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0)
"""Factors on the file's standard deviations that are compared; and 0, the file is exact."""


class Gaussian(NamedTuple):
    """A normal distribution of a calibration's difference from the nominal one.

    Attributes:
        mean: (C,).
        information: (C, C) inverse of the covariance.
    """

    mean: Float
    information: Float

    @property
    def covariance(self) -> Float:
        """(C, C)."""
        return np.asarray(np.linalg.inv(self.information))

    def cost(self, difference: Float) -> float:
        """Return half of the squared Mahalanobis distance of a difference (C,)."""
        off = difference - self.mean
        return float(0.5 * off @ self.information @ off)


class Evidence(NamedTuple):
    """A normal likelihood of the difference x, ``exp(-x^T information x / 2 + vector^T x)``.

    Attributes:
        information: (C, C), singular where the images do not say anything.
        vector: (C,).
    """

    information: Float
    vector: Float

    @staticmethod
    def none(size: int) -> Evidence:
        """Return the likelihood of no images."""
        return Evidence(np.zeros((size, size)), np.zeros(size))

    def given(self, file_covariance: Float, scale: float) -> Gaussian:
        """Return the posterior, where the rig file is wrong by a factor times its stated standard deviations."""
        information = self.information + np.linalg.inv(file_covariance) / scale**2
        return Gaussian(np.linalg.solve(information, self.vector), information)

    def forgotten(self, walk: Float) -> Evidence:
        """Return the likelihood after a random walk of the calibration with a covariance (C, C)."""
        kept = np.eye(len(walk)) - self.information @ np.linalg.inv(self.information + np.linalg.inv(walk))
        information = kept @ self.information
        return Evidence(0.5 * (information + information.T), kept @ self.vector)

    def with_window(self, prior: Gaussian, posterior: Gaussian) -> Evidence:
        """Return the likelihood with what turned a prior into a posterior."""
        return Evidence(
            self.information + posterior.information - prior.information,
            self.vector + posterior.information @ posterior.mean - prior.information @ prior.mean,
        )

    def file_scale(self, file_covariance: Float) -> tuple[float, float]:
        """Return by which factor the rig file's errors exceed its standard deviations, by maximum likelihood.

        The calibration itself is integrated out (type II maximum likelihood; J. O. Berger, *Statistical decision theory
        and Bayesian analysis*, 1985, section 3.5).

        Returns:
            The factor, 0 where an exact file explains the images best; and twice the logarithm of its likelihood over
            that of an exact file.
        """
        best = 0.0, 0.0
        for scale in _SCALES:
            information = self.information + np.linalg.inv(file_covariance) / scale**2
            fit = self.vector @ np.linalg.solve(information, self.vector)
            volume = np.linalg.slogdet(scale**2 * file_covariance @ information)[1]
            best = max(best, (scale, float(fit - volume)), key=lambda each: each[1])
        return best
