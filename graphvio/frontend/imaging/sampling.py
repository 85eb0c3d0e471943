"""Sub-pixel sampling: patches of an image by a cubic B-spline, at any place and deformed by any linear map.

The pixels are the spline's coefficients (M. Unser, *Splines: a perfect fit for signal and image processing*, IEEE
Signal Processing Magazine 16(6), 1999): it smooths by 0.58 pixels, wherever between the pixels a place lies. Bilinear
interpolation smooths most in the middle between pixels and not at all at them, so that two patches of one surface
differ only because they lie at different fractions of a pixel: their alignment is then off by some 0.03 px, more than
by the noise of a good image.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import AnyArray, Image
from graphvio.frontend.imaging.patches import Lattice, Patch
from graphvio.kernels import fast_kernel

_ONE, _TWO, _HALF = np.float32(1.0), np.float32(2.0), np.float32(0.5)
_SIXTH, _TWO_THIRDS = np.float32(1.0 / 6.0), np.float32(2.0 / 3.0)
_NONE, _EIGHT, _SIXTEEN, _TWENTY_FOUR = np.uint32(0), np.uint32(8), np.uint32(16), np.uint32(24)
_BYTE = np.uint32(255)


class Scratch(NamedTuple):
    """Intermediate results of `sample_affine`, for each of the N pixels of a patch.

    Attributes:
        places: (N,) index in the image's memory of the upper left one of 4 x 4 pixels.
        right_of: (N,) fraction of a pixel, along the rows, beyond the second of them.
        below: (N,) the same along the columns.
        words: (4, N) the rows of the 4 x 4 pixels.
    """

    places: AnyArray
    right_of: AnyArray
    below: AnyArray
    words: AnyArray


@fast_kernel
def scratch_room(grid: Lattice) -> Scratch:
    """Allocate the intermediate results of `sample_affine` for patches with a lattice."""
    n = grid.inside.flat.size
    fractions = np.zeros((2, n), dtype=np.float32)
    places, words = np.zeros(n, dtype=np.uint32), np.zeros((4, n), dtype=np.uint32)
    return Scratch(places, fractions[0], fractions[1], words)


@fast_kernel
def spline_weights(fraction: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Compute the weights of four pixels in a row, for a place that is a fraction of a pixel beyond the second."""
    f, g = fraction, _ONE - fraction
    f2, g2 = f * f, g * g
    second, third = _TWO_THIRDS - _HALF * f2 * (_TWO - f), _TWO_THIRDS - _HALF * g2 * (_TWO - g)
    return _SIXTH * g2 * g, second, third, _SIXTH * f2 * f


@fast_kernel
def sample(image: Image, x: float, y: float, half: int, out: Patch) -> bool:
    """Fill a patch around (x, y), but not its padding; False where it leaves the image."""
    height, width = image.shape
    if not (half + 1 <= x < width - half - 2 and half + 1 <= y < height - half - 2):
        return False
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    a0, a1, a2, a3 = spline_weights(np.float32(x - x0))
    b0, b1, b2, b3 = spline_weights(np.float32(y - y0))
    side = 2 * half + 1
    left, top = x0 - half - 1, y0 - half - 1
    for j in range(side):
        r0, r1 = image[top + j, left : left + side + 3], image[top + j + 1, left : left + side + 3]
        r2, r3 = image[top + j + 2, left : left + side + 3], image[top + j + 3, left : left + side + 3]
        for i in range(side):
            q0, q1 = interpolated_row(r0, i, a0, a1, a2, a3), interpolated_row(r1, i, a0, a1, a2, a3)
            q2, q3 = interpolated_row(r2, i, a0, a1, a2, a3), interpolated_row(r3, i, a0, a1, a2, a3)
            out.rows[j, i] = b0 * q0 + b1 * q1 + b2 * q2 + b3 * q3
    return True


@fast_kernel
def interpolated_row(row: Image, i: int, a0: np.float32, a1: np.float32, a2: np.float32, a3: np.float32) -> np.float32:
    """Interpolate four pixels of a row, the first of which is its i-th."""
    near = a1 * np.float32(row[i + 1]) + a2 * np.float32(row[i + 2])
    return near + a0 * np.float32(row[i]) + a3 * np.float32(row[i + 3])


class PixelWords(NamedTuple):
    """An image as words of four pixels in a row, as many as the spline needs of a row.

    One instruction fetches such words from sixteen places; with pixels fetched one by one, sampling took most of the
    time.

    Attributes:
        words: (height * width - 3,) little-endian, one beginning at each pixel; they overlap in the image's memory.
        height: height of the image.
        width: width of the image.
    """

    words: AnyArray
    height: int
    width: int


def pixel_words(image: Image) -> PixelWords:
    """Return a view of an image (height, width) as words."""
    pixels = np.ascontiguousarray(image)
    words = np.ndarray((pixels.size - 3,), np.dtype("<u4"), pixels.data, strides=(1,))
    return PixelWords(words, *image.shape)


@fast_kernel
def sample_affine(
    image: PixelWords, x: float, y: float, xx: float, xy: float, yx: float, yy: float, grid: Lattice, scratch: Scratch,
    out: Patch,
) -> bool:  # fmt: skip
    """Fill a patch around (x, y); False where it leaves the image.

    The columns of ``[[xx, xy], [yx, yy]]`` are the steps in the image from pixel to pixel along the patch's rows and
    columns.
    """
    height, width = image.height, image.width
    half = len(out.rows) // 2
    reach_x, reach_y = half * (abs(xx) + abs(xy)), half * (abs(yx) + abs(yy))
    if not (reach_x + 2 <= x < width - 3 - reach_x and reach_y + 2 <= y < height - 3 - reach_y):
        return False  # with a pixel to spare for rounding
    # Places are counted from the patch's own corner of the image, where single precision is fine enough.
    left, top = max(int(x - reach_x) - 2, 0), max(int(y - reach_y) - 2, 0)
    middle_x, middle_y = np.float32(x - left - 1), np.float32(y - top - 1)
    a, b, c, d = np.float32(xx), np.float32(xy), np.float32(yx), np.float32(yy)
    pitch = np.int32(width)
    columns, rows, places = grid.columns.flat, grid.rows.flat, scratch.places
    right_of, below = scratch.right_of, scratch.below
    for k in range(places.size):  # padding has coordinates of 0, so it takes the middle
        at_x, at_y = middle_x + a * columns[k] + b * rows[k], middle_y + c * columns[k] + d * rows[k]
        x0, y0 = np.int32(at_x), np.int32(at_y)
        right_of[k], below[k] = at_x - np.float32(x0), at_y - np.float32(y0)
        places[k] = np.uint32(pitch * y0 + x0)
    for row in range(4):  # a loop for each of them: these become vector instructions
        from_there, words = image.words[(top + row) * width + left :], scratch.words[row]
        for k in range(places.size):
            words[k] = from_there[places[k]]
    _interpolate(scratch, grid.inside, out)
    return True


@fast_kernel
def _interpolate(scratch: Scratch, inside: Patch, out: Patch) -> None:
    """Fill a patch from the 4 x 4 pixels of all places."""
    right_of, below, weights, values = scratch.right_of, scratch.below, inside.flat, out.flat
    r0, r1, r2, r3 = scratch.words[0], scratch.words[1], scratch.words[2], scratch.words[3]
    for k in range(values.size):
        a0, a1, a2, a3 = spline_weights(right_of[k])
        b0, b1, b2, b3 = spline_weights(below[k])
        q0, q1 = _interpolated_word(r0[k], a0, a1, a2, a3), _interpolated_word(r1[k], a0, a1, a2, a3)
        q2, q3 = _interpolated_word(r2[k], a0, a1, a2, a3), _interpolated_word(r3[k], a0, a1, a2, a3)
        values[k] = weights[k] * (b0 * q0 + b1 * q1 + b2 * q2 + b3 * q3)


@fast_kernel
def _interpolated_word(word: np.uint32, a0: np.float32, a1: np.float32, a2: np.float32, a3: np.float32) -> np.float32:
    """Interpolate four pixels of a row."""
    near = a1 * _byte(word, _EIGHT) + a2 * _byte(word, _SIXTEEN)
    return near + a0 * _byte(word, _NONE) + a3 * _byte(word, _TWENTY_FOUR)


@fast_kernel
def _byte(word: np.uint32, shift: np.uint32) -> np.float32:
    return np.float32(np.int32(word >> shift & _BYTE))
