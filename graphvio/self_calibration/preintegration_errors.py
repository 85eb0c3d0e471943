"""Derivatives and covariance of preintegrated IMU samples, as sums over the steps by the midpoint rule.

All sums are in the frame of the interval's start, with errors of the rotation on its left: there they need no
transition matrices, and the gyro's noise is the same in all directions.
"""

import numpy as np

from graphvio.arrays import Float
from graphvio.kernels import kernel
from graphvio.self_calibration.imu_model import (
    ACCEL_BIAS,
    ACCEL_MATRIX,
    GYRO_BIAS,
    GYRO_MATRIX,
    TIME_OFFSET,
)


@kernel
def add_cross(factor: float, a: Float, b: Float, out: Float) -> None:
    """Add a multiple of the cross product of the first three elements."""
    out[0] += factor * (a[1] * b[2] - a[2] * b[1])
    out[1] += factor * (a[2] * b[0] - a[0] * b[2])
    out[2] += factor * (a[0] * b[1] - a[1] * b[0])


@kernel
def add_derivatives(h: float, rotation: Float, force: Float, raw: Float, sums: Float) -> None:
    """Add a step to the derivatives with respect to errors of rate and force, frame of the interval's start.

    Args:
        h: duration of the step, s.
        rotation: (3, 3) rotation in the middle of the step.
        force: (3,) specific force, rotated by it.
        raw: (6,) readings less bias.
        sums: (5, 4, 3, 3) derivatives of the rotation on the left, velocity and position with respect to rate, and of
            velocity and position with respect to force: for an error that is constant, and for errors that are
            proportional to the reading of each axis.
    """
    by_rate, rate_velocity, rate_position, force_velocity, force_position = sums
    fx, fy, fz = force
    for q in range(4):
        of_rate = h * (raw[q - 1] if q > 0 else 1.0)
        of_force = h * (raw[q + 2] if q > 0 else 1.0)
        for c in range(3):
            tx = by_rate[q, 0, c] + 0.5 * of_rate * rotation[0, c]
            ty = by_rate[q, 1, c] + 0.5 * of_rate * rotation[1, c]
            tz = by_rate[q, 2, c] + 0.5 * of_rate * rotation[2, c]
            gained = h * (ty * fz - tz * fy), h * (tz * fx - tx * fz), h * (tx * fy - ty * fx)
            for r in range(3):
                by_rate[q, r, c] += of_rate * rotation[r, c]
                rate_position[q, r, c] += h * (rate_velocity[q, r, c] + 0.5 * gained[r])
                rate_velocity[q, r, c] += gained[r]
                directly = of_force * rotation[r, c]
                force_position[q, r, c] += h * (force_velocity[q, r, c] + 0.5 * directly)
                force_velocity[q, r, c] += directly


@kernel
def fill_parameter_columns(
    rotation: Float, gyro_matrix: Float, accel_matrix: Float, sums: Float, jacobian: Float
) -> None:
    """Fill the columns (9, 24) of biases and matrices from the sums of `add_derivatives`."""
    for part in range(5):
        row, is_force = (0, 3, 6, 3, 6)[part], part > 2
        bias, matrix = (ACCEL_BIAS, ACCEL_MATRIX) if is_force else (GYRO_BIAS, GYRO_MATRIX)
        for r in range(3):
            for c in range(3):
                total = 0.0
                for k in range(3):
                    by_matrix = accel_matrix[k, c] if is_force else gyro_matrix[k, c]
                    total += sums[part, 0, r, k] * by_matrix
                    jacobian[row + r, matrix + 3 * k + c] = sums[part, c + 1, r, k]
                jacobian[row + r, bias + c] = -total
    for c in range(TIME_OFFSET):
        x, y, z = jacobian[0, c], jacobian[1, c], jacobian[2, c]
        for r in range(3):  # from a perturbation of the rotation on the left to one on the right
            jacobian[r, c] = rotation[0, r] * x + rotation[1, r] * y + rotation[2, r] * z


@kernel
def fill_time_offset_column(
    rotation: Float, velocity: Float, position: Float, duration_s: float, at_start: Float, at_end: Float,
    end_force: Float, jacobian: Float,
) -> None:  # fmt: skip
    """Fill the column of the time offset, by which both ends of the interval move over the readings."""
    turned_v, turned_p = np.zeros(3), np.zeros(3)
    add_cross(1.0, at_start, velocity, turned_v)
    add_cross(1.0, at_start, position, turned_p)
    for r in range(3):
        before = rotation[0, r] * at_start[0] + rotation[1, r] * at_start[1] + rotation[2, r] * at_start[2]
        jacobian[r, TIME_OFFSET] = at_end[r] - before
        jacobian[3 + r, TIME_OFFSET] = end_force[r] - at_start[3 + r] - turned_v[r]
        jacobian[6 + r, TIME_OFFSET] = velocity[r] - duration_s * at_start[3 + r] - turned_p[r]


@kernel
def add_noise(
    h: float, force: Float, turned_s: float, noise_densities: Float, noise_factors: Float, levers: Float,
    spread: Float, of_force: Float,
) -> None:  # fmt: skip
    """Propagate the covariance over a step, frame of the interval's start.

    The rotation's covariance is a multiple of I there. Those of velocity and position with it are cross products,
    ``-skew(lever)``, and ``skew(a) skew(b) = b a^T - (a b) I``.

    Args:
        h: duration of the step, s.
        force: (3,) specific force in the middle of the step.
        turned_s: duration of the steps before, each times its factor for the gyro.
        noise_densities: (2,) white noise of gyro and accelerometer.
        noise_factors: (2,) factors on their variances in this step.
        levers: (2, 3) levers of velocity and position.
        spread: (3, 3, 3) covariances of velocity, of position with velocity, and of position, by the gyro's noise.
        of_force: (3,) the same variances by the accelerometer's noise, which is the same in all directions.
    """
    turn = noise_densities[0] ** 2 * (turned_s + 0.5 * h * noise_factors[0])
    noise = noise_densities[1] ** 2 * h * noise_factors[1]
    of_velocity, of_position = levers
    velocity, mixed, position = spread
    for r in range(3):
        for c in range(3):
            position[r, c] += h * (mixed[r, c] + mixed[c, r]) + h * h * velocity[r, c]
    for r in range(3):
        for c in range(3):
            mixed[r, c] += h * velocity[r, c]
    by_velocity, by_mixed, by_position = 0.0, 0.0, 0.0  # inner products, for the diagonals
    for k in range(3):
        middle = of_velocity[k] + 0.5 * h * turn * force[k]
        later = of_position[k] + h * of_velocity[k] + 0.5 * h * h * turn * force[k]
        by_velocity += 2.0 * h * force[k] * middle
        by_mixed += h * force[k] * later + 0.5 * h * h * force[k] * of_velocity[k]
        by_position += h * h * force[k] * (later - 0.25 * h * h * turn * force[k])
    for r in range(3):
        for c in range(3):
            middle_r = of_velocity[r] + 0.5 * h * turn * force[r]
            middle_c = of_velocity[c] + 0.5 * h * turn * force[c]
            later_r = of_position[r] + h * of_velocity[r] + 0.5 * h * h * turn * force[r]
            later_c = of_position[c] + h * of_velocity[c] + 0.5 * h * h * turn * force[c]
            less = 0.25 * h * h * turn
            velocity[r, c] -= h * (force[r] * middle_c + middle_r * force[c])
            mixed[r, c] -= h * force[r] * later_c + 0.5 * h * h * of_velocity[r] * force[c]
            position[r, c] -= (
                0.5 * h * h * (force[r] * (later_c - less * force[c]) + (later_r - less * force[r]) * force[c])
            )
        velocity[r, r] += by_velocity
        mixed[r, r] += by_mixed
        position[r, r] += by_position
    of_force[2] += h * (2.0 * of_force[1] + h * (of_force[0] + noise / 3.0))
    of_force[1] += h * (of_force[0] + 0.5 * noise)
    of_force[0] += noise
    for k in range(3):
        of_position[k] += h * of_velocity[k] + 0.5 * h * h * turn * force[k]
        of_velocity[k] += h * turn * force[k]


@kernel
def covariance_of(
    rotation: Float, turn: float, levers: Float, spread: Float, of_force: Float, force_axes: Float
) -> Float:
    """Return the covariance (9, 9) from the parts of `add_noise`.

    Args:
        rotation: (3, 3) rotation over the interval.
        turn: variance of the rotation.
        levers: see `add_noise`, also for the next two.
        spread: likewise.
        of_force: likewise, before the accelerometer's matrix is applied.
        force_axes: (3, 3) the accelerometer's axes in the middle of the interval, by its matrix.
    """
    covariance = np.zeros((9, 9))
    for r in range(3):
        covariance[r, r] = turn
        for c in range(3):
            covariance[3 + r, 3 + c] = spread[0, r, c]
            covariance[6 + r, 3 + c] = covariance[3 + c, 6 + r] = spread[1, r, c]
            covariance[6 + r, 6 + c] = spread[2, r, c]
    for r in range(3):
        for c in range(3):
            by_axes = 0.0
            for k in range(3):
                by_axes += force_axes[r, k] * force_axes[c, k]
            covariance[3 + r, 3 + c] += of_force[0] * by_axes
            covariance[6 + r, 3 + c] += of_force[1] * by_axes
            covariance[3 + r, 6 + c] += of_force[1] * by_axes
            covariance[6 + r, 6 + c] += of_force[2] * by_axes
    for part in range(2):
        x, y, z = levers[part]
        for c in range(3):
            column = rotation[0, c], rotation[1, c], rotation[2, c]
            turned = z * column[1] - y * column[2], x * column[2] - z * column[0], y * column[0] - x * column[1]
            for r in range(3):
                row = 3 + 3 * part + r
                covariance[row, c] = covariance[c, row] = turned[r]
    return covariance
