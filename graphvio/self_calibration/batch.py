"""Self-calibration from a whole recording: all windows at once, with one calibration that does not change.

Each window is adjusted with the evidence of the windows before it as the prior, and in later rounds also with that of
the windows after it (expectation propagation; T. Minka, *Expectation propagation for approximate Bayesian inference*,
2001), so that all are linearised at nearly the same calibration and none is counted twice. Only the IMU's biases change
between windows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.rig import Rig
from graphvio.self_calibration.adjustment import adjusted
from graphvio.self_calibration.collector import FullWindow
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.evidence import Evidence, FilePrior, Gaussian
from graphvio.self_calibration.parameters import RigCalibration
from graphvio.self_calibration.prior import file_prior, walk_per_second

_ROUNDS = 2
_STILL = 1e-5  # random walk in one second, as a share of the file's standard deviations: next to nothing
_NO_GAIN = -np.inf


class Batch(NamedTuple):
    """Result of all windows of a recording.

    Attributes:
        estimate: estimate of the calibration.
        evidence: evidence of all windows that are used.
        prior: prior by the rig file.
        history: estimates from longer and longer beginnings of the recording, with the stamp of their end.
        left_out: (K,) whether each window is not used: it contradicts the others, or its adjustment has not converged.
    """

    estimate: CalibrationEstimate
    evidence: Evidence
    prior: FilePrior
    history: list[tuple[int, CalibrationEstimate]]
    left_out: list[bool]


def calibrate_windows(
    rig: Rig,
    windows: Sequence[FullWindow],
    difference: Float,
    on_window: Callable[[int, int], None] = lambda *_: None,
) -> Batch:
    """Estimate the calibration from windows.

    Args:
        rig: rig of the rig file; its standard deviations say how far each parameter may differ from it.
        windows: K windows in time order, at least one.
        difference: (C,) first guess of the difference from the rig file.
        on_window: called after each adjustment, with the number of adjustments done and that of all.
    """
    prior, nominal, n = file_prior(rig), RigCalibration.of(rig), len(windows)
    factors = np.ones(prior.n_groups)
    per_second = walk_per_second(rig, prior, _STILL)
    walks = [_walk_after(windows, k, per_second) for k in range(n)]
    sites = [Evidence.none(len(difference))] * n
    left_out = [False] * n
    history: list[tuple[int, CalibrationEstimate]] = []
    for number in range(_ROUNDS):
        later = _of_later(sites, walks)
        earlier, history = Evidence.none(len(difference)), []
        for k, window in enumerate(windows):
            others = _sum(earlier, later[k]).given(prior, factors)
            start = difference if number == 0 else others.mean
            solution = adjusted(window.keyframes, window.samples, nominal, start, others, window.sigma_px)
            contradicts = number > 0 and not others.is_confirmed_by(solution.calibration)
            left_out[k] = contradicts or not solution.has_converged
            sites[k] = Evidence.none(len(difference)) if left_out[k] else _site(others, solution.calibration)
            earlier = _sum(earlier, sites[k])
            history.append((window.keyframes[-1].stamp_ns, _estimate(rig, prior, earlier)))
            earlier = earlier.after_random_walk(walks[k])
            on_window(number * n + k + 1, _ROUNDS * n)
        if number == 0:
            factors = _factors(prior, earlier)
    return Batch(_estimate(rig, prior, earlier), earlier, prior, history, left_out)


def difference_of(one: Batch, other: Batch) -> tuple[Float, Float]:
    """Return by how much two calibrations of a rig from different windows differ, and the covariance of that.

    Both share the rig file's prior, which adds nothing to the difference: parameters that it alone determines agree.

    Returns:
        The difference (C,), and the covariance (C, C) that it has if both are right.
    """
    of_file = one.prior.with_factors(np.maximum(_factors(one.prior, one.evidence), _factors(one.prior, other.evidence)))
    gains, noise = [], np.zeros_like(of_file)
    for each in (one, other):
        covariance = each.estimate.posterior.covariance
        gains.append(covariance @ each.evidence.information)
        noise += gains[-1] @ covariance
    unequal = gains[0] - gains[1]
    return (
        one.estimate.posterior.mean - other.estimate.posterior.mean,
        np.asarray(noise + unequal @ of_file @ unequal.T),
    )


def _estimate(rig: Rig, prior: FilePrior, evidence: Evidence) -> CalibrationEstimate:
    factors = _factors(prior, evidence)
    posterior = evidence.given(prior, factors)
    return CalibrationEstimate(rig, posterior, posterior.mean, factors)


def _factors(prior: FilePrior, evidence: Evidence) -> Float:
    """Return the likeliest factors (G,) on the file's errors, at least 1: unseen parts are known as by the file."""
    factors, _ = evidence.file_factors(prior, np.full(prior.n_groups, _NO_GAIN))
    return np.maximum(factors, 1.0)


def _site(others: Gaussian, posterior: Gaussian) -> Evidence:
    """Return the evidence of one window: what the posterior contains beyond the others' evidence and the prior."""
    return Evidence.none(len(others.mean)).with_window(others, posterior)


def _sum(one: Evidence, other: Evidence) -> Evidence:
    return Evidence(one.information + other.information, one.vector + other.vector)


def _of_later(sites: Sequence[Evidence], walks: Sequence[Float]) -> list[Evidence]:
    """Return the evidence of the windows after each one about the calibration at its time."""
    later = [Evidence.none(len(sites[0].vector))]
    for site, walk in zip(reversed(sites[1:]), reversed(walks[:-1]), strict=True):
        later.append(_sum(later[-1], site).after_random_walk(walk))
    return later[::-1]


def _walk_after(windows: Sequence[FullWindow], k: int, per_second: Float) -> Float:
    """Return the covariance (C, C) of the random walk from a window to the next one, almost only of the biases."""
    following = windows[min(k + 1, len(windows) - 1)]
    return per_second * max((following.keyframes[0].stamp_ns - windows[k].keyframes[0].stamp_ns) * 1e-9, 1.0)
