"""How much of an image is noise."""

import numpy as np

from graphvio.arrays import Image
from graphvio.kernels import kernel

_STEP = 6  # pixels and rows from one place that is looked at to the next
_MAX_RESPONSE = 2047
_SHARE = 0.5
_DEVIATIONS = 6.0 * 0.6745  # the operator's gain on the noise's deviation, times a normal deviate's median


@kernel
def noise_sigma(image: Image) -> float:
    """Standard deviation of an image's noise in grey levels, at least that of rounding to whole ones.

    The operator of J. Immerkaer (*Fast noise variance estimation*, CVIU 64(2), 1996) is blind to anything that is
    linear along rows or columns; the median over the image leaves out most of the remaining texture. Pixels that are
    black or saturated show no noise and do not count.
    """
    height, width = image.shape
    histogram = np.zeros(_MAX_RESPONSE + 1, dtype=np.int64)
    count = 0
    for y in range(1, height - 1, _STEP):
        for x in range(1, width - 1, _STEP):
            middle = int(image[y, x])
            if middle == 0 or middle == 255:
                continue
            corners = int(image[y - 1, x - 1]) + int(image[y - 1, x + 1])
            corners += int(image[y + 1, x - 1]) + int(image[y + 1, x + 1])
            edges = int(image[y - 1, x]) + int(image[y + 1, x]) + int(image[y, x - 1]) + int(image[y, x + 1])
            histogram[min(abs(corners - 2 * edges + 4 * middle), _MAX_RESPONSE)] += 1
            count += 1
    rounding = float(1.0 / np.sqrt(12.0))
    below = 0
    for value in range(_MAX_RESPONSE + 1):
        if below + histogram[value] > _SHARE * count:
            within = (_SHARE * count - below) / histogram[value]
            return float(max((value - 0.5 + within) / _DEVIATIONS, rounding))
        below += histogram[value]
    return rounding
