"""The inertial sensor: rate, noise, time offset, scale and misalignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError
from graphvio.rig.values import set_value

_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
MAX_MATRIX_ERROR = 0.2


@dataclass(frozen=True)
class Imu:
    """The inertial sensor; its frame is body.

    Attributes:
        rate_hz: nominal sample rate.
        gyro_noise_density: white noise of the gyro, rad/s/sqrt(Hz).
        gyro_random_walk: random walk of the gyro's bias, rad/s^2/sqrt(Hz).
        accel_noise_density: white noise of the accelerometer, m/s^2/sqrt(Hz).
        accel_random_walk: random walk of the accelerometer's bias, m/s^3/sqrt(Hz).
        time_offset_s: offset of the IMU's clock, ``t_imu = t_cam + time_offset`` (Kalibr's ``timeshift_cam_imu``);
            ``t_cam`` is the stamp of an image plus the ``stamp_offset_s`` of its camera.
        gyro_matrix: scale and misalignment of the gyro, (3, 3) by rows; measured angular velocities are multiplied by
            it.
        accel_matrix: the same for measured specific forces.

    Raises:
        RigError: if the rate or a density is not positive, a value is not finite, or a matrix is not near the identity.
    """

    rate_hz: float = 200.0
    gyro_noise_density: float = 1.7e-4
    gyro_random_walk: float = 2.0e-5
    accel_noise_density: float = 2.0e-3
    accel_random_walk: float = 3.0e-3
    time_offset_s: float = 0.0
    gyro_matrix: tuple[float, ...] = _IDENTITY
    accel_matrix: tuple[float, ...] = _IDENTITY

    def __post_init__(self) -> None:
        for name in ("gyro_matrix", "accel_matrix"):
            matrix = np.array(getattr(self, name), dtype=np.float64).ravel()
            if matrix.shape != (9,) or not np.abs(matrix - _IDENTITY).max() < MAX_MATRIX_ERROR:  # also refuses NaN
                raise RigError(f"imu: {name} is {matrix.tolist()}; it must be three rows that are nearly the identity")
            set_value(self, name, tuple(matrix.tolist()))
        for name, value in vars(self).items():
            if name.endswith("_matrix"):
                continue
            if not np.isfinite(value):
                raise RigError(f"imu: {name} is {value}; it must be a finite number")
            if name != "time_offset_s" and value <= 0:
                raise RigError(f"imu: {name} is {value}; it must be positive")
        if abs(self.time_offset_s) > 1.0:
            raise RigError(f"imu: time_offset_s is {self.time_offset_s}; it must be in seconds, less than one")

    @property
    def time_offset_ns(self) -> int:
        """`time_offset_s` in nanoseconds."""
        return round(self.time_offset_s * 1e9)

    @property
    def noise_densities(self) -> Float:
        """White noise densities (2,) of gyro and accelerometer."""
        return np.array([self.gyro_noise_density, self.accel_noise_density])

    @property
    def has_matrices(self) -> bool:
        """Whether `gyro_matrix` or `accel_matrix` is not the identity, so that readings have to be multiplied."""
        return self.gyro_matrix != _IDENTITY or self.accel_matrix != _IDENTITY

    @property
    def matrices(self) -> tuple[Float, Float]:
        """`gyro_matrix` and `accel_matrix` as arrays (3, 3)."""
        return np.reshape(self.gyro_matrix, (3, 3)), np.reshape(self.accel_matrix, (3, 3))
