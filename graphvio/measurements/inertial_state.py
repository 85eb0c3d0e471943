"""Velocity, biases and gravity at a keyframe, from a bundle adjustment that also estimates the calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float


@dataclass(frozen=True, eq=False)
class InertialState:
    """Velocity, biases and gravity at a keyframe, in the body frame then.

    Attributes:
        stamp_ns: stamp of the frameset.
        velocity: (3,) m/s.
        accel_bias: (3,) bias of the readings after their correction by the calibration, m/s^2.
        gyro_bias: (3,) bias of the corrected readings, rad/s.
        gravity: (3,) m/s^2, downwards.
        covariance: (12, 12) covariance of ``[velocity, accel_bias, gyro_bias, gravity]``.
    """

    stamp_ns: int
    velocity: Float
    accel_bias: Float
    gyro_bias: Float
    gravity: Float
    covariance: Float

    def distance2(self, velocity: Float, accel_bias: Float, gyro_bias: Float, gravity: Float) -> float:
        """Return the squared Mahalanobis distance of other values from these, by the covariance of these alone."""
        off = np.concatenate(
            [velocity - self.velocity, accel_bias - self.accel_bias, gyro_bias - self.gyro_bias, gravity - self.gravity]
        )
        return float(off @ np.linalg.solve(self.covariance, off))

    @property
    def tilt_sigma_rad(self) -> float:
        """Largest standard deviation of gravity's direction, rad."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[9:, 9:])[-1]) / np.linalg.norm(self.gravity))
