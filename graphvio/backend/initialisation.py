"""First attitude and gyro bias, from the IMU samples around the first frameset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.config.stages import InitialisationConfig
from graphvio.geometry import so3_exp
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.sensors import GRAVITY_M_S2

_MIN_STANDSTILL_S = 0.3
_SPEED_CHANGE_SIGMA_M_S = 1.5  # the rig may be speeding up or braking
_ACCEL_BIAS_SIGMA_M_S2 = 0.15
_UNKNOWN_GYRO_BIAS_SIGMA = 0.1
_STEEP = 0.8


@dataclass(frozen=True, eq=False)
class InitialAttitude:
    """Attitude and gyro bias before vision has measured anything.

    Attributes:
        nav_R_body: (3, 3) attitude, with gravity down and heading zero.
        tilt_sigma_rad: standard deviation of roll and pitch.
        gyro_bias: (3,) rad/s.
        gyro_bias_sigma: standard deviation of each component of the bias, rad/s.
        is_stationary: whether the rig stood still.
    """

    nav_R_body: Float
    tilt_sigma_rad: float
    gyro_bias: Float
    gyro_bias_sigma: float
    is_stationary: bool


def initial_attitude(interval: ImuInterval, at_s: float, config: InitialisationConfig) -> InitialAttitude:
    """Estimate the attitude at an instant of an IMU interval, ``at_s`` seconds from its beginning.

    At a standstill the mean specific force is gravity and the mean rate is the gyro's bias. In motion, the specific
    force, rotated by the gyro into the instant's frame, still averages to gravity, up to the change of speed divided by
    the duration; the estimation of the bias is then left to the smoother.
    """
    duration = float(interval.steps_s.sum())
    mean_force = interval.linear_acceleration.mean(axis=0)
    is_stationary = duration >= _MIN_STANDSTILL_S and shows_standstill(interval, config)
    tilt_sigma = _ACCEL_BIAS_SIGMA_M_S2 / GRAVITY_M_S2
    if is_stationary:
        samples = len(interval.steps_s)
        bias_sigma = max(3.0 * _spread(interval.angular_velocity) / np.sqrt(samples), 1e-4)
        return InitialAttitude(level(mean_force), tilt_sigma, interval.mean_rate, float(bias_sigma), True)
    force = np.zeros(3)
    start_R_body = np.eye(3)
    start_R_at = np.eye(3)
    elapsed = 0.0
    for step, rate, specific in zip(
        interval.steps_s, interval.angular_velocity, interval.linear_acceleration, strict=True
    ):
        force += step * (start_R_body @ specific)
        start_R_body = start_R_body @ so3_exp(step * rate)
        elapsed += step
        if elapsed <= at_s:
            start_R_at = start_R_body
    force = start_R_at.T @ force
    motion_sigma = _SPEED_CHANGE_SIGMA_M_S / (GRAVITY_M_S2 * duration)
    return InitialAttitude(
        level(force), min(tilt_sigma + motion_sigma, 0.5), np.zeros(3), _UNKNOWN_GYRO_BIAS_SIGMA, False
    )


def shows_standstill(interval: ImuInterval, config: InitialisationConfig) -> bool:
    """Whether an IMU interval shows nothing but gravity and noise; a short one may do so by chance, in motion."""
    return bool(
        _spread(interval.angular_velocity) < config.static_gyro_rad_s
        and _spread(interval.linear_acceleration) < config.static_accel_m_s2
        and abs(float(np.linalg.norm(interval.linear_acceleration.mean(axis=0))) - GRAVITY_M_S2) < 0.5
        and float(np.linalg.norm(interval.mean_rate)) < 0.2  # beyond any gyro's bias
    )


def _spread(samples: Float) -> float:
    """Return the largest standard deviation of a column of (N, 3)."""
    return float(np.sqrt(samples.var(axis=0).max()))


def level(up: Float) -> Float:
    """Return ``nav_R_body`` (3, 3) that rotates a direction (3,) in body to nav's z axis, with heading zero.

    The heading is that of body's x axis, or of its z axis where x is steep.
    """
    up = up / np.linalg.norm(up)
    forward = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < _STEEP else np.array([0.0, 0.0, 1.0])
    x = forward - (forward @ up) * up
    x /= np.linalg.norm(x)
    y = up[[1, 2, 0]] * x[[2, 0, 1]] - up[[2, 0, 1]] * x[[1, 2, 0]]  # up cross x, for which numpy takes long
    return np.array([x, y, up])
