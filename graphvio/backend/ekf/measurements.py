"""Measurements of the filter (eq. 13): rates by vision and gyro, and the accelerometer as gravity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.ekf.state import ATTITUDE, ERRORS, GYRO_BIAS, RATE, VELOCITY, FilterState
from graphvio.geometry import skew, so3_log, so3_right_jacobian_inverse
from graphvio.measurements.motion import RelativeMotion
from graphvio.measurements.sensors import GRAVITY_M_S2

STANDSTILL_FORCE_NAV = np.array([0.0, 0.0, GRAVITY_M_S2])
"""Specific force (3,) m/s^2 at a standstill, in nav: upwards, the opposite of ``gravity_nav``."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """A measurement at a state.

    Attributes:
        name: Name of the sensor.
        innovation: (M,) measured minus expected value.
        by_error: (M, 15) measurement Jacobian H: derivative of the expected value with respect to the state's error.
        covariance: (M, M) covariance of the noise.
    """

    name: str
    innovation: Float
    by_error: Float
    covariance: Float


@dataclass(frozen=True, eq=False)
class VisualRates:
    """Velocity and angular rate by vision, each the mean over the step that ends in the state.

    Attributes:
        values: (6,) ``[v, omega]``, m/s and rad/s, in body. v is in body at the beginning of the step; the paper's
            model compares it with the state's v, which is in body at the end.
        covariance: (6, 6) covariance of the values.
    """

    values: Float
    covariance: Float

    @staticmethod
    def of(motion: RelativeMotion) -> VisualRates:
        """Divide a measured motion by its time step: ``-R^T T`` and the rotation vector (section 5)."""
        dt = motion.duration_s
        rotation = np.ascontiguousarray(motion.reference_T_current[:3, :3])
        turn = so3_log(rotation)
        by_tangent = np.zeros((6, 6))
        by_tangent[0:3, 3:6] = rotation / dt
        by_tangent[3:6, 0:3] = so3_right_jacobian_inverse(turn) / dt
        values = np.concatenate([motion.reference_T_current[:3, 3], turn]) / dt
        return VisualRates(values, by_tangent @ motion.covariance @ by_tangent.T)


def stacked(measurements: Sequence[Measurement]) -> Measurement:
    """Stack several independent measurements of one state."""
    sizes = [len(measurement.innovation) for measurement in measurements]
    covariance = np.zeros((sum(sizes), sum(sizes)))
    start = 0
    for measurement, size in zip(measurements, sizes, strict=True):
        covariance[start : start + size, start : start + size] = measurement.covariance
        start += size
    return Measurement(
        " and ".join(measurement.name for measurement in measurements),
        np.concatenate([measurement.innovation for measurement in measurements]),
        np.concatenate([measurement.by_error for measurement in measurements]),
        covariance,
    )


def vision(state: FilterState, rates: VisualRates) -> Measurement:
    """Measure ``v^vo = v + n`` and ``omega^vo = omega + n``, which are correlated with each other."""
    by_error = np.zeros((6, ERRORS))
    by_error[0:3, VELOCITY] = by_error[3:6, RATE] = np.eye(3)
    expected = np.concatenate([state.velocity_body, state.rate_body])
    return Measurement("vision", rates.values - expected, by_error, rates.covariance)


def gyro(state: FilterState, rate: Float, sigma_rad_s: float) -> Measurement:
    """Measure ``omega^imu = omega + b + n``."""
    by_error = np.zeros((3, ERRORS))
    by_error[:, RATE] = by_error[:, GYRO_BIAS] = np.eye(3)
    return Measurement("gyro", rate - state.rate_body - state.gyro_bias, by_error, sigma_rad_s**2 * np.eye(3))


def accelerometer(state: FilterState, force: Float, sigma_m_s2: float) -> Measurement:
    """Measure ``a^imu = R(q) g + n``, where the rig's own acceleration is part of the noise."""
    expected = state.nav_R_body.T @ STANDSTILL_FORCE_NAV
    by_error = np.zeros((3, ERRORS))
    by_error[:, ATTITUDE] = skew(expected)
    return Measurement("accelerometer", force - expected, by_error, sigma_m_s2**2 * np.eye(3))
