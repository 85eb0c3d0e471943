"""Evidence of the measurements about the calibration, and estimates of how wrong the rig file is."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.linear_algebra import cholesky, inverse, solve_lower

EXACT = 1e-3
"""Factor on the standard deviations of a rig file that is as good as exact."""
_SWEEPS = 3
_MIN_WEIGHT = 1e-5  # relative to the likeliest factors, of factors that count in a mean over all
_MAX_MEAN_INNOVATION = 3.0  # mean square over the parameters; 1 where all errors are as modelled
_FACTORS = (EXACT, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0)
MAX_FACTOR = _FACTORS[-1]
MIN_TWICE_LOG_BAYES_FACTORS = np.array([30.0, 40.0])
"""Thresholds for evidence against an exact file, of intrinsics and of extrinsics with the IMU.

Cameras whose calibration is not exact reach hundreds with the first image.
"""


def inexact(factors: Float) -> Float:
    """Return the factors (G,) with 1 instead of `EXACT`, since exact parts may yet turn out to be wrong."""
    return np.where(factors == EXACT, 1.0, factors)


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

    def is_confirmed_by(self, posterior: Gaussian) -> bool:
        """Return whether a posterior mean is within this prior: squared Mahalanobis distance below 3 per parameter."""
        return 2.0 * self.cost(posterior.mean) < _MAX_MEAN_INNOVATION * len(self.mean)

    def agrees_with(self, other: Gaussian) -> bool:
        """Return whether two estimates differ by no more than their covariances explain, by the same bound."""
        apart = self.mean - other.mean
        statistic = float(apart @ np.linalg.solve(self.covariance + other.covariance, apart))
        return statistic < _MAX_MEAN_INNOVATION * len(apart)


class FilePrior(NamedTuple):
    """Prior of the calibration by the rig file, up to a factor on the standard deviations of each group.

    Attributes:
        covariance: (C, C) covariance of the differences from the file, for factors of 1.
        group: (C,) index of the factor of each parameter, or -1 for biases, which have none: no file contains them.
        change: (C, C) covariance of changes by knocks since the file was made, or None. No factor applies to it.
        estimated: whether an estimation found the file's standard deviations. Factors are then at least 1: what that
            estimation did not show is as wrong as before, however well it found the parts that measurements show again.
    """

    covariance: Float
    group: Int
    change: Float | None = None
    estimated: bool = False

    @property
    def factors(self) -> tuple[float, ...]:
        """Possible factors of any group, from the smallest one."""
        return tuple(factor for factor in _FACTORS if factor >= 1.0) if self.estimated else _FACTORS

    @property
    def smallest_factors(self) -> Float:
        """The factors (G,) of a file that measurements do not contradict: `EXACT`, or 1 where it is estimated."""
        return np.full(self.n_groups, self.factors[0])

    @property
    def n_groups(self) -> int:
        """Number G of groups, and so of factors."""
        return int(self.group.max()) + 1

    def with_factors(self, factors: Float) -> Float:
        """Return the covariance (C, C) for the groups' factors (G,)."""
        each = self.of_each(factors)
        of_file = np.asarray(self.covariance * each * each[:, None])
        return of_file if self.change is None else of_file + self.change

    def changed(self, change: Float) -> FilePrior:
        """Return the prior after a change with a covariance (C, C)."""
        return self._replace(change=change if self.change is None else self.change + change)

    def of_each(self, factors: Float) -> Float:
        """Return the factor (C,) that applies to each parameter, from the groups' factors (G,)."""
        padded = np.ones(len(factors) + 1)
        padded[:-1] = factors
        return np.asarray(padded[self.group])  # group -1, without a factor, selects the last 1.0


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

    def plus(self, other: Evidence) -> Evidence:
        """Return the likelihood of these measurements and others."""
        return Evidence(self.information + other.information, self.vector + other.vector)

    def given(self, prior: FilePrior, factors: Float) -> Gaussian:
        """Return the posterior, where the rig file is wrong by factors (G,) times its standard deviations."""
        information = self.information + np.linalg.inv(prior.with_factors(factors))
        return Gaussian(np.asarray(np.linalg.solve(information, self.vector)), np.asarray(information))

    def after_random_walk(self, walk: Float) -> Evidence:
        """Return the likelihood after a random walk of the calibration with a covariance (C, C)."""
        kept = np.linalg.inv(np.eye(len(walk)) + self.information @ walk)
        information = kept @ self.information
        return Evidence(0.5 * (information + information.T), kept @ self.vector)

    def with_window(self, prior: Gaussian, posterior: Gaussian) -> Evidence:
        """Return the likelihood with that of a window, which has turned a prior into a posterior."""
        return Evidence(
            self.information + posterior.information - prior.information,
            self.vector + posterior.information @ posterior.mean - prior.information @ prior.mean,
        )

    def file_factors(
        self, prior: FilePrior, min_twice_log_ratios: Float, likelihood: FactorLikelihood | None = None
    ) -> tuple[Float, float]:
        """Return by which factors the rig file's errors exceed its standard deviations, by maximum likelihood.

        The calibration itself is integrated out (type II maximum likelihood; D. J. C. MacKay, *Bayesian interpolation*,
        1992), and one group after the other is varied, in turns until none changes.

        Args:
            prior: prior of the calibration.
            min_twice_log_ratios: (G,) threshold on twice the log likelihood ratio against the smallest factor, above
                which a larger one is taken.
            likelihood: likelihood for the same evidence and prior, if there is one already.

        Returns:
            The factors (G,), `EXACT` for a group that is as good as exact; and twice the logarithm of their likelihood
            over that of the smallest ones.
        """
        likelihood = likelihood or FactorLikelihood(self, prior)
        groups = list(range(prior.n_groups))
        # Two groups may explain the same errors, and the first one that is varied then takes all: each is first once.
        orders = [groups[first:] + groups[:first] for first in groups]
        maxima = [_ascended(likelihood, prior, order, min_twice_log_ratios) for order in orders]
        factors = max(maxima, key=likelihood)
        return factors, likelihood(factors) - likelihood(prior.smallest_factors)

    def mean_square(self, prior: FilePrior, in_force: Float, likelihood: FactorLikelihood | None = None) -> Float:
        """Return the mean square (C, C) of the error of a difference (C,) from the file that is in force.

        It is the mean over all factors of the file, each weighted by its likelihood, even while the file is in force as
        if it were exact: parameters that nothing has shown yet may be as wrong as in any file. For arguments see
        `file_factors`.

        Raises:
            numpy.linalg.LinAlgError: if the measurements have no likelihood with any factors.
        """
        likelihood = likelihood or FactorLikelihood(self, prior)
        factors = _factors_that_count(likelihood, prior)
        twice_log = np.array([likelihood(each) for each in factors])
        weights = np.exp(0.5 * (twice_log - twice_log.max()))
        weights /= weights.sum()
        mean_square = np.zeros_like(self.information)
        for weight, each in zip(weights, factors, strict=True):
            covariance = inverse(self.information + likelihood.prior_information(each))
            off = covariance @ self.vector - in_force
            mean_square += weight * (covariance + np.outer(off, off))
        return mean_square


class FactorLikelihood:
    """Marginal likelihood of factors on a rig file's standard deviations; each is computed once.

    Args:
        evidence: evidence of the measurements.
        prior: prior by the rig file.
    """

    def __init__(self, evidence: Evidence, prior: FilePrior) -> None:
        self._evidence, self._prior = evidence, prior
        self._information: Float = np.asarray(np.linalg.inv(prior.covariance), np.float64)
        self._known: dict[bytes, float] = {}

    def __call__(self, factors: Float) -> float:
        """Return twice the logarithm of the marginal likelihood of factors (G,), up to a constant."""
        key = factors.tobytes()
        if key not in self._known:
            self._known[key] = self._computed(factors)
        return self._known[key]

    def prior_information(self, factors: Float) -> Float:
        """Return the inverse (C, C) of the prior's covariance for factors (G,)."""
        if self._prior.change is not None:
            return inverse(self._prior.with_factors(factors))
        each = self._prior.of_each(factors)
        return np.asarray(self._information / (each * each[:, None]))

    def _computed(self, factors: Float) -> float:
        prior, evidence = self._prior, self._evidence
        # Their product is the root of the prior's determinant, up to a constant.
        scales = prior.of_each(factors) if prior.change is None else np.diag(cholesky(prior.with_factors(factors)))
        lower = cholesky(evidence.information + self.prior_information(factors))
        fitted = solve_lower(lower, evidence.vector.reshape(1, -1))[0]
        likelihood = float(fitted @ fitted - 2.0 * np.log(scales * np.diag(lower)).sum())
        return likelihood if np.isfinite(likelihood) else -np.inf  # a matrix that rounding made indefinite


def _ascended(
    likelihood: FactorLikelihood, prior: FilePrior, order: Sequence[int], min_twice_log_ratios: Float
) -> Float:
    """Return the factors (G,) to which a coordinate ascent leads from the smallest ones, for an order of the groups."""
    factors, possible = prior.smallest_factors, prior.factors
    for _ in range(_SWEEPS):
        before = factors.copy()
        for group in order:
            likelihoods = []
            for factor in possible:
                factors[group] = factor
                likelihoods.append(likelihood(factors))
            found = int(np.argmax(likelihoods))
            if likelihoods[found] - likelihoods[0] < min_twice_log_ratios[group]:
                found = 0
            factors[group] = possible[found]
        if np.array_equal(factors, before):
            break
    return factors


def _factors_that_count(likelihood: FactorLikelihood, prior: FilePrior) -> list[Float]:
    """Return all factors (G,) whose likelihood is not negligible, searched from the maxima outwards.

    Raises:
        numpy.linalg.LinAlgError: if no factors have a likelihood.
    """
    groups, possible, margin = list(range(prior.n_groups)), np.array(prior.factors), 2.0 * np.log(_MIN_WEIGHT)
    orders = [groups[first:] + groups[:first] for first in groups]
    maxima = [_ascended(likelihood, prior, order, np.zeros(len(groups))) for order in orders]
    known = {tuple(np.searchsorted(possible, each).tolist()): likelihood(each) for each in maxima}
    outward, likeliest = list(known), max(known.values())
    while outward:
        at = outward.pop()
        if known[at] > likeliest + margin:
            # neighbours by one step of any of the factors
            for neighbour in product(*(range(max(k - 1, 0), min(k + 2, len(possible))) for k in at)):
                if neighbour not in known:
                    known[neighbour] = likelihood(possible[list(neighbour)])
                    likeliest = max(likeliest, known[neighbour])
                    outward.append(neighbour)
    if not np.isfinite(likeliest):
        raise np.linalg.LinAlgError("the measurements fit no calibration")
    return [possible[list(at)] for at, each in known.items() if each > likeliest + margin]
