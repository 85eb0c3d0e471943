"""Calibration of single cameras and IMU as unknowns of the window: how wrong the rig file is, and what is known of it.

As long as the measurements say nothing against the rig file, it is taken for exact, and the window is solved without
these unknowns; what left the window before still knows what it would have said of them. Once it speaks against the
file, they are solved for with the states, as part of the same window.
"""

from __future__ import annotations

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
from graphvio.self_calibration.parameters import n_camera_parameters
from graphvio.self_calibration.prior import file_prior

_MIN_FACTOR = 1.0  # of a file that is not exact: much smaller ones hold parts of it that nothing has shown yet
_FIRST_FACTORS = (1.0, 3.0)  # which are tried where a first window of an exact file fits no motion
_MIN_TWICE_LOG_RATIO = 4.0  # by which factors change: each change moves the window's poses
_FAR_OFF = 3.0  # factor of a file whose scale is not to be trusted
_MAX_SIGMAS = 4.0  # no file is so wrong: the window is
_MAX_SIGMAS_UNDER_WAY = 12.0  # by files of level 3, principal points reach seven
_WALK = 0.01  # in one second, as a share of the file's standard deviations
_ESTIMATE_EVERY_NS = 1_000_000_000


class WindowCalibration:
    """What is known of the calibration of a rig of single cameras and an IMU.

    The difference from the rig file is ``[cameras C * SINGLE, IMU without its biases 19]``, or empty where the file is
    taken as it is.

    Args:
        rig: of the rig file, with how far its calibration is known.
        is_estimated: whether the file may turn out to be wrong.

    Attributes:
        size: number F of parameters, 0 where they are not estimated.
        factors: (G,) by which the file's errors exceed its standard deviations, of intrinsics and of extrinsics with
            the IMU; `EXACT` where the file is as good as exact.
        twice_log_bayes_factor: twice the logarithm of the odds of these factors against an exact file.
        are_stamps_exact: whether framesets' stamps are as good as exact. What others do to a path looks like errors of
            the calibration, of which nothing is learnt then.
        latest: what is known of all parameters, updated once a second; None before, and where they are not estimated.
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
        """Whether the measurements say nothing against the rig file."""
        return self.is_exact(self.factors)

    def is_exact(self, factors: Float) -> bool:
        """Return whether some factors (G,) are those of an exact file."""
        return bool((factors == EXACT).all())

    @property
    def candidates(self) -> list[Float]:
        """Factors (G,) with which a first window is tried."""
        if self._prior.estimated and not self.are_stamps_exact:
            return [np.full(self._prior.n_groups, EXACT)]  # nothing is to be learnt of it: it is taken as it is
        if not (self.is_file_exact and self.size and self.are_stamps_exact):
            return [self.factors]
        return [self.factors, *(np.full(self._prior.n_groups, factor) for factor in _FIRST_FACTORS)]

    def file(self, factors: Float | None = None) -> Gaussian | None:
        """Return what is known before an epoch: by a rig file that is wrong by some factors (G,), and earlier epochs.

        None where the file is exact. Without an argument, of the file as wrong as it is taken for now.
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
        """Return whether a difference (F,) is within four standard deviations of a file that is as wrong as any."""
        return self._is_within(_MAX_SIGMAS, difference)

    def is_possible(self, difference: Float) -> bool:
        """Return whether a difference (F,), of a window under way, is one that sensors may have.

        While little is known of a parameter, it may for a moment be three times as far off as is plausible. But the IMU
        may not have scales and axes that no rig has. An empty difference, of a calibration that is not estimated, is
        possible.
        """
        if not len(difference):
            return True
        assert self._rig.imu is not None
        errors = difference[GYRO_MATRIX - PARAMETERS : TIME_OFFSET - PARAMETERS].reshape(2, 3, 3)
        matrices = (np.eye(3) + errors) @ np.array(self._rig.imu.matrices)
        is_rig = bool(np.abs(matrices - np.eye(3)).max() < MAX_MATRIX_ERROR)
        return is_rig and self._is_within(_MAX_SIGMAS_UNDER_WAY, difference)

    def _is_within(self, max_sigmas: float, difference: Float) -> bool:
        """Return whether a difference (F,) is within so many standard deviations of a file that is as wrong as any."""
        sigmas = MAX_FACTOR * np.sqrt(np.diag(self._prior.covariance))
        return bool((np.abs(difference) <= max_sigmas * sigmas).all())

    def walk(self, seconds: float) -> Float:
        """Return the lower Cholesky factor (6 + F, 6 + F) of what biases and calibration change in some time.

        Of a file that is exact, the calibration stays.
        """
        n = len(self._bias_walks)
        walk = np.zeros((n + self.size, n + self.size))
        walk[:n, :n] = np.diag(self._bias_walks)
        if not self.is_file_exact:
            walk[n:, n:] = self._walk
        return np.asarray(np.sqrt(seconds) * walk)

    def likeliest_factors(self, evidence: Evidence) -> Float:
        """Return by which factors (G,) the rig file is most likely wrong, given that it is not exact."""
        found, _ = self._kept.plus(evidence).file_factors(self._prior, np.zeros(self._prior.n_groups))
        return np.maximum(found, _MIN_FACTOR)

    def begin(self, factors: Float) -> None:
        """Begin with a window that is adjusted with some factors (G,)."""
        self.factors = self._first_factors = factors

    def keep(self) -> None:
        """Keep what is known beyond the end of an epoch."""
        self._kept = self._evidence
        self._files.clear()

    def discard(self) -> None:
        """Forget what the epoch that ends has shown."""
        self.factors, self._evidence = self._first_factors, self._kept

    def forget(self) -> None:
        """Forget what ended epochs have shown: no motion fits it."""
        self._kept = Evidence.none(len(self._rows))
        self._files.clear()

    def is_contradicted(self, adjusted: Adjusted, prior: Prior | None) -> bool:
        """Return whether a first window, adjusted with an exact file, says that its extrinsics or IMU are far off.

        Arguments as `update_factors`.
        """
        if not (self.size and self.are_stamps_exact):
            return False
        likelihood = FactorLikelihood(self._kept.plus(self._evidence_of(adjusted, prior)), self._prior)
        as_stated, far_off = (likelihood(np.array([_MIN_FACTOR, factor])) for factor in (EXACT, _FAR_OFF))
        return bool(far_off - as_stated > MIN_TWICE_LOG_BAYES_FACTORS[1])

    def update_factors(self, adjusted: Adjusted, prior: Prior | None) -> bool:
        """Update the factors of the rig file from a window, and return whether they have changed.

        Of a file that is exact once a second, since it takes a linearisation of its own.

        Args:
            adjusted: window.
            prior: from before the window.
        """
        if not self.size:
            return False
        file = self.file()
        if file is None:
            is_due = self._is_due(int(adjusted.states.stamps_ns[-1]))
            return is_due and self.update(self._evidence_of(adjusted, prior))
        return self.update(evidence_of(adjusted.equations, adjusted.states, file))

    def _evidence_of(self, adjusted: Adjusted, prior: Prior | None) -> Evidence:
        """Return what a window that was adjusted with an exact file says of it."""
        file = Gaussian(np.zeros(self.size), np.zeros((self.size, self.size)))
        at = equations(adjusted.measured, adjusted.states, adjusted.landmarks, prior, file)
        return evidence_of(at, adjusted.states, file)

    def _is_due(self, stamp_ns: int) -> bool:
        """Whether what is known of all parameters was last noted a second ago."""
        return stamp_ns - self._latest_ns >= _ESTIMATE_EVERY_NS

    def update(self, evidence: Evidence) -> bool:
        """Use what the window and what left it say of the calibration.

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
        if not (self.is_file_exact and self.is_exact(found)):
            # Errors that the tracks of one camera have in common look like those of a lens: it is not as wrong as any.
            of_lenses = np.minimum(found[:1], np.maximum(self._first_factors[:1], _MIN_FACTOR))
            likeliest = np.maximum(np.concatenate([of_lenses, found[1:]]), _MIN_FACTOR)
            if self.is_file_exact or likelihood(likeliest) - likelihood(before) > _MIN_TWICE_LOG_RATIO:
                self.factors = likeliest
        return not np.array_equal(self.factors, before)

    def note(self, stamp_ns: int, states: States, covariance: StateCovariance) -> None:
        """Keep what is known of all parameters, once a second.

        Args:
            stamp_ns: of the newest state.
            states: with the difference that is in force.
            covariance: of the newest state, and of the biases.
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
            self._rig, Gaussian(mean, information), in_force, self.factors.copy(), self.twice_log_bayes_factor
        )


def time_offset_s(difference: Float) -> float:
    """Return the time offset that is in force, less the rig file's, of a difference (F,); 0 of an empty one."""
    return float(difference[TIME_OFFSET - PARAMETERS]) if len(difference) else 0.0
