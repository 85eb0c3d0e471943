"""Harris corners, one in each cell that has no track (section 3 and its reference [5])."""

import numpy as np

from graphvio.arrays import Bool, Float, Image
from graphvio.kernels import kernel

_HARRIS_K = 0.04
_RADIUS = 3  # of the 7x7 window over which gradients are summed


@kernel
def occupied_cells(pixels: Float, cell_px: int, rows: int, columns: int) -> Bool:
    """Which cells (rows, columns) hold at least one of the pixels (N, 2)."""
    occupied = np.zeros((rows, columns), dtype=np.bool_)
    for i in range(len(pixels)):
        row = int(pixels[i, 1]) // cell_px
        column = int(pixels[i, 0]) // cell_px
        if 0 <= row < rows and 0 <= column < columns:
            occupied[row, column] = True
    return occupied


@kernel
def find_corners(
    image: Image,
    allowed: Bool,
    tracked: Float,
    settled: Bool,
    cell_px: int,
    border_px: int,
    min_response: float,
) -> Float:
    """The strongest Harris corner of each cell without a settled track, to sub-pixel precision.

    Args:
        image: (height, width).
        allowed: (height, width), False where the image must not be used.
        tracked: (N, 2) pixels that are tracked already; a new corner keeps half a cell of distance to them.
        settled: (N,) which of them are good enough for their cell to need no other.
        cell_px: side of a cell.
        border_px: width of the margin without corners.
        min_response: least rms gradient, in grey levels per pixel, along a corner's weaker direction.

    Returns:
        Pixels (M, 2).
    """
    height, width = image.shape
    rows, columns = (height + cell_px - 1) // cell_px, (width + cell_px - 1) // cell_px
    occupied = occupied_cells(tracked[settled], cell_px, rows, columns)
    margin = max(border_px, _RADIUS + 2)
    found = np.empty((rows * columns + len(tracked), 2))
    found[: len(tracked)] = tracked
    count = len(tracked)
    least_distance2 = 0.25 * cell_px * cell_px
    for row in range(rows):
        for column in range(columns):
            if occupied[row, column]:
                continue
            x0, x1 = max(margin, column * cell_px), min(width - margin, (column + 1) * cell_px)
            y0, y1 = max(margin, row * cell_px), min(height - margin, (row + 1) * cell_px)
            if x1 - x0 < 3 or y1 - y0 < 3:
                continue
            response, weaker = _harris(image, x0 - 1, y0 - 1, x1 + 1, y1 + 1)
            best, bx, by = 0.0, -1, -1
            for y in range(1, y1 - y0 + 1):
                for x in range(1, x1 - x0 + 1):
                    r = response[y, x]
                    if r <= best or weaker[y, x] <= min_response or not allowed[y0 - 1 + y, x0 - 1 + x]:
                        continue
                    if _distance2(found[:count], x0 - 1.0 + x, y0 - 1.0 + y) >= least_distance2:
                        best, bx, by = r, x, y
            if bx < 0 or not _is_peak(response, bx, by):
                continue
            px = x0 - 1 + bx + _peak_offset(response[by, bx - 1], best, response[by, bx + 1])
            py = y0 - 1 + by + _peak_offset(response[by - 1, bx], best, response[by + 1, bx])
            found[count, 0], found[count, 1] = px, py
            count += 1
    return found[len(tracked) : count]


@kernel
def _distance2(pixels: Float, x: float, y: float) -> float:
    """Squared distance from (x, y) to the nearest of pixels (N, 2)."""
    least = np.inf
    for i in range(len(pixels)):
        dx, dy = pixels[i, 0] - x, pixels[i, 1] - y
        least = min(least, dx * dx + dy * dy)
    return least


@kernel
def _harris(image: Image, x0: int, y0: int, x1: int, y1: int) -> tuple[Float, Float]:
    """Harris response, and rms gradient along the weaker direction, of the pixels [y0:y1, x0:x1].

    The response is smoothed, because a box window leaves it level over several pixels around a corner.
    """
    response, weaker = _raw_harris(image, x0 - 1, y0 - 1, x1 + 1, y1 + 1)
    across = response[:, :-2] + 2.0 * response[:, 1:-1] + response[:, 2:]
    smooth = (across[:-2] + 2.0 * across[1:-1] + across[2:]) / 16.0
    return smooth, weaker[1:-1, 1:-1]


@kernel
def _raw_harris(image: Image, x0: int, y0: int, x1: int, y1: int) -> tuple[Float, Float]:
    """Both for each pixel by itself."""
    w, h = x1 - x0, y1 - y0
    wide, high = w + 2 * _RADIUS, h + 2 * _RADIUS
    sums = np.zeros((3, high, w))  # of gxx, gxy, gyy along x
    line = np.empty((3, wide))
    for j in range(high):
        y = min(max(y0 - _RADIUS + j, 1), image.shape[0] - 2)
        for i in range(wide):
            x = min(max(x0 - _RADIUS + i, 1), image.shape[1] - 2)
            gx = 0.5 * (float(image[y, x + 1]) - float(image[y, x - 1]))
            gy = 0.5 * (float(image[y + 1, x]) - float(image[y - 1, x]))
            line[0, i], line[1, i], line[2, i] = gx * gx, gx * gy, gy * gy
        for c in range(3):
            total = 0.0
            for i in range(2 * _RADIUS):
                total += line[c, i]
            for i in range(w):
                total += line[c, i + 2 * _RADIUS]
                sums[c, j, i] = total
                total -= line[c, i]
    response = np.empty((h, w))
    weaker = np.empty((h, w))
    area = (2 * _RADIUS + 1) ** 2
    for i in range(w):
        xx = xy = yy = 0.0
        for j in range(2 * _RADIUS):
            xx += sums[0, j, i]
            xy += sums[1, j, i]
            yy += sums[2, j, i]
        for j in range(h):
            xx += sums[0, j + 2 * _RADIUS, i]
            xy += sums[1, j + 2 * _RADIUS, i]
            yy += sums[2, j + 2 * _RADIUS, i]
            a, b, c = xx / area, xy / area, yy / area
            response[j, i] = a * c - b * b - _HARRIS_K * (a + c) * (a + c)
            smaller = 0.5 * (a + c - np.sqrt((a - c) * (a - c) + 4.0 * b * b))
            weaker[j, i] = np.sqrt(max(smaller, 0.0))
            xx -= sums[0, j, i]
            xy -= sums[1, j, i]
            yy -= sums[2, j, i]
    return response, weaker


@kernel
def _is_peak(response: Float, x: int, y: int) -> bool:
    """False on the slope towards a corner of the next cell."""
    for j in range(-1, 2):
        for i in range(-1, 2):
            if response[y + j, x + i] > response[y, x]:
                return False
    return True


@kernel
def _peak_offset(before: float, at: float, after: float) -> float:
    """Where a parabola through three values has its peak, from the middle one, within half a pixel."""
    curvature = before - 2.0 * at + after
    if curvature >= 0.0:
        return 0.0
    return min(max(0.5 * (before - after) / curvature, -0.5), 0.5)
