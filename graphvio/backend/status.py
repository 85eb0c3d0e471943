"""The status of an estimate: whether the state is initialised, tracked, predicted only, or lost."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from graphvio.backend.initial_state import InitialState
from graphvio.backend.states import StateCovariance
from graphvio.config.stages import InitialisationConfig
from graphvio.measurements.estimate import Status
from graphvio.measurements.events import EventKind, Report

_MAX_INITIALISATION_S = 2.0  # after which the missing quantities are reported


class StatusMonitor:
    """Decides the status of each estimate, and reports when the position is lost or initialisation takes long.

    Args:
        max_sigma_m: Standard deviation of the position, since vision last constrained it, above which it is lost, m.
        report: Receives events.

    Attributes:
        is_lost: Whether the position is too uncertain to be reported.
    """

    def __init__(self, max_sigma_m: float, report: Report) -> None:
        self.is_lost = False
        self._max_sigma_m = max_sigma_m
        self._report = report
        self._initialising_since_ns: int | None = None  # None once the first motions have determined what was missing
        self._was_complete = False  # whether nothing was missing at the estimate before
        self._is_reported = False  # whether it was reported that initialisation takes long

    def note_initialisation(self, initial: InitialState) -> None:
        """Record an initialisation: without a standstill, the first motions have to complete it."""
        if not initial.is_known:
            self._initialising_since_ns, self._was_complete, self._is_reported = initial.stamp_ns, False, False

    def report_no_imu(self, stamp_ns: int) -> None:
        """Report an initialisation without the samples of the rig's IMU."""
        self._report(stamp_ns, EventKind.STARTED_WITHOUT_IMU, "no IMU samples came: vision alone from here")

    def status(
        self, stamp_ns: int, is_constrained: bool, sigma_m: float, has_imu: bool, missing: Callable[[], str]
    ) -> Status:
        """Return the status of the newest estimate.

        Args:
            stamp_ns: Stamp of the estimate.
            is_constrained: Whether vision constrains it, or it has just been initialised.
            sigma_m: Standard deviation of its position since vision last constrained it.
            has_imu: Whether the state has an IMU.
            missing: Returns what is not known well enough yet, or an empty string; see `missing_of`.
        """
        if is_constrained:
            return Status.INITIALISING if self._is_initialising(stamp_ns, has_imu, missing) else Status.TRACKING
        if not self.is_lost and sigma_m > self._max_sigma_m:
            self.is_lost = True
            self._report(
                stamp_ns, EventKind.LOST, f"position uncertain by {sigma_m:.2f} m since vision last constrained it"
            )
        return Status.LOST if self.is_lost else Status.COASTING

    def _is_initialising(self, stamp_ns: int, has_imu: bool, missing: Callable[[], str]) -> bool:
        if self._initialising_since_ns is None:
            return False
        after_s = (stamp_ns - self._initialising_since_ns) * 1e-9
        lacking = missing() if after_s else "there is no motion yet"
        was_complete, self._was_complete = self._was_complete, not lacking
        if self._was_complete:
            # With an IMU, the estimate at which attitude and velocity become known is the last that may jump.
            is_over = was_complete or not has_imu
            if is_over:
                self._initialising_since_ns = None
            return not is_over
        if after_s > _MAX_INITIALISATION_S and not self._is_reported:
            self._is_reported = True
            self._report(
                stamp_ns,
                EventKind.NOT_INITIALISED,
                f"{after_s:.1f} s after the initialisation {lacking}; go on moving",
            )
        return True


def missing_of(covariance: StateCovariance, config: InitialisationConfig) -> str:
    """Return what is not known well enough for the initialisation of a state to be over, or an empty string."""
    if covariance.velocity is None or covariance.tilt is None:
        return ""
    tilt_deg = np.rad2deg(np.sqrt(np.linalg.eigvalsh(covariance.tilt)[-1]))
    speed_m_s = np.sqrt(np.linalg.eigvalsh(covariance.velocity)[-1])
    reasons = []
    if tilt_deg > config.tilt_sigma_deg:
        reasons.append(f"roll and pitch are known to {tilt_deg:.1f} deg only")
    if speed_m_s > config.velocity_sigma_m_s:
        reasons.append(f"the velocity to {speed_m_s:.2f} m/s only")
    return " and ".join(reasons)
