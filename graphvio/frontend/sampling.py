"""Images between their pixels: patches sampled by a cubic B-spline, at any place and deformed by any linear map.

The pixels are the spline's coefficients (M. Unser, *Splines: a perfect fit for signal and image processing*, IEEE
Signal Processing Magazine 16(6), 1999): it smooths by 0.58 pixels, wherever between the pixels a place lies. Bilinear
interpolation smooths most in the middle between pixels and not at all at them, so that two patches of one surface
differ by where they lie: their alignment is then off by some 0.03 px, more than by the noise of a good image.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import AnyArray, Image
from graphvio.frontend.patches import Patch, room
from graphvio.kernels import fast_kernel, kernel

_ONE, _TWO, _HALF = np.float32(1.0), np.float32(2.0), np.float32(0.5)
_SIXTH, _TWO_THIRDS = np.float32(1.0 / 6.0), np.float32(2.0 / 3.0)
_NONE, _EIGHT, _SIXTEEN, _TWENTY_FOUR = np.uint32(0), np.uint32(8), np.uint32(16), np.uint32(24)
_BYTE = np.uint32(255)
_BEFORE, _LAST_WORD = np.int32(1), np.int32(2)  # pixels from the first of four to a place, and to the second word


class Scratch(NamedTuple):
    """Intermediate results of `sample_affine`, for each pixel of a patch.

    Attributes:
        places: of the upper left one of 4 x 4 pixels in the image's memory.
        right_of: fraction of a pixel, along the rows, beyond the second of them.
        below: the same along the columns.
        upper: the two upper rows of the 4 x 4 pixels, left and right half.
        lower: the two lower rows.
    """

    places: Patch
    right_of: Patch
    below: Patch
    upper: tuple[Patch, Patch]
    lower: tuple[Patch, Patch]


@fast_kernel
def _words(half: int) -> Patch:
    """Allocate one word for each pixel of a patch."""
    places = np.zeros(room(half).rows.shape, dtype=np.uint32)
    return Patch(places, places.reshape(-1))


@fast_kernel
def scratch_room(half: int) -> Scratch:
    """Allocate the intermediate results of `sample_affine`."""
    upper, lower = (_words(half), _words(half)), (_words(half), _words(half))
    return Scratch(_words(half), room(half), room(half), upper, lower)


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


def packed(image: Image) -> AnyArray:
    """Join each pixel (height, width) with those to its right, below, and to the right below, a byte each.

    What the spline needs is then four words. The last row and column are zero.
    """
    words = np.zeros(image.shape, dtype=np.uint32)
    pack(image, words)
    return words


@kernel
def pack(image: Image, words: AnyArray) -> None:
    """Fill the result of `packed`, except the last row and column."""
    height, width = image.shape
    for y in range(height - 1):
        upper, lower, row = image[y], image[y + 1], words[y]
        for x in range(width - 1):
            row[x] = (
                np.uint32(upper[x])
                | np.uint32(upper[x + 1]) << np.uint32(8)
                | np.uint32(lower[x]) << np.uint32(16)
                | np.uint32(lower[x + 1]) << np.uint32(24)
            )


@fast_kernel
def sample_affine(
    image: AnyArray, x: float, y: float, xx: float, xy: float, yx: float, yy: float, inside: Patch, scratch: Scratch,
    out: Patch,
) -> bool:  # fmt: skip
    """Fill a patch around (x, y) of a `packed` image; False where it leaves the image.

    The columns of ``[[xx, xy], [yx, yy]]`` are the steps in the image from pixel to pixel along the patch's rows and
    columns.
    """
    height, width = image.shape
    side, stride = out.rows.shape
    half = side // 2
    reach_x, reach_y = half * (abs(xx) + abs(xy)), half * (abs(yx) + abs(yy))
    if not (reach_x + 2 <= x < width - 3 - reach_x and reach_y + 2 <= y < height - 3 - reach_y):
        return False  # with a pixel to spare for rounding
    along_x, along_y = np.float32(xx), np.float32(yx)
    # Places are counted from the patch's own corner of the image, where single precision is fine enough.
    left, top = int(x - reach_x) - 1, int(y - reach_y) - 1
    flat = image.reshape(-1)[top * width + left :]
    pitch = np.int32(width)
    last = np.int32(flat.size - 1) - _LAST_WORD * pitch - _LAST_WORD
    for j in range(side):
        px = np.float32(x - left - half * xx + xy * (j - half))
        py = np.float32(y - top - half * yx + yy * (j - half))
        places, right_of, below = scratch.places.rows[j], scratch.right_of.rows[j], scratch.below.rows[j]
        for i in range(stride):
            at_x, at_y = px + along_x * np.float32(i), py + along_y * np.float32(i)
            x0, y0 = np.int32(at_x), np.int32(at_y)
            right_of[i], below[i] = at_x - np.float32(x0), at_y - np.float32(y0)
            place = pitch * (y0 - _BEFORE) + x0 - _BEFORE
            places[i] = np.uint32(max(min(place, last), np.int32(0)))  # in the padding they mean nothing
    _gather(flat, width, scratch)
    _interpolate(scratch, inside, out)
    return True


@fast_kernel
def _gather(flat: AnyArray, width: int, scratch: Scratch) -> None:
    """Fetch the 4 x 4 pixels of all places, a loop for each word: these become vector instructions."""
    places = scratch.places.flat
    left, right = scratch.upper[0].flat, scratch.upper[1].flat
    for k in range(places.size):
        left[k] = flat[places[k]]
    from_there = flat[2:]
    for k in range(places.size):
        right[k] = from_there[places[k]]
    left, right, from_there = scratch.lower[0].flat, scratch.lower[1].flat, flat[2 * width :]
    for k in range(places.size):
        left[k] = from_there[places[k]]
    from_there = flat[2 * width + 2 :]
    for k in range(places.size):
        right[k] = from_there[places[k]]


@fast_kernel
def _interpolate(scratch: Scratch, inside: Patch, out: Patch) -> None:
    """Fill a patch from the 4 x 4 pixels of all places."""
    right_of, below, weights, values = scratch.right_of.flat, scratch.below.flat, inside.flat, out.flat
    a, b, c, d = scratch.upper[0].flat, scratch.upper[1].flat, scratch.lower[0].flat, scratch.lower[1].flat
    for k in range(values.size):
        a0, a1, a2, a3 = spline_weights(right_of[k])
        b0, b1, b2, b3 = spline_weights(below[k])
        q0, q1 = _rows_of_words(a[k], b[k], a0, a1, a2, a3)
        q2, q3 = _rows_of_words(c[k], d[k], a0, a1, a2, a3)
        values[k] = weights[k] * (b0 * q0 + b1 * q1 + b2 * q2 + b3 * q3)


@fast_kernel
def _rows_of_words(
    left: np.uint32, right: np.uint32, a0: np.float32, a1: np.float32, a2: np.float32, a3: np.float32
) -> tuple[np.float32, np.float32]:
    """Interpolate the two rows of 2 x 4 pixels, which two words hold."""
    upper = a0 * _byte(left, _NONE) + a1 * _byte(left, _EIGHT) + a2 * _byte(right, _NONE) + a3 * _byte(right, _EIGHT)
    lower = a0 * _byte(left, _SIXTEEN) + a1 * _byte(left, _TWENTY_FOUR)
    return upper, lower + a2 * _byte(right, _SIXTEEN) + a3 * _byte(right, _TWENTY_FOUR)


@fast_kernel
def _byte(word: np.uint32, shift: np.uint32) -> np.float32:
    return np.float32(np.int32(word >> shift & _BYTE))
