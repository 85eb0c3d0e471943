"""Calibration of single cameras and IMU as unknowns of the window: how wrong the rig file is, and what is known of it.

As long as the measurements do not contradict the rig file, it is taken as exact, and the window is solved without these
unknowns. The prior of states that left the window includes them all the same, so that the evidence of earlier
measurements about the calibration is kept. Once the evidence contradicts the file, the calibration is estimated
together with the states of the window.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.states import StateCovariance
from graphvio.linear_algebra import cholesky, solve_rows
from graphvio.monocular.adjustment import Adjusted, equations, evidence_of
from graphvio.monocular.states import States
from graphvio.monocular.window_prior import Prior
from graphvio.rig import Rig
from graphvio.rig.imu import MAX_MATRIX_ERROR
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.evidence import (
    EXACT,
    MAX_FACTOR,
    MIN_TWICE_LOG_BAYES_FACTORS,
    Evidence,
    FactorLikelihood,
    FilePrior,
    Gaussian,
)
from graphvio.self_calibration.imu_model import GYRO_MATRIX, PARAMETERS, TIME_OFFSET
from graphvio.self_calibration.knock import knock_covariance
from graphvio.self_calibration.parameters import n_camera_parameters
from graphvio.self_calibration.prior import file_prior

_MIN_FACTOR = 1.0  # for a file that is not exact: much smaller ones would fix parameters that nothing has shown yet
_FIRST_FACTORS = (1.0, 3.0)  # tried where a first window fits no motion with an exact file
_MIN_TWICE_LOG_RATIO = 4.0  # for another change of the factors, since each one moves the window's poses
_FAR_OFF = 3.0  # factor of a rig file whose scale is not to be trusted
_MAX_SIGMAS = 4.0  # no file is more wrong: beyond it, the window is at fault
_MAX_SIGMAS_UNDER_WAY = 12.0  # in simulations with the largest calibration errors, principal points reach seven
_WALK = 0.01  # random walk in one second, as a share of the file's standard deviations
_ESTIMATE_EVERY_NS = 1_000_000_000


class WindowCalibration:
    """Estimate of the calibration of a rig of single cameras and an IMU, as a difference from the rig file.

    The difference is ``[cameras C * SINGLE, IMU without its biases 19]``, or empty where the calibration is not
    estimated.

    Args:
        rig: rig of the rig file, with the standard deviations of its calibration.
        is_estimated: whether the calibration is estimated, so that the file may turn out to be wrong.

    Attributes:
        size: number F of parameters, 0 where they are not estimated.
        factors: (G,) by which the file's errors exceed its standard deviations, of intrinsics and of extrinsics with
            the IMU; `EXACT` where the file is as good as exact.
        twice_log_bayes_factor: twice the logarithm of the odds of these factors against an exact file.
        are_stamps_exact: whether framesets' stamps are as good as exact. The effect of inexact stamps on a trajectory
            looks like errors of the calibration, so that nothing is learnt of the calibration then.
        latest: newest estimate of all parameters, updated once a second; None before, and where they are not estimated.
    """

    def __init__(self, rig: Rig, is_estimated: bool = True) -> None:
        assert rig.imu is not None
        self._rig = rig
        whole, n = file_prior(rig), n_camera_parameters(rig)
        self._rows = np.r_[:n, n + GYRO_MATRIX : n + PARAMETERS]
        self._biases = n + np.arange(GYRO_MATRIX)
        self._prior = FilePrior(
            np.ascontiguousarray(whole.covariance[np.ix_(self._rows, self._rows)]),
            whole.group[self._rows],
            estimated=whole.estimated and is_estimated,
        )
        self._whole = whole
        self.size = len(self._rows) if is_estimated else 0
        self._evidence = self._kept = Evidence.none(len(self._rows))
        self._bias_walks = np.repeat([rig.imu.gyro_random_walk, rig.imu.accel_random_walk], 3)
        self._walk: Float = _WALK * cholesky(self._prior.covariance)
        self.factors = self._first_factors = self._prior.smallest_factors
        self.twice_log_bayes_factor = 0.0
        self.are_stamps_exact = True
        self._files: dict[tuple[float, ...], Gaussian] = {}
        self.latest: CalibrationEstimate | None = None
        self._latest_ns = 0

    @property
    def is_file_exact(self) -> bool:
        """Whether the rig file is taken as exact, since the measurements do not contradict it."""
        return self.is_exact(self.factors)

    def is_exact(self, factors: Float) -> bool:
        """Return whether the calibration is pinned to the file: its factors (G,) are exact, and nothing was knocked."""
        return self._prior.change is None and _are_exact(factors)

    @property
    def candidates(self) -> list[Float]:
        """Factors (G,) of the rig file's errors with which a first window is solved, in the order of the attempts."""
        if self._prior.estimated and not self.are_stamps_exact:
            return [np.full(self._prior.n_groups, EXACT)]  # nothing can be learnt: the file is taken as it is
        if not (self.is_file_exact and self.size and self.are_stamps_exact):
            return [self.factors]
        return [self.factors, *(np.full(self._prior.n_groups, factor) for factor in _FIRST_FACTORS)]

    def file(self, factors: Float | None = None) -> Gaussian | None:
        """Return the prior of the calibration before an epoch, by rig file and earlier epochs; None for an exact file.

        Args:
            factors: (G,) by which the file's errors exceed its standard deviations; None for the current ones.
        """
        factors = self.factors if factors is None else factors
        if self.is_exact(factors):
            return None
        key = tuple(factors.tolist())
        if key not in self._files:
            information = solve_rows(self._prior.with_factors(factors), np.eye(self.size)) + self._kept.information
            self._files[key] = Gaussian(solve_rows(information, self._kept.vector.reshape(1, -1))[0], information)
        return self._files[key]

    def is_plausible(self, difference: Float) -> bool:
        """Return whether a difference (F,) is within four of the rig file's standard deviations times `MAX_FACTOR`."""
        return self._is_within(_MAX_SIGMAS, difference)

    def is_possible(self, difference: Float) -> bool:
        """Return whether real sensors may have a difference (F,) that a window of an epoch under way has found.

        While little is known of a parameter, it may for a moment be three times as far off as `is_plausible` allows.
        The IMU's scales and axes, however, have to be within the limits of a rig file. An empty difference, of a
        calibration that is not estimated, is possible.
        """
        if not len(difference):
            return True
        assert self._rig.imu is not None
        errors = difference[GYRO_MATRIX - PARAMETERS : TIME_OFFSET - PARAMETERS].reshape(2, 3, 3)
        matrices = (np.eye(3) + errors) @ np.array(self._rig.imu.matrices)
        is_rig = bool(np.abs(matrices - np.eye(3)).max() < MAX_MATRIX_ERROR)
        return is_rig and self._is_within(_MAX_SIGMAS_UNDER_WAY, difference)

    def _is_within(self, max_sigmas: float, difference: Float) -> bool:
        """Return whether a difference (F,) is within some of the rig file's standard deviations times `MAX_FACTOR`."""
        sigmas = np.sqrt(np.diag(self._prior.with_factors(np.full(self._prior.n_groups, MAX_FACTOR))))
        return bool((np.abs(difference) <= max_sigmas * sigmas).all())

    def walk(self, seconds: float) -> Float:
        """Return the lower Cholesky factor (6 + F, 6 + F) of the covariance by which biases and calibration walk.

        The calibration of an exact file does not walk.
        """
        n = len(self._bias_walks)
        walk = np.zeros((n + self.size, n + self.size))
        walk[:n, :n] = np.diag(self._bias_walks)
        if not self.is_file_exact:
            walk[n:, n:] = self._walk
        return np.asarray(np.sqrt(seconds) * walk)

    def likeliest_factors(self, evidence: Evidence) -> Float:
        """Return the likeliest factors (G,) by which the rig file is wrong, given that it is not exact."""
        found, _ = self._kept.plus(evidence).file_factors(self._prior, np.zeros(self._prior.n_groups))
        return np.maximum(found, _MIN_FACTOR)

    def begin(self, factors: Float) -> None:
        """Begin an epoch with a window that was adjusted with some factors (G,)."""
        self.factors = self._first_factors = factors

    def keep(self) -> None:
        """Keep the evidence of the epoch that ends for later epochs."""
        self._kept = self._evidence
        self._files.clear()

    def discard(self) -> None:
        """Discard the evidence of the epoch that ends."""
        self.factors, self._evidence = self._first_factors, self._kept

    def forget(self) -> None:
        """Forget the evidence of earlier epochs, since no motion fits it."""
        self._kept = Evidence.none(len(self._rows))
        self._files.clear()

    def release_places(self, cameras: Iterable[int]) -> Float:
        """Estimate some cameras' places again after a knock, and return the covariance (F, F) of what it changed.

        All other parameters remain as well known as before.
        """
        whole = knock_covariance(self._rig, len(self._whole.covariance), cameras)
        change: Float = whole[np.ix_(self._rows, self._rows)]
        self._prior = self._prior.changed(change)
        self._evidence, self._kept = (each.after_random_walk(change) for each in (self._evidence, self._kept))
        self._files.clear()
        return change

    def covariance_so_far(self) -> Float:
        """Return the covariance (F, F) by the evidence so far, and by a file as wrong as stated or more."""
        known = self._evidence.given(self._prior, np.maximum(self.factors, _MIN_FACTOR))
        return np.asarray(np.linalg.inv(known.information))

    def after_restart(self) -> WindowCalibration:
        """Return the calibration before any evidence, with the same knocks since the rig file was made."""
        begun = WindowCalibration(self._rig, self.size > 0)
        begun._prior = self._prior
        return begun

    def is_contradicted(self, adjusted: Adjusted, prior: Prior | None) -> bool:
        """Return whether a first window, adjusted with an exact file, shows that extrinsics or IMU are far off.

        For arguments see `update_factors`.
        """
        if not (self.size and self.are_stamps_exact):
            return False
        likelihood = FactorLikelihood(self._kept.plus(self._evidence_of(adjusted, prior)), self._prior)
        as_stated, far_off = (likelihood(np.array([_MIN_FACTOR, factor])) for factor in (EXACT, _FAR_OFF))
        return bool(far_off - as_stated > MIN_TWICE_LOG_BAYES_FACTORS[1])

    def update_factors(self, adjusted: Adjusted, prior: Prior | None) -> bool:
        """Update the factors of the rig file from a window, and return whether they have changed.

        With an exact file this happens once a second, since it takes an additional linearisation.

        Args:
            adjusted: the adjusted window.
            prior: prior of states from before the window, or None.
        """
        if not self.size:
            return False
        file = self.file()
        if file is None:
            is_due = self._is_due(int(adjusted.states.stamps_ns[-1]))
            return is_due and self.update(self._evidence_of(adjusted, prior))
        return self.update(evidence_of(adjusted.equations, adjusted.states, file))

    def _evidence_of(self, adjusted: Adjusted, prior: Prior | None) -> Evidence:
        """Return the evidence about the calibration of a window that was adjusted with an exact file."""
        file = Gaussian(np.zeros(self.size), np.zeros((self.size, self.size)))
        at = equations(adjusted.measured, adjusted.states, adjusted.landmarks, prior, file)
        return evidence_of(at, adjusted.states, file)

    def _is_due(self, stamp_ns: int) -> bool:
        """Return whether `latest` is at least a second old."""
        return stamp_ns - self._latest_ns >= _ESTIMATE_EVERY_NS

    def update(self, evidence: Evidence) -> bool:
        """Update the factors from the evidence of the window, which includes that of states that left it.

        Returns:
            Whether the factors have changed.
        """
        if not self.are_stamps_exact:
            return False
        before, self._evidence = self.factors, self._kept.plus(evidence)
        likelihood = FactorLikelihood(self._evidence, self._prior)
        found, self.twice_log_bayes_factor = self._evidence.file_factors(
            self._prior, MIN_TWICE_LOG_BAYES_FACTORS, likelihood
        )
        was_exact = _are_exact(before)
        if not (was_exact and _are_exact(found)):
            # Errors that all tracks of a camera share look like those of its lens: this factor does not grow.
            of_lenses = np.minimum(found[:1], np.maximum(self._first_factors[:1], _MIN_FACTOR))
            likeliest = np.maximum(np.concatenate([of_lenses, found[1:]]), _MIN_FACTOR)
            if was_exact or likelihood(likeliest) - likelihood(before) > _MIN_TWICE_LOG_RATIO:
                self.factors = likeliest
        return not np.array_equal(self.factors, before)

    def note(self, stamp_ns: int, states: States, covariance: StateCovariance) -> None:
        """Update `latest`, at most once a second.

        Args:
            stamp_ns: stamp of the newest state.
            states: states of the window, with the difference that is in force.
            covariance: covariance of the newest state, and of the biases.
        """
        if not self.size or not self._is_due(stamp_ns):
            return
        own = self._evidence.given(self._prior, np.maximum(self.factors, _MIN_FACTOR))
        of_biases = np.zeros((6, 6))
        of_biases[:3, :3], of_biases[3:, 3:] = covariance.gyro_bias, covariance.accel_bias
        n = len(self._whole.covariance)
        mean, information, in_force = np.zeros(n), np.zeros((n, n)), np.zeros(n)
        mean[self._rows], mean[self._biases] = own.mean, states.biases
        information[np.ix_(self._rows, self._rows)] = own.information
        information[np.ix_(self._biases, self._biases)] = np.linalg.inv(of_biases)
        in_force[self._rows], in_force[self._biases] = states.calibration, states.biases
        self._latest_ns = stamp_ns
        self.latest = CalibrationEstimate(
            self._rig,
            Gaussian(mean, information),
            in_force,
            self.factors.copy(),
            self.twice_log_bayes_factor,
            is_changed=self._prior.change is not None,
        )


def _are_exact(factors: Float) -> bool:
    return bool((factors == EXACT).all())


def time_offset_s(difference: Float) -> float:
    """Return by how much the time offset of a difference (F,) exceeds the rig file's, seconds; 0 if it is empty."""
    return float(difference[TIME_OFFSET - PARAMETERS]) if len(difference) else 0.0
