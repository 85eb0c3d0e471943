"""Velocity, biases and gravity at the newest keyframe of a window, as its adjustment finds them."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import skew
from graphvio.linear_algebra import solve_rows
from graphvio.measurements.inertial_state import InertialState
from graphvio.self_calibration.imu_model import (
    ACCEL_BIAS,
    ACCEL_MATRIX,
    GYRO_BIAS,
    GYRO_MATRIX,
    PARAMETERS,
    TIME_OFFSET,
)
from graphvio.self_calibration.solver import Solution


def newest_inertial_state(stamp_ns: int, solution: Solution) -> InertialState:
    """Return velocity, biases and gravity at a window's newest keyframe, from the window's adjustment.

    Args:
        stamp_ns: stamp of the keyframe.
        solution: solution of the window, with an IMU.

    Returns:
        The state. Its biases are those of an IMU without errors of its matrices: the effect of these errors at a rate
        of zero and at the force of gravity is a part of the biases.

    Raises:
        numpy.linalg.LinAlgError: if its covariance is not positive definite.
    """
    states, n = solution.states, len(solution.states.poses)
    imu_at = 6 * n + len(solution.calibration.mean) - PARAMETERS
    parameters = solution.calibration.mean[-PARAMETERS:]
    pose_at, velocity_at = 6 * (n - 1), imu_at + PARAMETERS + 3 * (n - 1)
    body_R_odom = states.poses[-1][:3, :3].T
    velocity, gravity = body_R_odom @ states.velocities[-1], body_R_odom @ states.gravity
    gyro_matrix = np.eye(3) + parameters[GYRO_MATRIX:ACCEL_MATRIX].reshape(3, 3)
    accel_matrix = np.eye(3) + parameters[ACCEL_MATRIX:TIME_OFFSET].reshape(3, 3)
    own_bias = parameters[ACCEL_BIAS : ACCEL_BIAS + 3]
    force = -gravity
    accel_bias = accel_matrix @ own_bias + (np.eye(3) - accel_matrix) @ force
    by_states = np.zeros((12, len(solution.hessian)))
    by_states[:3, pose_at : pose_at + 3] = skew(velocity)
    by_states[:3, velocity_at : velocity_at + 3] = body_R_odom
    by_states[3:6, imu_at + ACCEL_BIAS : imu_at + ACCEL_BIAS + 3] = accel_matrix
    by_states[3:6, imu_at + ACCEL_MATRIX : imu_at + ACCEL_MATRIX + 9] = np.kron(np.eye(3), own_bias - force)
    by_states[6:9, imu_at + GYRO_BIAS : imu_at + GYRO_BIAS + 3] = gyro_matrix
    by_states[9:, pose_at : pose_at + 3] = skew(gravity)
    by_states[9:, -3:] = body_R_odom
    covariance: Float = by_states @ solve_rows(solution.hessian, by_states).T
    np.linalg.cholesky(covariance)
    return InertialState(
        stamp_ns,
        velocity,
        accel_bias,
        gyro_matrix @ parameters[GYRO_BIAS : GYRO_BIAS + 3],
        gravity,
        0.5 * (covariance + covariance.T),
    )
