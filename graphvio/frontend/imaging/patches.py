"""Square patches of an image: their storage, gradients and correlation.

A patch of ``2 half + 1`` pixels on each side has rows that are padded with zeros to a multiple of `LANES`: loops over
its pixels then run in whole vector registers, and pixels of the compared image beyond a row have no weight. A patch
with a border, from which gradients are computed, has rows without padding, which would be half of it.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import AnyArray
from graphvio.kernels import fast_kernel

LANES = 16
"""Pixels that a vector register holds."""

_NOWHERE_PX2 = 1e6
_MIN_SQUARE = np.float32(1e-3)  # of a patch that is not flat
_ROUNDING = np.float32(1e-6)  # of a sum of squares
_ZERO, _HALF = np.float32(0.0), np.float32(0.5)


class Patch(NamedTuple):
    """One number for each pixel of a patch.

    Attributes:
        rows: (side, padded side).
        flat: the same numbers, row by row, a multiple of `LANES`.
    """

    rows: AnyArray
    flat: AnyArray


class Lattice(NamedTuple):
    """Coordinates of the pixels of all patches of one size.

    Attributes:
        columns: column of each pixel, counted from the middle.
        rows: row of each pixel, counted from the middle.
        inside: 1 for the patch's own pixels, 0 for the padding.
    """

    columns: Patch
    rows: Patch
    inside: Patch


@fast_kernel
def room(half: int) -> Patch:
    """Allocate a patch, all zero."""
    side = 2 * half + 1
    rows = np.zeros((side, (side + LANES - 1) // LANES * LANES), dtype=np.float32)
    return Patch(rows, rows.reshape(-1))


@fast_kernel
def bordered_room(half: int) -> Patch:
    """Allocate a patch with one more pixel on each side, all zero: rows without padding, and a register at the end."""
    side = 2 * half + 3
    flat = np.zeros((side * side + 2 * LANES - 1) // LANES * LANES, dtype=np.float32)
    return Patch(flat[: side * side].reshape((side, side)), flat)


@fast_kernel
def lattice(half: int) -> Lattice:
    """Build the lattice of patches of a size."""
    return _filled(Lattice(room(half), room(half), room(half)), half)


@fast_kernel
def bordered_lattice(half: int) -> Lattice:
    """Build the lattice of patches of a size with a border."""
    return _filled(Lattice(bordered_room(half), bordered_room(half), bordered_room(half)), half + 1)


@fast_kernel
def _filled(grid: Lattice, half: int) -> Lattice:
    for j in range(2 * half + 1):
        for i in range(2 * half + 1):
            grid.columns.rows[j, i], grid.rows.rows[j, i], grid.inside.rows[j, i] = i - half, j - half, 1.0
    return grid


class NormalEquations(NamedTuple):
    """Sums over a patch, independent of the image, for its alignment in images of other brightness and contrast.

    Attributes:
        xx: Gradient along the rows squared, summed: an element of the shift's normal matrix.
        xy: Gradient along the rows times that along the columns, summed; likewise.
        yy: Gradient along the columns squared, summed; likewise.
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
        bordered: the patch with one more pixel on each side, as allocated by `bordered_room`.
        inside: field of the patch's `Lattice`.
        patch: output, the patch without the border.
        gx: output, the gradient along the rows.
        gy: output, the gradient along the columns.
    """
    side, stride = patch.rows.shape
    pitch = side + 2
    for j in range(side):
        above, at, below = (
            bordered.flat[j * pitch :],
            bordered.flat[(j + 1) * pitch :],
            bordered.flat[(j + 2) * pitch :],
        )
        weights = inside.rows[j]
        values, dx, dy = patch.rows[j], gx.rows[j], gy.rows[j]
        for i in range(stride):  # whole registers: behind a row comes the next one, which has no weight
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
def weaker2(xx: float, xy: float, yy: float) -> float:
    """Compute the smaller eigenvalue of a normal matrix: the sum of squared gradients along their weaker direction."""
    return float(0.5 * (xx + yy - np.sqrt((xx - yy) * (xx - yy) + 4.0 * xy * xy)))


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

    Differences between patch and image other than contrast and brightness are taken for white noise. In a blurred
    image, the place along the blur is not determined: an iteration ends where it begins.

    Args:
        patch: the patch, of zero mean.
        other: the image at the patch's place, of zero mean.
        normal: normal equations of ``other``.
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
