"""IMU samples as a calibrated IMU would measure them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphvio.arrays import Float
from graphvio.measurements.sensors import ImuSample

_AVERAGED = 100  # samples


class ImuCorrection:
    """Multiplies readings by the matrices of gyro and accelerometer.

    Biases are left to the state estimator. It must not see them jump when the matrices change: the accelerometer's
    matrix therefore multiplies the difference from the mean specific force of the first samples, which is about that of
    gravity, and the rest remains a part of the bias.
    """

    def __init__(self) -> None:
        self._gyro: Float = np.zeros((3, 3))
        self._accel: Float = np.zeros((3, 3))
        self._mean_force: Float = np.zeros(3)
        self._averaged = 0

    def set(self, gyro: Float, accel: Float) -> None:
        """Take errors (3, 3) of the matrices of gyro and accelerometer from now on."""
        self._gyro, self._accel = gyro, accel

    def correct(self, sample: ImuSample) -> ImuSample:
        """Return the corrected sample."""
        if self._averaged < _AVERAGED:
            self._averaged += 1
            self._mean_force = self._mean_force + (sample.linear_acceleration - self._mean_force) / self._averaged
        if not self._gyro.any() and not self._accel.any():
            return sample
        rate, force = sample.angular_velocity, sample.linear_acceleration
        return replace(
            sample,
            angular_velocity=rate + self._gyro @ rate,
            linear_acceleration=force + self._accel @ (force - self._mean_force),
        )
