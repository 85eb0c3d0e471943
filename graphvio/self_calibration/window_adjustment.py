"""Adjustment of one window, and the estimate of the calibration from it and the full windows before it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError
from graphvio.measurements.inertial_state import InertialState
from graphvio.rig import Rig
from graphvio.self_calibration.adjustment import adjusted
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.evidence import (
    EXACT,
    MAX_FACTOR,
    MIN_TWICE_LOG_BAYES_FACTORS,
    Evidence,
    FactorLikelihood,
    FilePrior,
    Gaussian,
    inexact,
)
from graphvio.self_calibration.inertial import InertialSamples
from graphvio.self_calibration.inertial_state import newest_inertial_state
from graphvio.self_calibration.parameters import RigCalibration, n_camera_parameters
from graphvio.self_calibration.prior import extrinsic_covariances
from graphvio.self_calibration.solver import Solution
from graphvio.self_calibration.window import Keyframe

_MIN_CHANGE = 0.5  # ratio of new to old factors of the file, down to which a window is not adjusted again


class AdjustedWindow(NamedTuple):
    """Result of a window's adjustment.

    Attributes:
        keyframes: keyframes of the window.
        is_full: whether the window is full.
        prior: prior of the calibration's difference from the rig file, from before the window.
        solution: solution of the window.
        evidence: evidence of this window and the full ones before.
        estimate: estimate of the calibration, by this evidence and the rig file.
        extrinsics: see `graphvio.self_calibration.online.SelfCalibration`.
        upper_covariance: see there.
        covariance: (N, N) mean square of the error of the cameras' N parameters that come into force.
        by_cameras: (K, 6, N) derivatives of the K keyframes' poses with respect to these parameters.
        inertial_state: at the last keyframe, or None without an IMU, or while the rig file is as good as exact.
    """

    keyframes: tuple[Keyframe, ...]
    is_full: bool
    prior: Gaussian
    solution: Solution
    evidence: Evidence
    estimate: CalibrationEstimate
    extrinsics: dict[int, Float]
    upper_covariance: Float
    covariance: Float
    by_cameras: Float
    inertial_state: InertialState | None


@dataclass(frozen=True, eq=False)
class WindowAdjustment:
    """A window that is to be adjusted, with all that the result depends on, so that another thread can do it.

    Attributes:
        rig: rig of the rig file.
        nominal: its calibration.
        file_prior: prior of the calibration by the rig file.
        factors: (G,) factors by which the rig file is taken to be wrong.
        evidence: evidence of the full windows before.
        difference: (C,) initial difference of the calibration from the rig file.
        keyframes: keyframes of the window.
        samples: IMU samples over it, or None.
        sigma_px: noise of a corner's position.
        is_full: whether the window is full.
    """

    rig: Rig
    nominal: RigCalibration
    file_prior: FilePrior
    factors: Float
    evidence: Evidence
    difference: Float
    keyframes: tuple[Keyframe, ...]
    samples: InertialSamples | None
    sigma_px: float
    is_full: bool

    def result(self) -> AdjustedWindow | None:
        """Adjust the window; None if it does not converge, or measurements determine nothing or an impossible IMU."""
        try:
            fitted = self._fitted(self.factors, self.difference)
            change = inexact(fitted.factors) / inexact(self.factors)
            if fitted.solution.has_converged and ((change > 1.0) | (change < _MIN_CHANGE)).any():
                # The window was linearised with factors that are too small or much too large: use the new ones.
                fitted = self._fitted(fitted.factors, fitted.solution.calibration.mean)
            return self._judged(fitted) if fitted.solution.has_converged else None
        except (np.linalg.LinAlgError, RigError):
            return None

    def _fitted(self, factors: Float, difference: Float) -> _Fitted:
        """Solve the window with a rig file that is wrong by factors (G,), and find the likeliest factors given that."""
        prior = self.evidence.given(self.file_prior, inexact(factors))
        solution = adjusted(self.keyframes, self.samples, self.nominal, difference, prior, self.sigma_px)
        evidence = self.evidence.with_window(prior, solution.calibration)
        likelihood = FactorLikelihood(evidence, self.file_prior)
        found = evidence.file_factors(self.file_prior, MIN_TWICE_LOG_BAYES_FACTORS, likelihood)
        return _Fitted(prior, solution, evidence, likelihood, *found)

    def _judged(self, fitted: _Fitted) -> AdjustedWindow:
        """Return the estimate of the calibration after the window, and what of it comes into force."""
        evidence, factors, n = fitted.evidence, fitted.factors, n_camera_parameters(self.rig)
        is_changed, in_force = self.file_prior.change is not None, np.zeros_like(self.difference)
        if is_changed or (factors != EXACT).any():
            in_force = evidence.given(self.file_prior, factors).mean
        estimate = CalibrationEstimate(
            self.rig,
            evidence.given(self.file_prior, inexact(factors)),
            in_force,
            factors,
            fitted.twice_log_bayes_factor,
            is_changed,
        )
        _ = estimate.rig  # build the rig now: it raises RigError here rather than later in the odometry's thread
        anywhere = evidence.given(self.file_prior, np.full_like(factors, MAX_FACTOR)).covariance
        inertial_state = None
        if self.samples is not None and not estimate.is_file_exact:
            inertial_state = newest_inertial_state(self.keyframes[-1].stamp_ns, fitted.solution)
        return AdjustedWindow(
            keyframes=self.keyframes,
            is_full=self.is_full,
            prior=fitted.prior,
            solution=fitted.solution,
            evidence=evidence,
            estimate=estimate,
            extrinsics={} if estimate.is_file_exact else extrinsic_covariances(self.rig, anywhere),
            upper_covariance=anywhere,
            covariance=evidence.mean_square(self.file_prior, in_force, fitted.likelihood)[:n, :n],
            by_cameras=fitted.solution.poses_by_cameras(n),
            inertial_state=inertial_state,
        )


class _Fitted(NamedTuple):
    prior: Gaussian
    solution: Solution
    evidence: Evidence
    likelihood: FactorLikelihood
    factors: Float
    twice_log_bayes_factor: float
