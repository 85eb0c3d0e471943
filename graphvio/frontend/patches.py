"""Square patches of an image: sampled with sub-pixel precision, compared with each other, and aligned.

A patch of ``2 half + 1`` pixels on each side has rows that are padded with zeros to a multiple of `LANES`: loops over
its pixels then run in whole vector registers, and the padding of the image that it is compared with has no weight.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import AnyArray, Image
from graphvio.kernels import fast_kernel, kernel

LANES = 16
"""Pixels that a vector register holds."""

_MIN_CONTRAST, _MAX_CONTRAST = 0.4, 2.5  # of an image over that of a patch, as far as it is believed
_SAME_CONTRAST = 1.25  # a smaller ratio is taken for 1
_NOWHERE_PX2 = 1e6
_MAX_ITERATIONS = 20
_CONVERGED_PX = 0.03  # the step is still taken, after which the error is several times smaller
_MIN_SQUARE = np.float32(1e-3)  # of a patch that is not flat
_ROUNDING = np.float32(1e-6)  # of a sum of squares
_ONE, _ZERO, _HALF = np.float32(1.0), np.float32(0.0), np.float32(0.5)


class Patch(NamedTuple):
    """One number for each pixel of a patch.

    Attributes:
        rows: (side, padded side).
        flat: the same numbers, row by row.
    """

    rows: AnyArray
    flat: AnyArray


class Lattice(NamedTuple):
    """Coordinates of the pixels of all patches of one size.

    Attributes:
        columns: counted from the middle.
        rows: counted from the middle.
        inside: 1 for the patch's own pixels, 0 for the padding.
    """

    columns: Patch
    rows: Patch
    inside: Patch


class Scratch(NamedTuple):
    """Sampling places of a deformed patch: positions in the image's memory, and fractions of a pixel beyond them."""

    places: Patch
    right_of: Patch
    below: Patch


@fast_kernel
def room(half: int) -> Patch:
    """Allocate a patch, all zero."""
    side = 2 * half + 1
    rows = np.zeros((side, (side + LANES - 1) // LANES * LANES), dtype=np.float32)
    return Patch(rows, rows.reshape(-1))


@fast_kernel
def scratch_room(half: int) -> Scratch:
    """Allocate the intermediate results of `sample_affine`."""
    places = np.zeros(room(half).rows.shape, dtype=np.uint32)
    return Scratch(Patch(places, places.reshape(-1)), room(half), room(half))


@fast_kernel
def lattice(half: int) -> Lattice:
    """Build the lattice of patches of a size."""
    columns, rows, inside = room(half), room(half), room(half)
    for j in range(2 * half + 1):
        for i in range(2 * half + 1):
            columns.rows[j, i], rows.rows[j, i], inside.rows[j, i] = i - half, j - half, 1.0
    return Lattice(columns, rows, inside)


@fast_kernel
def sample(image: Image, x: float, y: float, half: int, out: Patch) -> bool:
    """Fill a patch around (x, y) by bilinear interpolation, but not its padding; False where it leaves the image."""
    height, width = image.shape
    if not (half <= x < width - half - 1 and half <= y < height - half - 1):
        return False
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    ax, ay = np.float32(x - x0), np.float32(y - y0)
    w00, w01, w10, w11 = (_ONE - ax) * (_ONE - ay), ax * (_ONE - ay), (_ONE - ax) * ay, ax * ay
    side = 2 * half + 1
    left, top = x0 - half, y0 - half
    for j in range(side):
        upper = image[top + j, left : left + side + 1]
        lower = image[top + j + 1, left : left + side + 1]
        for i in range(side):
            out.rows[j, i] = (
                w00 * np.float32(upper[i])
                + w01 * np.float32(upper[i + 1])
                + w10 * np.float32(lower[i])
                + w11 * np.float32(lower[i + 1])
            )
    return True


class NormalEquations(NamedTuple):
    """What a patch has for its alignment in an image of another brightness and contrast, apart from the image.

    Attributes:
        xx: Of the normal matrix of the shift.
        xy: Likewise.
        yy: Likewise.
        px: Gradient along the rows times the patch, summed.
        py: Gradient along the columns times the patch, summed.
        pp: The patch times itself, summed.
    """

    xx: float
    xy: float
    yy: float
    px: float
    py: float
    pp: float


@fast_kernel
def prepare(bordered: Patch, inside: Patch, patch: Patch, gx: Patch, gy: Patch) -> NormalEquations:
    """Fill a patch and its gradients, all of zero mean, and return its normal equations.

    Args:
        bordered: the patch with one more pixel on each side.
        inside: of the patch's `Lattice`.
        patch: output.
        gx: output, along the rows.
        gy: output, along the columns.
    """
    side, stride = patch.rows.shape
    columns = min(stride, bordered.rows.shape[1] - 2)  # whole registers, as far as the bordered patch reaches
    for j in range(side):
        above, at, below, weights = bordered.rows[j], bordered.rows[j + 1], bordered.rows[j + 2], inside.rows[j]
        values, dx, dy = patch.rows[j], gx.rows[j], gy.rows[j]
        for i in range(columns):
            values[i] = weights[i] * at[i + 1]
            dx[i] = weights[i] * _HALF * (at[i + 2] - at[i])
            dy[i] = weights[i] * _HALF * (below[i + 1] - above[i + 1])
    mean = mean_x = mean_y = _ZERO
    flat, flat_x, flat_y, weights = patch.flat, gx.flat, gy.flat, inside.flat
    for k in range(flat.size):
        mean += flat[k]
        mean_x += flat_x[k]
        mean_y += flat_y[k]
    area = np.float32(side * side)
    mean /= area
    mean_x /= area
    mean_y /= area
    xx = xy = yy = px = py = pp = _ZERO
    for k in range(flat.size):
        flat[k] -= weights[k] * mean
        flat_x[k] -= weights[k] * mean_x
        flat_y[k] -= weights[k] * mean_y
        xx += flat_x[k] * flat_x[k]
        xy += flat_x[k] * flat_y[k]
        yy += flat_y[k] * flat_y[k]
        px += flat_x[k] * flat[k]
        py += flat_y[k] * flat[k]
        pp += flat[k] * flat[k]
    return NormalEquations(float(xx), float(xy), float(yy), float(px), float(py), float(max(pp, _MIN_SQUARE)))


@fast_kernel
def mismatch(image: Image, u: float, v: float, patch: Patch, gx: Patch, gy: Patch) -> tuple[float, float, float, bool]:
    """Sum gradients and patch times the difference between the image at (u, v) and the patch; False outside the image.

    All three have zero mean, so a constant difference of brightness contributes nothing.
    """
    height, width = image.shape
    side, stride = patch.rows.shape
    half = side // 2
    if not (half <= u < width - half - 1 and half <= v < height - half - 1):
        return 0.0, 0.0, 0.0, False
    x0, y0 = int(np.floor(u)), int(np.floor(v))
    first = (y0 - half) * width + x0 - half
    if first + side * width + stride >= height * width:
        return 0.0, 0.0, 0.0, False  # the padding of the lowest row would read on beyond the image's end
    ax, ay = np.float32(u - x0), np.float32(v - y0)
    w00, w01, w10, w11 = (_ONE - ax) * (_ONE - ay), ax * (_ONE - ay), (_ONE - ax) * ay, ax * ay
    flat = image.reshape(-1)
    bx = by = bp = _ZERO
    for j in range(side):
        for k in range(0, stride, LANES):
            start = first + j * width + k
            upper, lower = flat[start : start + LANES + 1], flat[start + width : start + width + LANES + 1]
            values, dx, dy = patch.rows[j, k : k + LANES], gx.rows[j, k : k + LANES], gy.rows[j, k : k + LANES]
            row_x = row_y = row_p = _ZERO  # separate sums: a row need not wait for the one before
            for i in range(LANES):
                difference = (
                    w00 * np.float32(upper[i])
                    + w01 * np.float32(upper[i + 1])
                    + w10 * np.float32(lower[i])
                    + w11 * np.float32(lower[i + 1])
                    - values[i]
                )
                row_x += dx[i] * difference
                row_y += dy[i] * difference
                row_p += values[i] * difference
            bx += row_x
            by += row_y
            bp += row_p
    return float(bx), float(by), float(bp), True


@fast_kernel
def different_contrast(ratio: float) -> float:
    """Return the contrast of an image over that of a patch, or 1 where they are nearly the same.

    To estimate it costs precision, which is lost for nothing where both images are exposed alike: a patch that is seen
    larger, or slanted otherwise, seems to have another contrast, too.
    """
    if 1.0 / _SAME_CONTRAST < ratio < _SAME_CONTRAST:
        return 1.0
    return min(max(ratio, _MIN_CONTRAST), _MAX_CONTRAST)


@fast_kernel
def align(
    image: Image, u: float, v: float, patch: Patch, gx: Patch, gy: Patch, normal: NormalEquations, min_gradient: float,
    is_other_camera: bool,
) -> tuple[float, float, bool]:  # fmt: skip
    """Find a patch in an image by Gauss-Newton from (u, v); the flag says whether the iteration converged.

    The image may have another brightness, and that of another camera another contrast, which is estimated with the
    shift if it clearly differs. A patch whose rms gradient along the weaker direction is less than ``min_gradient`` is
    not localised.
    """
    xx, xy, yy = normal.xx, normal.xy, normal.yy
    if weaker2(xx, xy, yy) < min_gradient * min_gradient * len(patch.rows) ** 2:
        return u, v, False
    determinant = xx * yy - xy * xy
    for _ in range(_MAX_ITERATIONS):
        bx, by, bp, inside = mismatch(image, u, v, patch, gx, gy)
        if not inside:
            break
        if is_other_camera:
            gain = different_contrast(1.0 + bp / normal.pp)
            bx, by = (bx - (gain - 1.0) * normal.px) / gain, (by - (gain - 1.0) * normal.py) / gain
        step_u = (yy * bx - xy * by) / determinant
        step_v = (xx * by - xy * bx) / determinant
        u -= step_u
        v -= step_v
        if step_u * step_u + step_v * step_v < _CONVERGED_PX * _CONVERGED_PX:
            return u, v, True
    return u, v, False


@fast_kernel
def weaker2(xx: float, xy: float, yy: float) -> float:
    """Compute the smaller eigenvalue of a normal matrix: the sum of squared gradients along their weaker direction."""
    return float(0.5 * (xx + yy - np.sqrt((xx - yy) * (xx - yy) + 4.0 * xy * xy)))


def packed(image: Image) -> AnyArray:
    """Join each pixel (height, width) with those to its right, below, and to the right below, a byte each.

    What bilinear interpolation needs is then one word. The last row and column are zero.
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
    if not (reach_x + 1 <= x < width - 2 - reach_x and reach_y + 1 <= y < height - 2 - reach_y):
        return False  # with a pixel to spare for rounding
    along_x, along_y = np.float32(xx), np.float32(yx)
    # Places are counted from the patch's own corner of the image, where single precision is fine enough.
    left, top = int(x - reach_x), int(y - reach_y)
    flat = image.reshape(-1)[top * width + left :]
    pitch, last = np.int32(width), np.int32(flat.size - 1)
    for j in range(side):
        px = np.float32(x - left - half * xx + xy * (j - half))
        py = np.float32(y - top - half * yx + yy * (j - half))
        places, right_of, below = scratch.places.rows[j], scratch.right_of.rows[j], scratch.below.rows[j]
        for i in range(stride):
            at_x, at_y = px + along_x * np.float32(i), py + along_y * np.float32(i)
            x0, y0 = np.int32(at_x), np.int32(at_y)
            right_of[i], below[i] = at_x - np.float32(x0), at_y - np.float32(y0)
            places[i] = np.uint32(max(min(pitch * y0 + x0, last), np.int32(0)))  # in the padding they mean nothing
    words, right_of, below = scratch.places.flat, scratch.right_of.flat, scratch.below.flat
    for k in range(words.size):
        words[k] = flat[words[k]]
    weights, values, eight, byte = inside.flat, out.flat, np.uint32(8), np.uint32(255)
    for k in range(words.size):
        word = words[k]
        a, b = np.float32(np.int32(word & byte)), np.float32(np.int32(word >> eight & byte))
        c, d = np.float32(np.int32(word >> (eight + eight) & byte)), np.float32(np.int32(word >> np.uint32(24)))
        upper, lower = a + right_of[k] * (b - a), c + right_of[k] * (d - c)
        values[k] = weights[k] * (upper + below[k] * (lower - upper))
    return True


@fast_kernel
def correlation(patch: Patch, other: Patch) -> float:
    """Compute the normalised cross-correlation of a patch of zero mean with another."""
    a, b = patch.flat, other.flat
    product = square = total = own = _ZERO
    for k in range(a.size):
        product += a[k] * b[k]
        square += b[k] * b[k]
        total += b[k]
        own += a[k] * a[k]
    variance = square - total * total / np.float32(len(patch.rows) ** 2)
    if variance < max(_MIN_SQUARE, _ROUNDING * square) or own < _MIN_SQUARE:
        return -1.0
    return float(product / np.sqrt(float(variance) * float(own)))


@fast_kernel
def localisation2(patch: Patch, other: Patch, normal: NormalEquations) -> float:
    """Compute the variance of a patch's place in an image along the weaker direction, square pixels.

    Differences between patch and image other than contrast and brightness are taken for white noise. A blurred image
    leaves a place free along the blur: an iteration that begins there ends there.

    Args:
        patch: of zero mean.
        other: the image at the patch's place, of zero mean.
        normal: of ``other``.
    """
    a, b = patch.flat, other.flat
    product = own = square = _ZERO
    for k in range(a.size):
        product += a[k] * b[k]
        own += a[k] * a[k]
        square += b[k] * b[k]
    weaker = weaker2(normal.xx, normal.xy, normal.yy)
    if own < 1e-3 or weaker < 1e-3:
        return _NOWHERE_PX2
    return float(square - product * product / own) / (weaker * len(patch.rows) ** 2)
