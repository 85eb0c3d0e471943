"""Harris corners, one in each cell of the image that has no track (section 3 and its reference [5])."""

import numpy as np

from graphvio.arrays import AnyArray, Bool, Float, Image
from graphvio.kernels import fast_kernel, kernel, put

_HARRIS_K = 0.04
_RADIUS = 3  # of the 7x7 window over which gradients are summed
_BORDER = 2  # around a cell: one pixel to smooth the response, one to check that it peaks
_LANES = 32  # numbers that a loop takes at once


@kernel
def occupied_cells(pixels: Float, cell_px: int, rows: int, columns: int) -> Bool:
    """Mark the cells (rows, columns) that hold at least one of the pixels (N, 2)."""
    occupied = np.zeros((rows, columns), dtype=np.bool_)
    for i in range(len(pixels)):
        row = int(pixels[i, 1]) // cell_px
        column = int(pixels[i, 0]) // cell_px
        if 0 <= row < rows and 0 <= column < columns:
            occupied[row, column] = True
    return occupied


@kernel
def thinned(pixels: Float, found: Bool, cell_px: int, most: int) -> Bool:
    """Select the found tracks (N,) that are kept: of each cell, only the first ``most``."""
    keep = np.zeros(len(pixels), dtype=np.bool_)
    rows = columns = 1
    for i in np.flatnonzero(found):
        rows = max(rows, int(pixels[i, 1]) // cell_px + 1)
        columns = max(columns, int(pixels[i, 0]) // cell_px + 1)
    taken = np.zeros((rows, columns), dtype=np.int64)
    for i in np.flatnonzero(found):
        row, column = int(pixels[i, 1]) // cell_px, int(pixels[i, 0]) // cell_px
        taken[row, column] += 1
        keep[i] = taken[row, column] <= most
    return keep


@kernel
def find_corners(
    image: Image, allowed: Bool, tracked: Float, occupying: Bool, cell_px: int, border_px: int, min_response: float
) -> Float:
    """Find the strongest Harris corner of each cell that no track occupies, to sub-pixel precision.

    Args:
        image: (height, width) the image.
        allowed: (height, width), False where the image must not be used.
        tracked: (N, 2) pixels that are tracked already; a new corner keeps half a cell of distance to them.
        occupying: (N,) which of them occupy their cell, so that it gets no other corner.
        cell_px: side of a cell.
        border_px: width of the margin without corners.
        min_response: smallest rms gradient along a corner's weaker direction, grey levels per pixel.

    Returns:
        Pixels (M, 2).
    """
    height, width = image.shape
    rows, columns = (height + cell_px - 1) // cell_px, (width + cell_px - 1) // cell_px
    occupied = occupied_cells(tracked[occupying], cell_px, rows, columns)
    margin = max(border_px, _RADIUS + _BORDER + 1)
    found = np.empty((rows * columns + len(tracked), 2))
    put(found[: len(tracked)], tracked)
    near = np.empty_like(found)
    count = len(tracked)
    side = cell_px + 2 * _BORDER
    stride = side + 4 * _RADIUS + _LANES
    lines = np.empty((2 * _RADIUS + 1, 3, stride), dtype=np.float32)
    sums = np.empty((5, stride), dtype=np.float32)
    raw, smooth, weaker2 = (
        np.empty((side, stride), dtype=np.float32),
        np.empty((side, stride), dtype=np.float32),
        np.empty((side, stride), dtype=np.float32),
    )
    for row in range(rows):
        for column in range(columns):
            if occupied[row, column]:
                continue
            x0, x1 = max(margin, column * cell_px), min(width - margin, (column + 1) * cell_px)
            y0, y1 = max(margin, row * cell_px), min(height - margin, (row + 1) * cell_px)
            if x1 - x0 < 3 or y1 - y0 < 3:
                continue
            high, wide = y1 - y0 + 2 * _BORDER, x1 - x0 + 2 * _BORDER
            _harris(image, x0 - _BORDER, y0 - _BORDER, high, wide, lines, sums, raw, weaker2)
            _smooth(raw, high, wide, smooth)
            neighbours = _within(found[:count], x0, y0, x1, y1, 0.5 * cell_px, near)
            x, y = _strongest(
                smooth, weaker2, min_response * min_response, allowed, x0, y0, x1, y1, near[:neighbours], 0.5 * cell_px
            )
            if x < 0 or not _is_peak(smooth, x, y):
                continue
            at = smooth[y, x]
            found[count, 0] = x0 - _BORDER + x + _peak_offset(smooth[y, x - 1], at, smooth[y, x + 1])
            found[count, 1] = y0 - _BORDER + y + _peak_offset(smooth[y - 1, x], at, smooth[y + 1, x])
            count += 1
    return found[len(tracked) : count]


@fast_kernel
def _harris(
    image: Image, x0: int, y0: int, high: int, wide: int, lines: AnyArray, sums: AnyArray,
    response: AnyArray, weaker2: AnyArray,
) -> None:  # fmt: skip
    """Fill the Harris response, and the mean square gradient along the weaker direction, from pixel (x0, y0) on.

    Sums over the window's columns are carried from row to row; all numbers in them are exact in single precision. Loops
    go on to a multiple of what vector instructions take at once, since rows are short; numbers beyond are meaningless.
    """
    area = np.float32((2 * _RADIUS + 1) ** 2)
    half, k = np.float32(0.5), np.float32(_HARRIS_K)
    whole = (wide + 2 * _RADIUS + _LANES - 1) // _LANES * _LANES
    left = x0 - _RADIUS
    end = min(left + whole, image.shape[1] - 1)
    sums[:, :] = np.float32(0.0)
    lines[:, :, :] = np.float32(0.0)
    sxx, sxy, syy, gx, gy = sums[0], sums[1], sums[2], sums[3], sums[4]
    for j in range(high + 2 * _RADIUS):
        y = y0 - _RADIUS + j
        line = lines[j % (2 * _RADIUS + 1)]
        xx, xy, yy = line[0], line[1], line[2]
        _difference(image[y, left + 1 : end + 1], image[y, left - 1 : end - 1], gx)
        _difference(image[y + 1, left:end], image[y - 1, left:end], gy)
        _replace(gx, gx, whole, xx, sxx)  # one loop for all would have too many arrays for vector instructions
        _replace(gx, gy, whole, xy, sxy)
        _replace(gy, gy, whole, yy, syy)
        if j < 2 * _RADIUS:
            continue
        strength, weaker = response[j - 2 * _RADIUS], weaker2[j - 2 * _RADIUS]
        for i in range(whole):
            a = b = c = np.float32(0.0)
            for shift in range(2 * _RADIUS + 1):
                a += sxx[i + shift]
                b += sxy[i + shift]
                c += syy[i + shift]
            a, b, c = a / area, b / area, c / area
            strength[i] = a * c - b * b - k * (a + c) * (a + c)
            weaker[i] = half * (a + c - np.sqrt((a - c) * (a - c) + np.float32(4.0) * b * b))


@fast_kernel
def _difference(one: Image, other: Image, out: AnyArray) -> None:
    """Fill half the difference of two lines of pixels."""
    half = np.float32(0.5)
    for i in range(len(one)):
        out[i] = half * (np.float32(one[i]) - np.float32(other[i]))


@fast_kernel
def _replace(one: AnyArray, other: AnyArray, size: int, line: AnyArray, sums: AnyArray) -> None:
    """Fill a line of products in place of the one that leaves the window, and keep the columns' sums up to date."""
    for i in range(size):
        product = one[i] * other[i]
        sums[i] += product - line[i]
        line[i] = product


@fast_kernel
def _smooth(response: AnyArray, high: int, wide: int, smooth: AnyArray) -> None:
    """Fill the smoothed response, because a box window leaves it level over several pixels around a corner."""
    two, scale = np.float32(2.0), np.float32(1.0 / 16.0)
    for j in range(1, high - 1):
        above, at, below, out = response[j - 1], response[j], response[j + 1], smooth[j]
        for i in range(1, wide - 1):
            out[i] = scale * (
                (above[i - 1] + two * at[i - 1] + below[i - 1])
                + two * (above[i] + two * at[i] + below[i])
                + (above[i + 1] + two * at[i + 1] + below[i + 1])
            )


@kernel
def _within(pixels: Float, x0: int, y0: int, x1: int, y1: int, distance: float, near: Float) -> int:
    """Fill ``near`` with the pixels (N, 2) that are nearer than a distance to the rectangle; return their number."""
    count = 0
    for i in range(len(pixels)):
        x, y = pixels[i, 0], pixels[i, 1]
        if x0 - distance < x < x1 + distance and y0 - distance < y < y1 + distance:
            near[count, 0], near[count, 1] = x, y
            count += 1
    return count


@kernel
def _strongest(
    response: AnyArray, weaker2: AnyArray, least2: float, allowed: Bool, x0: int, y0: int, x1: int, y1: int,
    near: Float, distance: float,
) -> tuple[int, int]:  # fmt: skip
    """Find column and row of the largest response that is allowed and keeps its distance, or (-1, -1)."""
    best, bx, by = np.float32(0.0), -1, -1
    least_distance2 = distance * distance
    for y in range(_BORDER, y1 - y0 + _BORDER):
        for x in range(_BORDER, x1 - x0 + _BORDER):
            if response[y, x] <= best or weaker2[y, x] <= least2:
                continue
            px, py = x0 - _BORDER + x, y0 - _BORDER + y
            if allowed[py, px] and _distance2(near, px, py) >= least_distance2:
                best, bx, by = response[y, x], x, y
    return bx, by


@kernel
def _distance2(pixels: Float, x: float, y: float) -> float:
    """Compute the squared distance from (x, y) to the nearest of pixels (N, 2)."""
    least = np.inf
    for i in range(len(pixels)):
        dx, dy = pixels[i, 0] - x, pixels[i, 1] - y
        least = min(least, dx * dx + dy * dy)
    return least


@kernel
def _is_peak(response: AnyArray, x: int, y: int) -> bool:
    """Check that no neighbour is greater, as one would be on the slope towards a corner of the next cell."""
    for j in range(-1, 2):
        for i in range(-1, 2):
            if response[y + j, x + i] > response[y, x]:
                return False
    return True


@kernel
def _peak_offset(before: float, at: float, after: float) -> float:
    """Compute where a parabola through three values peaks, from the middle one, within half a pixel."""
    curvature = before - 2.0 * at + after
    if curvature >= 0.0:
        return 0.0
    return min(max(0.5 * (before - after) / curvature, -0.5), 0.5)
