"""Kernels of the renderer: the first rectangle on each ray, and its radiance.

For rays ``(x, y, 1)`` in frame cam, a rectangle is described by three vectors c, a, b: the inverse depth on a ray is
``w = c . ray``, and the rectangle's coordinates there (0 to 1 inside) are ``u = a . ray / w`` and ``v = b . ray / w``.
All conditions of visibility are thus linear in (x, y), so a whole image tile can be tested against a rectangle at once.
"""

import numpy as np

from graphvio.arrays import AnyArray, Float, Int
from graphvio.kernels import kernel

TILE_PX = 16
_SUBSAMPLES = 3
_MAX_PROBES = 6.0
_MIN_DEPTH_M = 0.02


@kernel
def ray_coefficients(corners: Float, cam_T_world: Float) -> Float:
    """Compute the coefficients (Q, 9) ``[c, a, b]`` of rectangles; zeros if the camera is in their plane.

    Args:
        corners: (Q, 3, 3) origin, edge_u, edge_v; metres, frame world.
        cam_T_world: pose (4, 4) of the world in the camera's frame.
    """
    coefficients = np.zeros((len(corners), 9))
    rotation, translation = cam_T_world[:3, :3].copy(), cam_T_world[:3, 3].copy()
    for i in range(len(corners)):
        p = rotation @ corners[i, 0] + translation
        e = rotation @ corners[i, 1]
        f = rotation @ corners[i, 2]
        volume = np.dot(p, np.cross(e, f))
        if abs(volume) < 1e-9:
            continue
        coefficients[i, 0:3] = np.cross(e, f) / volume
        coefficients[i, 3:6] = np.cross(f, p) / volume
        coefficients[i, 6:9] = np.cross(p, e) / volume
    return coefficients


@kernel
def _maximum(x: float, y: float, z: float, boxes: Float, n: int) -> float:
    """Return the maximum of ``(x, y, z) . ray`` over the rays in box n, ``[x0, x1, y0, y1]``."""
    maximum: float = max(x * boxes[n, 0], x * boxes[n, 1]) + max(y * boxes[n, 2], y * boxes[n, 3]) + z
    return maximum


@kernel
def _nearest_in(k: Float, i: int, boxes: Float, n: int) -> float:
    """Return an upper bound of rectangle i's inverse depth over the rays in box n; -1 if none of them meets it."""
    nearest = _maximum(k[i, 0], k[i, 1], k[i, 2], boxes, n)
    if nearest <= 0.0:
        return -1.0
    for j in (3, 6):
        if _maximum(k[i, j], k[i, j + 1], k[i, j + 2], boxes, n) < 0.0:
            return -1.0
        if _maximum(k[i, 0] - k[i, j], k[i, 1] - k[i, j + 1], k[i, 2] - k[i, j + 2], boxes, n) < 0.0:
            return -1.0
    return nearest


@kernel
def tile_lists(coefficients: Float, tile_boxes: Float) -> tuple[Int, Int, Float]:
    """List the candidate rectangles of every tile, nearest first.

    Args:
        coefficients: (Q, 9) from `ray_coefficients`.
        tile_boxes: (T, 4) extent ``[x0, x1, y0, y1]`` of the rays of each tile.

    Returns:
        Offsets (T + 1,) of the tiles' lists, rectangles (N,), and upper bounds (N,) of their inverse depth.
    """
    everywhere = np.array(
        [[tile_boxes[:, 0].min(), tile_boxes[:, 1].max(), tile_boxes[:, 2].min(), tile_boxes[:, 3].max()]]
    )
    in_view = np.array([i for i in range(len(coefficients)) if _nearest_in(coefficients, i, everywhere, 0) > 0.0])
    n_tiles = len(tile_boxes)
    offsets = np.zeros(n_tiles + 1, dtype=np.int64)
    items = np.empty(max(1, n_tiles * len(in_view)), dtype=np.int64)
    bounds = np.empty(len(items))
    end = 0
    for tile in range(n_tiles):
        first = end
        for i in in_view:
            bound = _nearest_in(coefficients, i, tile_boxes, tile)
            if bound > 0.0:
                place = end
                while place > first and bounds[place - 1] < bound:
                    items[place], bounds[place] = items[place - 1], bounds[place - 1]
                    place -= 1
                items[place], bounds[place] = i, bound
                end += 1
        offsets[tile + 1] = end
    return offsets, items[:end], bounds[:end]


@kernel
def _first_hit(
    coefficients: Float, items: Int, bounds: Float, first: int, last: int, x: float, y: float
) -> tuple[int, float]:
    """Find the nearest rectangle on the ray (x, y), -1 for none, and its inverse depth."""
    best, nearest = -1, 0.0
    for n in range(first, last):
        if bounds[n] <= nearest:
            break
        i = items[n]
        w = coefficients[i, 0] * x + coefficients[i, 1] * y + coefficients[i, 2]
        if w <= nearest or w * _MIN_DEPTH_M > 1.0:
            continue
        u = coefficients[i, 3] * x + coefficients[i, 4] * y + coefficients[i, 5]
        if u < 0.0 or u > w:
            continue
        v = coefficients[i, 6] * x + coefficients[i, 7] * y + coefficients[i, 8]
        if v < 0.0 or v > w:
            continue
        best, nearest = i, w
    return best, nearest


@kernel
def first_hits(coefficients: Float, offsets: Int, items: Int, bounds: Float, rays: Float) -> tuple[Int, Float]:
    """Find the nearest rectangle on the ray of every pixel's centre.

    Args:
        coefficients: (1, Q, 9), or (H, Q, 9) for the lines of a rolling shutter, with tiles that are one line high.
        offsets: (T + 1,) from `tile_lists`.
        items: (N,) from `tile_lists`.
        bounds: (N,) from `tile_lists`.
        rays: (H, W, 2) normalised coordinates of the pixels.

    Returns:
        Rectangle (H, W), -1 for none, and inverse depth (H, W) in 1/m.
    """
    height, width = rays.shape[0], rays.shape[1]
    tiles_across = (width + TILE_PX - 1) // TILE_PX
    tile_height = TILE_PX if len(coefficients) == 1 else 1
    hit = np.empty((height, width), dtype=np.int64)
    inverse_depth = np.empty((height, width))
    for row in range(height):
        k = coefficients[min(row, len(coefficients) - 1)]
        for column in range(width):
            tile = (row // tile_height) * tiles_across + column // TILE_PX
            hit[row, column], inverse_depth[row, column] = _first_hit(
                k,
                items,
                bounds,
                offsets[tile],
                offsets[tile + 1],
                rays[row, column, 0],
                rays[row, column, 1],
            )
    return hit, inverse_depth


@kernel
def _bilinear(values: AnyArray, start: int, x: float, y: float, mask: int) -> float:
    """Interpolate at (x, y) a square grid, stored row by row from ``start``; indices wrap around at ``mask + 1``."""
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = x - x0, y - y0
    left, top = int(x0) & mask, int(y0) & mask
    right, bottom = (left + 1) & mask, (top + 1) & mask
    upper_row, lower_row = start + top * (mask + 1), start + bottom * (mask + 1)
    upper = values[upper_row + left] * (1.0 - fx) + values[upper_row + right] * fx
    lower = values[lower_row + left] * (1.0 - fx) + values[lower_row + right] * fx
    value: float = upper * (1.0 - fy) + lower * fy
    return value


@kernel
def _light(values: AnyArray, grid: Int, i: int, u: float, v: float) -> float:
    """Interpolate the light at (u, v) of rectangle i from its grid ``[offset, columns, rows]``."""
    start, columns, rows = grid[i, 0], grid[i, 1], grid[i, 2]
    x, y = min(max(u, 0.0), 1.0) * (columns - 1), min(max(v, 0.0), 1.0) * (rows - 1)
    left, top = min(int(x), max(columns - 2, 0)), min(int(y), max(rows - 2, 0))
    fx, fy = x - left, y - top
    right, bottom = min(left + 1, columns - 1), min(top + 1, rows - 1)
    upper = values[start + top * columns + left] * (1.0 - fx) + values[start + top * columns + right] * fx
    lower = values[start + bottom * columns + left] * (1.0 - fx) + values[start + bottom * columns + right] * fx
    value: float = upper * (1.0 - fy) + lower * fy
    return value


@kernel
def _radiance(
    k: Float, i: int, x: float, y: float, x_i: float, x_j: float, y_i: float, y_j: float,
    texture: Int, mapping: Float, texels: AnyArray, level_offsets: Int, sides: Int,
    values: AnyArray, grid: Int,
) -> float:  # fmt: skip
    """Average the radiance of rectangle i on the ray (x, y) over a pixel's footprint.

    The ray changes by (x_i, y_i) with the pixel's column and by (x_j, y_j) with its row.
    """
    w = 1.0 / (k[i, 0] * x + k[i, 1] * y + k[i, 2])
    u = (k[i, 3] * x + k[i, 4] * y + k[i, 5]) * w
    v = (k[i, 6] * x + k[i, 7] * y + k[i, 8]) * w
    of, along_u, along_v = texture[i], mapping[i, 0], mapping[i, 2]
    side = sides[of]
    s_x, s_y = (k[i, 3] - u * k[i, 0]) * w * along_u, (k[i, 4] - u * k[i, 1]) * w * along_u
    t_x, t_y = (k[i, 6] - v * k[i, 0]) * w * along_v, (k[i, 7] - v * k[i, 1]) * w * along_v
    s_long, t_long = s_x * x_i + s_y * y_i, t_x * x_i + t_y * y_i
    s_short, t_short = s_x * x_j + s_y * y_j, t_x * x_j + t_y * y_j
    long2, short2 = s_long * s_long + t_long * t_long, s_short * s_short + t_short * t_short
    if short2 > long2:
        long2, short2, s_long, t_long = short2, long2, s_short, t_short
    longest, shortest = np.sqrt(long2) * side, np.sqrt(short2) * side
    probes = int(min(np.ceil(longest / max(shortest, 1.0)), _MAX_PROBES))
    footprint = max(shortest, longest / probes)
    level = 0.0
    if footprint > 1.0:
        level = min(np.log2(footprint), level_offsets.shape[1] - 1.001)
    fine = int(level)
    blend = level - fine
    fine_side, coarse_side = max(side >> fine, 1), max(side >> (fine + 1), 1)
    fine_start, coarse_start = (
        level_offsets[of, fine],
        level_offsets[of, min(fine + 1, level_offsets.shape[1] - 1)],
    )
    s, t = u * along_u + mapping[i, 1], v * along_v + mapping[i, 3]
    total = 0.0
    for n in range(probes):
        along = (n + 0.5) / probes - 0.5
        s_n, t_n = s + along * s_long, t + along * t_long
        mask = fine_side - 1
        x_n, y_n = s_n * fine_side - 0.5, t_n * fine_side - 0.5
        value = _bilinear(texels, fine_start, x_n, y_n, mask)
        if blend > 0.0:
            mask = coarse_side - 1
            x_n, y_n = s_n * coarse_side - 0.5, t_n * coarse_side - 0.5
            value += blend * (_bilinear(texels, coarse_start, x_n, y_n, mask) - value)
        total += value
    return total / probes * _light(values, grid, i, u, v)


@kernel
def shade(
    coefficients: Float,
    offsets: Int,
    items: Int,
    bounds: Float,
    rays: Float,
    slopes: Float,
    hit: Int,
    texture: Int,
    mapping: Float,
    tint: Float,
    texels: AnyArray,
    level_offsets: Int,
    sides: Int,
    values: AnyArray,
    grid: Int,
) -> AnyArray:
    """Compute the radiance (H, W) float32; pixels at the border of two rectangles are averages over a grid of rays.

    Args:
        coefficients: (1, Q, 9), or (H, Q, 9) for the lines of a rolling shutter, with tiles that are one line high.
        offsets: (T + 1,) from `tile_lists`.
        items: (N,) from `tile_lists`.
        bounds: (N,) from `tile_lists`.
        rays: (H, W, 2) normalised coordinates of the pixels.
        slopes: (H, W, 2, 2) derivative of ``rays`` with respect to the pixel's column and row.
        hit: (H, W) from `first_hits`.
        texture: (Q,), see `Surfaces`.
        mapping: (Q, 4), see `Surfaces`.
        tint: (Q,), see `Surfaces`.
        texels: (T,), see `Atlas`.
        level_offsets: (n, levels), see `Atlas.offsets`.
        sides: (n,), see `Atlas`.
        values: (L,), see `LightMap`.
        grid: (Q, 3), see `LightMap`.
    """
    height, width = hit.shape
    tiles_across = (width + TILE_PX - 1) // TILE_PX
    tile_height = TILE_PX if len(coefficients) == 1 else 1
    radiance = np.zeros((height, width), dtype=np.float32)
    for row in range(height):
        k = coefficients[min(row, len(coefficients) - 1)]
        for column in range(width):
            i = hit[row, column]
            border = (
                (column > 0 and hit[row, column - 1] != i)
                or (column < width - 1 and hit[row, column + 1] != i)
                or (row > 0 and hit[row - 1, column] != i)
                or (row < height - 1 and hit[row + 1, column] != i)
            )
            rays_each = _SUBSAMPLES if border else 1
            tile = (row // tile_height) * tiles_across + column // TILE_PX
            x_i, x_j = slopes[row, column, 0, 0], slopes[row, column, 0, 1]
            y_i, y_j = slopes[row, column, 1, 0], slopes[row, column, 1, 1]
            total = 0.0
            for m in range(rays_each):
                down = (m + 0.5) / rays_each - 0.5
                for n in range(rays_each):
                    right = (n + 0.5) / rays_each - 0.5
                    x = rays[row, column, 0] + x_i * right + x_j * down
                    y = rays[row, column, 1] + y_i * right + y_j * down
                    if border:
                        i, _ = _first_hit(k, items, bounds, offsets[tile], offsets[tile + 1], x, y)
                    if i >= 0:
                        total += tint[i] * _radiance(
                            k, i, x, y, x_i, x_j, y_i, y_j,
                            texture, mapping, texels, level_offsets, sides, values, grid,
                        )  # fmt: skip
            radiance[row, column] = total / (rays_each * rays_each)
    return radiance
