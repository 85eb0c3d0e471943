"""The paper's extended Kalman filter, in error-state form (section 5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.ekf.measurements import Measurement
from graphvio.backend.ekf.process import jacobians, propagated
from graphvio.backend.ekf.state import ERRORS, POSITION, FilterState
from graphvio.backend.gating import gate_innovation
from graphvio.measurements.gate_result import GateResult


@dataclass
class ExtendedKalmanFilter:
    """The paper's filter: a state and its covariance.

    Attributes:
        state: The estimate.
        covariance: (15, 15) covariance of the estimate's error, see `FilterState.plus`.
    """

    state: FilterState
    covariance: Float

    def predict(self, dt: float, sigmas: Float) -> None:
        """Predict over a time step in seconds with a process noise of standard deviations (9,), eq. (11) and (12)."""
        by_error, by_noise = jacobians(self.state, dt)
        noise = by_noise * sigmas
        self.covariance = by_error @ self.covariance @ by_error.T + noise @ noise.T
        self.state = propagated(self.state, dt)

    def gate(self, measurement: Measurement, probability: float) -> GateResult:
        """Test the innovation of a measurement."""
        return gate_innovation(measurement.innovation, self._innovation_covariance(measurement), probability)

    def update(self, measurement: Measurement) -> None:
        """Update by a measurement, in Joseph's form."""
        by_error = measurement.by_error
        gain = np.linalg.solve(self._innovation_covariance(measurement), by_error @ self.covariance).T
        kept = np.eye(ERRORS) - gain @ by_error
        covariance = kept @ self.covariance @ kept.T + gain @ measurement.covariance @ gain.T
        self.covariance = 0.5 * (covariance + covariance.T)
        self.state = self.state.plus(gain @ measurement.innovation)

    def reset_position(self, sigma_m: float) -> Float:
        """Reset the position's covariance, except for its correlation with the other states.

        Args:
            sigma_m: Standard deviation that remains.

        Returns:
            The covariance (3, 3) in nav that was removed.
        """
        others = slice(POSITION.stop, ERRORS)
        cross = self.covariance[POSITION, others]
        through_others = cross @ np.linalg.pinv(self.covariance[others, others], hermitian=True) @ cross.T
        forgotten = self.covariance[POSITION, POSITION] - through_others
        self.covariance[POSITION, POSITION] = through_others + sigma_m**2 * np.eye(3)
        return forgotten

    def _innovation_covariance(self, measurement: Measurement) -> Float:
        """Return the covariance (M, M) of the innovation."""
        return measurement.by_error @ self.covariance @ measurement.by_error.T + measurement.covariance
