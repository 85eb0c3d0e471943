"""Correction of IMU readings to those of a calibrated IMU."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from graphvio.arrays import Float
from graphvio.measurements.imu_interval import ImuInterval


@dataclass(frozen=True, eq=False)
class ImuCorrection:
    """Corrects readings of gyro and accelerometer by matrices.

    Biases are left to the state estimator, for which they must not jump when the matrices change. The accelerometer's
    matrix therefore multiplies the difference of a reading from a fixed force, about that of gravity in body; its
    effect on the fixed force stays a part of the bias.

    Attributes:
        gyro: (3, 3) error of the gyro's matrix, ``I + gyro``.
        accel: (3, 3) error of the accelerometer's matrix, ``I + accel``.
        fixed_force: (3,) specific force, m/s^2, frame body.
    """

    gyro: Float = field(default_factory=lambda: np.zeros((3, 3)))
    accel: Float = field(default_factory=lambda: np.zeros((3, 3)))
    fixed_force: Float = field(default_factory=lambda: np.zeros(3))

    def applied(self, readings: Float) -> Float:
        """Return corrected readings (..., 6) ``[angular velocity, specific force]``."""
        if self._is_none:
            return readings
        rate, force = readings[..., :3], readings[..., 3:]
        return np.concatenate([self._rate(rate), self.applied_force(force)], axis=-1)

    def applied_to(self, interval: ImuInterval) -> ImuInterval:
        """Return an interval with corrected readings."""
        if self._is_none:
            return interval
        return replace(
            interval,
            angular_velocity=self._rate(interval.angular_velocity),
            linear_acceleration=self.applied_force(interval.linear_acceleration),
        )

    def applied_force(self, force: Float) -> Float:
        """Return corrected specific forces (..., 3)."""
        return force + (force - self.fixed_force) @ self.accel.T

    @cached_property
    def _is_none(self) -> bool:
        return not self.gyro.any() and not self.accel.any()

    def _rate(self, rate: Float) -> Float:
        return rate + rate @ self.gyro.T
