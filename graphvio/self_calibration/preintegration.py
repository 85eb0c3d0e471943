"""Preintegration of the IMU between two instants: one change of rotation, velocity and position.

Readings are integrated to fourth order in the step (Simpson's rule; rotations with the coning term): C. Forster, L.
Carlone, F. Dellaert, D. Scaramuzza, *On-Manifold Preintegration for Real-Time Visual-Inertial Odometry*, IEEE T-RO
33(1), 2017, with derivatives with respect to all parameters of `graphvio.self_calibration.imu_model`.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.errors import MeasurementError
from graphvio.geometry import so3_exp, so3_log
from graphvio.kernels import kernel, put
from graphvio.self_calibration.imu_model import (
    ACCEL_MATRIX,
    GYRO_MATRIX,
    NANOSECOND_S,
    PARAMETERS,
    TIME_OFFSET,
    calibrate,
    read,
    sensor_matrix,
    slope_at,
)
from graphvio.self_calibration.preintegration_errors import (
    add_cross,
    add_derivatives,
    add_noise,
    covariance_of,
    fill_parameter_columns,
    fill_time_offset_column,
)


class Preintegrated(NamedTuple):
    """Motion between two instants by the IMU, in the body frame of the first one, with gravity not subtracted.

    The tangent is ``[rotation, velocity, position]``; rotation is perturbed on the right, ``R Exp(r)``.

    Attributes:
        rotation: (3, 3) ``start_R_end``.
        velocity: (3,) m/s.
        position: (3,) m.
        jacobian: (9, 25) derivative with respect to the parameters.
        covariance: (9, 9) covariance due to the samples' white noise.
        force_variances: (3,) by the accelerometer's noise, the same along each axis, before its matrix is applied:
            variance of velocity, covariance of position with velocity, and variance of position.
        middle_rotation: (3, 3) ``start_R_body`` in the middle of the interval.
        duration_s: duration of the interval.
    """

    rotation: Float
    velocity: Float
    position: Float
    jacobian: Float
    covariance: Float
    force_variances: Float
    middle_rotation: Float
    duration_s: float


def preintegrate(
    stamps_ns: Int,
    readings: Float,
    start_ns: int,
    end_ns: int,
    parameters: Float,
    noise_densities: Float,
    max_gap_ns: int = 50_000_000,
    noise_factors: Float | None = None,
) -> Preintegrated:
    """Integrate the samples between two instants of the cameras' time.

    Args:
        stamps_ns: (N,) increasing, of the IMU's clock.
        readings: (N, 6) gyro, rad/s, and accelerometer, m/s^2, frame body.
        start_ns: start of the interval.
        end_ns: end of the interval.
        parameters: (25,) of the IMU.
        noise_densities: (2,) white noise of gyro, rad/s/sqrt(Hz), and of accelerometer, m/s^2/sqrt(Hz).
        max_gap_ns: largest gap between samples of the interval.
        noise_factors: (N, 2) factors on the variance of the noise of gyro and accelerometer, from each sample to the
            next; None if they are 1.

    Raises:
        MeasurementError: if the samples do not cover the interval.
    """
    first, last = covering_samples(stamps_ns, start_ns, end_ns, parameters[TIME_OFFSET], max_gap_ns)
    if last < 0:
        raise MeasurementError(
            f"IMU samples do not cover the interval from {start_ns} to {end_ns} ns of the cameras' time without gaps: "
            "pass samples from before its start to after its end, both moved by the time offset"
        )
    factors = np.ones((len(stamps_ns), 2)) if noise_factors is None else noise_factors
    return integrate_samples(stamps_ns, readings, first, last, start_ns, end_ns, parameters, noise_densities, factors)


@kernel
def covering_samples(
    stamps_ns: Int, start_ns: int, end_ns: int, time_offset_s: float, max_gap_ns: int
) -> tuple[int, int]:
    """Find the samples that enclose an interval of the cameras' time.

    Returns:
        Index of the last sample at or before the start, and of the first one at or after the end; -1 twice if there are
        none, if there is a gap between them, or if the interval does not end after its start.
    """
    offset_ns = time_offset_s / NANOSECOND_S
    first = np.searchsorted(stamps_ns, start_ns + np.int64(np.floor(offset_ns)), "right") - 1
    last = np.searchsorted(stamps_ns, end_ns + np.int64(np.ceil(offset_ns)), "left")
    if first < 0 or last >= len(stamps_ns) or end_ns <= start_ns:
        return -1, -1
    for i in range(first, last):
        if stamps_ns[i + 1] - stamps_ns[i] > max_gap_ns:
            return -1, -1
    return int(first), int(last)


@kernel
def integrate_samples(
    stamps_ns: Int, readings: Float, first: int, last: int, start_ns: int, end_ns: int, parameters: Float,
    noise_densities: Float, noise_factors: Float,
) -> Preintegrated:  # fmt: skip
    """Integrate the samples from one index to another, see `covering_samples` and `preintegrate`."""
    offset_s, duration_s = parameters[TIME_OFFSET], (end_ns - start_ns) * NANOSECOND_S
    gyro_matrix, accel_matrix = sensor_matrix(parameters, GYRO_MATRIX), sensor_matrix(parameters, ACCEL_MATRIX)
    left_slope, right_slope = np.empty(6), np.empty(6)
    # Readings less bias, and rates and forces, at the start, the middle and the end of a step.
    raw_start, raw_middle, raw_end = np.empty(6), np.empty(6), np.empty(6)
    at_start, at_middle, at_end, very_start = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    rotation, middle_rotation, end_rotation = np.eye(3), np.eye(3), np.eye(3)
    velocity, position = np.zeros(3), np.zeros(3)
    start_force, middle_force, end_force = np.empty(3), np.empty(3), np.empty(3)  # in the frame of the interval's start
    half_turn, turn = np.empty(3), np.empty(3)
    sums = np.zeros((5, 4, 3, 3))
    spread, levers, of_force = np.zeros((3, 3, 3)), np.zeros((2, 3)), np.zeros(3)
    turned_s, is_first = 0.0, True
    slope_at(stamps_ns, readings, first, left_slope)
    for i in range(first, last):
        slope_at(stamps_ns, readings, i + 1, right_slope)
        begin_s = (stamps_ns[i] - start_ns) * NANOSECOND_S - offset_s
        step_s = (stamps_ns[i + 1] - stamps_ns[i]) * NANOSECOND_S
        from_s, to_s = max(begin_s, 0.0), min(begin_s + step_s, duration_s)
        h = to_s - from_s
        if h > 0.0:
            if is_first:
                x = (from_s - begin_s) / step_s
                read(readings[i], readings[i + 1], left_slope, right_slope, step_s, x, parameters, raw_start)
                calibrate(raw_start, gyro_matrix, accel_matrix, at_start)
                put(very_start, at_start)
                _rotate(rotation, at_start, start_force)
                is_first = False
            x = (0.5 * (from_s + to_s) - begin_s) / step_s
            read(readings[i], readings[i + 1], left_slope, right_slope, step_s, x, parameters, raw_middle)
            calibrate(raw_middle, gyro_matrix, accel_matrix, at_middle)
            x = (to_s - begin_s) / step_s
            read(readings[i], readings[i + 1], left_slope, right_slope, step_s, x, parameters, raw_end)
            calibrate(raw_end, gyro_matrix, accel_matrix, at_end)
            for c in range(3):
                half_turn[c] = h / 24.0 * (5.0 * at_start[c] + 8.0 * at_middle[c] - at_end[c])
                turn[c] = h / 6.0 * (at_start[c] + 4.0 * at_middle[c] + at_end[c])
            add_cross(h * h / 48.0, at_start, at_middle, half_turn)
            add_cross(h * h / 12.0, at_start, at_end, turn)
            _turn(rotation, half_turn, middle_rotation)
            _turn(rotation, turn, end_rotation)
            _rotate(middle_rotation, at_middle, middle_force)
            _rotate(end_rotation, at_end, end_force)
            for c in range(3):
                position[c] += h * velocity[c] + h * h / 6.0 * (start_force[c] + 2.0 * middle_force[c])
                velocity[c] += h / 6.0 * (start_force[c] + 4.0 * middle_force[c] + end_force[c])
            add_derivatives(h, middle_rotation, middle_force, raw_middle, sums)
            add_noise(h, middle_force, turned_s, noise_densities, noise_factors[i], levers, spread, of_force)
            turned_s += h * noise_factors[i, 0]
            put(rotation, end_rotation)
            put(start_force, end_force)
            put(at_start, at_end)
        put(left_slope, right_slope)
    jacobian = np.zeros((9, PARAMETERS))
    fill_parameter_columns(rotation, gyro_matrix, accel_matrix, sums, jacobian)
    fill_time_offset_column(rotation, velocity, position, duration_s, very_start, at_end, end_force, jacobian)
    middle = so3_exp(0.5 * so3_log(rotation))
    turn = turned_s * noise_densities[0] ** 2
    covariance = covariance_of(rotation, turn, levers, spread, of_force, middle @ accel_matrix)
    return Preintegrated(rotation, velocity, position, jacobian, covariance, of_force, middle, duration_s)


@kernel
def _rotate(rotation: Float, calibrated: Float, force: Float) -> None:
    """Rotate the specific force, the last three of rate and force (6,)."""
    for r in range(3):
        force[r] = rotation[r, 0] * calibrated[3] + rotation[r, 1] * calibrated[4] + rotation[r, 2] * calibrated[5]


@kernel
def _turn(rotation: Float, phi: Float, out: Float) -> None:
    """Compute ``rotation Exp(phi)`` of a rotation vector (3,), without the allocations of `so3_exp`."""
    x, y, z = phi
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-4:
        a = 1.0 - angle2 / 6.0 * (1.0 - angle2 / 20.0)
        b = 0.5 - angle2 / 24.0 * (1.0 - angle2 / 30.0)
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    e00, e01, e02 = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    e10, e11, e12 = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    e20, e21, e22 = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    for r in range(3):
        p, q, s = rotation[r]
        out[r, 0] = p * e00 + q * e10 + s * e20
        out[r, 1] = p * e01 + q * e11 + s * e21
        out[r, 2] = p * e02 + q * e12 + s * e22
