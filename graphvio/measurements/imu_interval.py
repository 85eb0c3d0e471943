"""The IMU samples between two instants."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from graphvio.arrays import Float


@dataclass(frozen=True, eq=False)
class ImuInterval:
    """IMU readings between two instants, as steps of constant rate and specific force.

    Attributes:
        steps_s: (N,) durations of the steps.
        angular_velocity: (N, 3) rad/s, body.
        linear_acceleration: (N, 3) m/s^2 specific force, body.
        noise_densities: (2,) of gyro and accelerometer, estimated from the samples (`graphvio.measurements.imu_noise`);
            zero where they are not known.
        stamp_sigma_s: standard deviation of the stamps of both instants, as of framesets that are stamped on arrival.
    """

    steps_s: Float
    angular_velocity: Float
    linear_acceleration: Float
    noise_densities: Float = field(default_factory=lambda: np.zeros(2))
    stamp_sigma_s: float = 0.0

    @property
    def duration_ns(self) -> int:
        """Time between the two instants, nanoseconds."""
        return round(1e9 * float(self.steps_s.sum()))

    @property
    def mean_rate(self) -> Float:
        """Mean angular rate (3,) rad/s, bias included."""
        return np.asarray(self.steps_s @ self.angular_velocity / self.steps_s.sum())

    @property
    def mean_force(self) -> Float:
        """Mean specific force (3,) m/s^2, bias included."""
        return np.asarray(self.steps_s @ self.linear_acceleration / self.steps_s.sum())
