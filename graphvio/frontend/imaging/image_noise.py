"""Measurement of image noise, and smoothing of images while the noise is too large for their contrast.

Patches that are mostly noise resemble nothing in another image: tracks still survive, since they are searched for where
they are predicted, but few corners are found along their epipolar lines. After smoothing by about a pixel, they are
found again. Clean images are not smoothed, since this costs sharp ones precision.
"""

from __future__ import annotations

import cv2
import numpy as np

from graphvio.arrays import Image
from graphvio.kernels import kernel

_GAIN = 6.0 * 0.6745  # the operator's gain on the noise's deviation, times a normal deviate's median
_QUANTILE = 0.5
_STEP = 6  # pixels and rows from one sample of the noise to the next
_MAX_RESPONSE = 2047
_BLOCK_PX, _BLOCK_STEP = 16, 2
_MAX_TEXTURED = 0.25  # share of textured blocks, in which corners lie
_MIN_TO_SMOOTH, _MIN_TO_GO_ON = 0.2, 0.15  # noise over contrast; sharp images have less than 0.1
_SMOOTHING_PX = 0.8
_SMOOTHED = 0.315  # gradients of white noise after the smoothing, over those before
_ROUNDING = float(1.0 / np.sqrt(12.0))  # sigma of rounding to whole grey levels


class NoiseFilter:
    """Smooths images of the cameras of one pair while their noise is large compared with their contrast.

    Attributes:
        left_sigma: noise of the newest left image as it was returned: standard deviation, grey levels, of white noise
            with the same gradients.
    """

    def __init__(self) -> None:
        self.left_sigma = 0.0
        self._is_smoothing = False

    def filtered(self, left: Image, right: Image | None) -> tuple[Image, Image | None]:
        """Return the images, both smoothed if the noise of either one is too large for its contrast.

        Args:
            left: left image (height, width), or the image of a single camera.
            right: right image (height, width), or None.
        """
        largest = _MIN_TO_GO_ON if self._is_smoothing else _MIN_TO_SMOOTH
        self.left_sigma = noise_sigma(left)
        self._is_smoothing = has_less_contrast(left, self.left_sigma / largest) or (
            right is not None and has_less_contrast(right, noise_sigma(right) / largest)
        )
        if not self._is_smoothing:
            return left, right
        self.left_sigma = float(np.hypot(_SMOOTHED * self.left_sigma, _ROUNDING))
        return _smoothed(left), None if right is None else _smoothed(right)


def _smoothed(image: Image) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _SMOOTHING_PX), dtype=np.uint8)


@kernel
def has_less_contrast(image: Image, sigma: float) -> bool:
    """Return whether an image has less contrast than a limit in blocks of 16 x 16 pixels.

    Up to a quarter of the blocks may have more: these may be textured.

    Args:
        image: (height, width) the image.
        sigma: limit, a standard deviation of the grey levels within a block.
    """
    height, width = image.shape
    rows, columns, count = height // _BLOCK_PX, width // _BLOCK_PX, (_BLOCK_PX // _BLOCK_STEP) ** 2
    n_others = 0  # blocks with as much contrast, or more
    for j in range(rows):
        for i in range(columns):
            total = squares = 0
            for y in range(j * _BLOCK_PX, (j + 1) * _BLOCK_PX, _BLOCK_STEP):
                for x in range(i * _BLOCK_PX, (i + 1) * _BLOCK_PX, _BLOCK_STEP):
                    value = int(image[y, x])
                    total += value
                    squares += value * value
            mean = total / count
            n_others += squares / count - mean * mean >= sigma * sigma
            if n_others > _MAX_TEXTURED * rows * columns:
                return False
    return True


@kernel
def noise_sigma(image: Image) -> float:
    """Estimate the standard deviation of an image's noise in grey levels, at least that of rounding to whole ones.

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
    below = 0
    for value in range(_MAX_RESPONSE + 1):
        if below + histogram[value] > _QUANTILE * count:
            within = (_QUANTILE * count - below) / histogram[value]
            return float(max((value - 0.5 + within) / _GAIN, _ROUNDING))
        below += histogram[value]
    return _ROUNDING
