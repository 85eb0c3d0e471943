"""Model of an IMU with errors of its calibration: its parameters, and calibrated readings at and between samples.

Angular rate and specific force are ``Mg (gyro - bg)`` and ``Ma (accel - ba)`` with full matrices ``I + errors``, and a
sample stamped t was taken at the cameras' time ``t - time_offset``. The parameters are a vector (25,): ``bg`` (3),
``ba`` (3), errors of ``Mg`` and of ``Ma`` (9 each, row by row), and the time offset in seconds.

Between samples a reading is a cubic with the slopes of the parabolas through three samples (Catmull-Rom). Linear
interpolation cuts off the peaks of a walk's steps: at 200 Hz and over 0.25 s, its error is up to a sixth of that by
noise, and it is systematic.
"""

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.kernels import kernel

GYRO_BIAS, ACCEL_BIAS, GYRO_MATRIX, ACCEL_MATRIX, TIME_OFFSET, PARAMETERS = 0, 3, 6, 15, 24, 25
"""Where the parts of a parameter vector begin, and its length."""

NANOSECOND_S = 1e-9


@kernel
def sensor_matrix(parameters: Float, at: int) -> Float:
    """Return the matrix (3, 3) of a sensor, from its errors."""
    matrix = np.eye(3)
    for r in range(3):
        for c in range(3):
            matrix[r, c] += parameters[at + 3 * r + c]
    return matrix


@kernel
def slope_at(stamps_ns: Int, readings: Float, i: int, slope: Float) -> None:
    """Fill the slope (6,) at a sample: of the parabola through it and its neighbours, or of a line at the ends.

    Next to a gap it is close to the slope towards the nearer neighbour.
    """
    before, after = max(i - 1, 0), min(i + 1, len(stamps_ns) - 1)
    if before == i or after == i:
        step_s = max((stamps_ns[after] - stamps_ns[before]) * NANOSECOND_S, NANOSECOND_S)
        for c in range(6):
            slope[c] = (readings[after, c] - readings[before, c]) / step_s
        return
    left_s, right_s = (
        (stamps_ns[i] - stamps_ns[before]) * NANOSECOND_S,
        (stamps_ns[after] - stamps_ns[i]) * NANOSECOND_S,
    )
    from_left, from_right = right_s / (left_s * (left_s + right_s)), left_s / (right_s * (left_s + right_s))
    for c in range(6):
        slope[c] = from_left * (readings[i, c] - readings[before, c]) + from_right * (
            readings[after, c] - readings[i, c]
        )


@kernel
def read(
    left: Float, right: Float, left_slope: Float, right_slope: Float, step_s: float, x: float, parameters: Float,
    out: Float,
) -> None:  # fmt: skip
    """Interpolate readings (6,) at a place x (0 to 1) between two samples, and subtract the biases."""
    x2 = x * x
    x3 = x2 * x
    of_right = 3.0 * x2 - 2.0 * x3
    of_left_slope, of_right_slope = step_s * (x3 - 2.0 * x2 + x), step_s * (x3 - x2)
    for c in range(6):
        reading = left[c] + of_right * (right[c] - left[c])
        out[c] = reading + of_left_slope * left_slope[c] + of_right_slope * right_slope[c] - parameters[c]


@kernel
def calibrate(raw: Float, gyro_matrix: Float, accel_matrix: Float, out: Float) -> None:
    """Turn readings less bias (6,) into rate and specific force (6,)."""
    for r in range(3):
        out[r] = gyro_matrix[r, 0] * raw[0] + gyro_matrix[r, 1] * raw[1] + gyro_matrix[r, 2] * raw[2]
        out[3 + r] = accel_matrix[r, 0] * raw[3] + accel_matrix[r, 1] * raw[4] + accel_matrix[r, 2] * raw[5]
