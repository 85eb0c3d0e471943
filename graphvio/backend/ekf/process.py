"""The process model of the filter: constant velocity, constant angular velocity (eq. 11, 12)."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.ekf.state import ATTITUDE, ERRORS, GYRO_BIAS, POSITION, RATE, VELOCITY, FilterState
from graphvio.geometry import skew, so3_exp, so3_right_jacobian

NOISES = 9
"""Elements of the process noise: ``n_v`` (3), ``n_omega`` (3), ``n_b`` (3)."""


def noise_sigmas(dt: float, accel_sigma_m_s2: float, angular_accel_sigma_rad_s2: float, gyro_bias_walk: float) -> Float:
    """Return the standard deviations (9,) of the process noise over a time step.

    Args:
        dt: Time step, seconds.
        accel_sigma_m_s2: Standard deviation of the unknown acceleration, constant within a step.
        angular_accel_sigma_rad_s2: Standard deviation of the unknown angular acceleration.
        gyro_bias_walk: Random walk of the gyro bias, rad/s/sqrt(s) (= rad/s^2/sqrt(Hz)), as in `graphvio.rig.Imu`.
    """
    return np.repeat([accel_sigma_m_s2 * dt, angular_accel_sigma_rad_s2 * dt, gyro_bias_walk * np.sqrt(dt)], 3)


def propagated(state: FilterState, dt: float) -> FilterState:
    """Return the state after a time step in seconds, without noise (eq. 11 and 12)."""
    return FilterState(
        state.position + state.nav_R_body @ state.velocity_body * dt,
        state.nav_R_body @ so3_exp(state.rate_body * dt),
        state.velocity_body,
        state.rate_body,
        state.gyro_bias,
    )


def jacobians(state: FilterState, dt: float) -> tuple[Float, Float]:
    """Return the state-transition Jacobian F (15, 15) and the noise Jacobian G (15, 9) of a step, eq. (11) and (12).

    The motion of the step, eq. (12), is ``x_rel = (v + n_v) dt`` in body and ``rho_rel = (omega + n_omega) dt``. The
    blocks of position with respect to velocity and ``n_v`` are the derivatives through ``x_rel``, those of attitude
    with respect to rate and ``n_omega`` through ``rho_rel``. The same noise changes the velocities.
    """
    by_error, by_noise = np.eye(ERRORS), np.zeros((ERRORS, NOISES))
    turned = so3_right_jacobian(state.rate_body * dt) * dt
    by_error[POSITION, ATTITUDE] = -state.nav_R_body @ skew(state.velocity_body * dt)
    by_error[POSITION, VELOCITY] = by_noise[POSITION, 0:3] = state.nav_R_body * dt
    by_error[ATTITUDE, ATTITUDE] = so3_exp(-state.rate_body * dt)
    by_error[ATTITUDE, RATE] = by_noise[ATTITUDE, 3:6] = turned
    by_noise[VELOCITY, 0:3] = by_noise[RATE, 3:6] = by_noise[GYRO_BIAS, 6:9] = np.eye(3)
    return by_error, by_noise
