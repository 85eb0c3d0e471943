"""The IMU samples between two instants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float


@dataclass(frozen=True, eq=False)
class ImuInterval:
    """The IMU between two instants, as steps of constant rate and specific force.

    Attributes:
        steps_s: (N,) durations of the steps.
        angular_velocity: (N, 3) rad/s, body.
        linear_acceleration: (N, 3) m/s^2 specific force, body.
    """

    steps_s: Float
    angular_velocity: Float
    linear_acceleration: Float

    @property
    def mean_rate(self) -> Float:
        """Mean angular rate (3,) rad/s, bias included."""
        return np.asarray(self.steps_s @ self.angular_velocity / self.steps_s.sum())

    @property
    def mean_force(self) -> Float:
        """Mean specific force (3,) m/s^2, bias included."""
        return np.asarray(self.steps_s @ self.linear_acceleration / self.steps_s.sum())
