"""What the measurements say of the calibration, and how wrong they say that the rig file is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float

EXACT = 1e-3
"""Factor on the file's standard deviations of a file that is as good as exact."""
_FACTORS = (EXACT, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0)


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


class FilePrior(NamedTuple):
    """What is known of the calibration from the rig file, up to a common factor on its standard deviations.

    Attributes:
        covariance: (C, C) of the differences from the file, for a factor of 1.
        is_of_file: (C,) whether the factor applies; it does not to biases, which no file has.
    """

    covariance: Float
    is_of_file: Bool

    def with_factor(self, factor: float) -> Float:
        """Return the covariance (C, C) for a factor."""
        factors = np.where(self.is_of_file, factor, 1.0)
        return np.asarray(self.covariance * factors * factors[:, None])


class Evidence(NamedTuple):
    """A normal likelihood of the difference x, ``exp(-x^T information x / 2 + vector^T x)``.

    Attributes:
        information: (C, C), singular where nothing was measured.
        vector: (C,).
    """

    information: Float
    vector: Float

    @staticmethod
    def none(size: int) -> Evidence:
        """Return the likelihood of no measurements."""
        return Evidence(np.zeros((size, size)), np.zeros(size))

    def given(self, prior: FilePrior, factor: float) -> Gaussian:
        """Return the posterior, where the rig file is wrong by a factor times its standard deviations."""
        information = self.information + np.linalg.inv(prior.with_factor(factor))
        return Gaussian(np.asarray(np.linalg.solve(information, self.vector)), np.asarray(information))

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

    def file_factor(self, prior: FilePrior) -> tuple[float, float]:
        """Return by which factor the rig file's errors exceed its standard deviations, by maximum likelihood.

        The calibration itself is integrated out (type II maximum likelihood; J. O. Berger, *Statistical decision theory
        and Bayesian analysis*, 1985, section 3.5).

        Returns:
            The factor, `EXACT` where an exact file explains the measurements best; and twice the logarithm of its
            likelihood over that of an exact file.
        """
        likelihoods = []
        for factor in _FACTORS:
            covariance = prior.with_factor(factor)
            information = self.information + np.linalg.inv(covariance)
            fit = self.vector @ np.linalg.solve(information, self.vector)
            volume = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1]
            likelihoods.append(float(fit - volume))
        best = int(np.argmax(likelihoods))
        return _FACTORS[best], likelihoods[best] - likelihoods[0]
