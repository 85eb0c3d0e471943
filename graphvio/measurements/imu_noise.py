"""White noise of an IMU as its samples show it.

Data sheets state the noise of a sensor that nothing moves. In use it may be many times larger: motors vibrate, a driver
drops samples or filters none. True motion is smooth over three samples, so that what differs from a straight line
between neighbours is noise, or motion too fast for the samples to show, which errs as much when it is integrated.
"""

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.kernels import kernel

_MIN_SAMPLES = 20
_MEDIAN_CHI2 = 0.4549  # of a squared normal deviate


@kernel
def shown_noise(stamps_ns: Int, values: Float, max_gap_ns: int) -> Float:
    """Compute the white noise densities (2,) of gyro and accelerometer, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).

    Args:
        stamps_ns: (N,) increasing.
        values: (N, 6) angular velocities and specific forces.
        max_gap_ns: samples that are farther apart are no neighbours.

    Returns:
        Zeros where there are fewer than 20 samples with two neighbours.
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
        for c in range(6):  # medians: the step of an axis that sticks is no noise
            densities[c // 3] += np.median(squares[c, :count]) / (3.0 * _MEDIAN_CHI2)
        densities = np.sqrt(densities * (1e-9 * duration_ns / count))
    return densities
