"""Estimation of the white noise of an IMU from its samples.

Data sheets state the noise of a sensor that does not move. In use it may be many times larger: motors vibrate, a driver
drops samples or does not filter them. True motion is smooth over three samples, so that a sample's deviation from the
straight line between its neighbours is noise, or motion too fast for the sampling rate, which causes as large an error
when it is integrated.
"""

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.kernels import kernel

_MIN_SAMPLES = 20
_MEDIAN_CHI2 = 0.4549  # median of a squared normal deviate


@kernel
def shown_noise(stamps_ns: Int, values: Float, max_gap_ns: int) -> Float:
    """Compute the white noise densities (2,) of gyro and accelerometer, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).

    Args:
        stamps_ns: (N,) increasing stamps.
        values: (N, 6) angular velocities and specific forces.
        max_gap_ns: samples farther apart than this are not neighbours.

    Returns:
        The densities; zeros where there are fewer than 20 samples with two neighbours.
    """
    squares, duration_ns, count = np.empty((6, len(stamps_ns))), 0, 0
    for k in range(1, len(stamps_ns) - 1):
        before, after = stamps_ns[k] - stamps_ns[k - 1], stamps_ns[k + 1] - stamps_ns[k]
        if before > max_gap_ns or after > max_gap_ns:
            continue
        a, b = after / (before + after), before / (before + after)
        for c in range(6):
            beyond = values[k, c] - a * values[k - 1, c] - b * values[k + 1, c]
            squares[c, count] = beyond * beyond / (1.0 + a * a + b * b)
        duration_ns += after
        count += 1
    densities = np.zeros(2)
    if count >= _MIN_SAMPLES:
        for c in range(6):  # medians, as the jump of an axis that was stuck is not noise
            densities[c // 3] += np.median(squares[c, :count]) / (3.0 * _MEDIAN_CHI2)
        densities = np.sqrt(densities * (1e-9 * duration_ns / count))
    return densities
