"""Sparse pyramidal Lucas-Kanade: where small patches of one image are in another.

Inverse compositional (S. Baker, I. Matthews, *Lucas-Kanade 20 years on*, IJCV 56(3), 2004): gradients and normal
matrix belong to the patch and are computed once for all iterations. The patch's mean brightness is left out of the
comparison, so that a change of exposure moves no point.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from graphvio.arrays import AnyArray, Bool, Float, Image
from graphvio.kernels import fast_kernel

Pyramid = tuple[Image, ...]
"""An image and its halves, quarters..."""

_MAX_ITERATIONS = 20
_CONVERGED_PX = 0.01
_MIN_GRADIENT = 1.0  # rms grey levels per pixel along the weaker direction; below, a point is not localised


def build_pyramid(image: Image, levels: int) -> Pyramid:
    """The image and ``levels - 1`` smaller ones, each of half the size; computed once, used by every match."""
    pyramid = [image]
    for _ in range(levels - 1):
        pyramid.append(np.asarray(cv2.pyrDown(pyramid[-1]), dtype=np.uint8))
    return tuple(pyramid)


def track(
    source: Pyramid, target: Pyramid, pixels: Float, guess: Float, *, window_px: int, levels: int, max_return_px: float
) -> tuple[Float, Bool]:
    """Where corners of one image are in another, forth and, for a check, back again.

    Args:
        source: of the image that holds the corners.
        target: of the image to find them in.
        pixels: (N, 2) corners.
        guess: (N, 2) where the search starts.
        window_px: side of the patch that is compared, odd.
        levels: pyramid levels that are used, 1 for the image alone.
        max_return_px: largest distance from the corner after tracking forth and back.

    Returns:
        Pixels (N, 2) and whether each was found (N,).
    """
    half = window_px // 2
    forth, found = _track_points(source[:levels], target[:levels], pixels, guess, half)
    # The way back begins where it should end, so it needs no coarse levels.
    back, returned = _track_points(target[:1], source[:1], forth, np.ascontiguousarray(pixels), half)
    distance = np.hypot(back[:, 0] - pixels[:, 0], back[:, 1] - pixels[:, 1])
    return forth, found & returned & (distance <= max_return_px)


@fast_kernel
def _track_points(
    source: Sequence[Image], target: Sequence[Image], pixels: Float, guess: Float, half: int
) -> tuple[Float, Bool]:
    """Points (N, 2) tracked through all levels, the coarsest first, and whether the finest one converged (N,)."""
    n = len(pixels)
    moved = guess.copy()
    found = np.zeros(n, dtype=np.bool_)
    side = 2 * half + 1
    bordered = np.empty((side + 2, side + 2), dtype=np.float32)
    patch = np.empty((side, side), dtype=np.float32)
    gx = np.empty((side, side), dtype=np.float32)
    gy = np.empty((side, side), dtype=np.float32)
    for i in range(n):
        for level in range(len(source) - 1, -1, -1):
            scale = 1.0 / (1 << level)
            x, y = pixels[i, 0] * scale, pixels[i, 1] * scale
            u, v = moved[i, 0] * scale, moved[i, 1] * scale
            if not _sample(source[level], x, y, half + 1, bordered):
                continue  # near the edge of a coarse level: the finer ones may still see it
            xx, xy, yy = _prepare(bordered, patch, gx, gy)
            u, v, converged = _align(target[level], u, v, half, patch, gx, gy, xx, xy, yy)
            if converged or level > 0:
                moved[i, 0], moved[i, 1] = u / scale, v / scale
            found[i] = converged and level == 0
    return moved, found


@fast_kernel
def _sample(image: Image, x: float, y: float, half: int, out: AnyArray) -> bool:
    """Fill a patch around (x, y) by bilinear interpolation; False where it leaves the image."""
    height, width = image.shape
    if not (half <= x < width - half - 1 and half <= y < height - half - 1):
        return False
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    ax, ay = np.float32(x - x0), np.float32(y - y0)
    one = np.float32(1.0)
    w00, w01, w10, w11 = (one - ax) * (one - ay), ax * (one - ay), (one - ax) * ay, ax * ay
    side = 2 * half + 1
    reach = side + 1
    left, top = x0 - half, y0 - half
    for j in range(side):
        upper = image[top + j, left : left + reach]
        lower = image[top + j + 1, left : left + reach]
        for i in range(side):
            out[j, i] = (
                w00 * np.float32(upper[i])
                + w01 * np.float32(upper[i + 1])
                + w10 * np.float32(lower[i])
                + w11 * np.float32(lower[i + 1])
            )
    return True


@fast_kernel
def _prepare(bordered: AnyArray, patch: AnyArray, gx: AnyArray, gy: AnyArray) -> tuple[float, float, float]:
    """Fill the patch and its gradients, all of zero mean, and return the normal matrix's xx, xy, yy."""
    side = patch.shape[0]
    mean = mean_x = mean_y = np.float32(0.0)
    half = np.float32(0.5)
    for j in range(side):
        for i in range(side):
            patch[j, i] = bordered[j + 1, i + 1]
            gx[j, i] = half * (bordered[j + 1, i + 2] - bordered[j + 1, i])
            gy[j, i] = half * (bordered[j + 2, i + 1] - bordered[j, i + 1])
            mean += patch[j, i]
            mean_x += gx[j, i]
            mean_y += gy[j, i]
    area = np.float32(side * side)
    mean /= area
    mean_x /= area
    mean_y /= area
    xx = xy = yy = np.float32(0.0)
    for j in range(side):
        for i in range(side):
            patch[j, i] -= mean
            gx[j, i] -= mean_x
            gy[j, i] -= mean_y
            xx += gx[j, i] * gx[j, i]
            xy += gx[j, i] * gy[j, i]
            yy += gy[j, i] * gy[j, i]
    return float(xx), float(xy), float(yy)


@fast_kernel
def _mismatch(
    image: Image, u: float, v: float, half: int, patch: AnyArray, gx: AnyArray, gy: AnyArray
) -> tuple[float, float, bool]:
    """Gradients times the difference between the image at (u, v) and the patch, summed; False outside the image.

    The gradients have zero mean, so a constant difference of brightness contributes nothing.
    """
    height, width = image.shape
    if not (half <= u < width - half - 1 and half <= v < height - half - 1):
        return 0.0, 0.0, False
    x0, y0 = int(np.floor(u)), int(np.floor(v))
    ax, ay = np.float32(u - x0), np.float32(v - y0)
    one = np.float32(1.0)
    w00, w01, w10, w11 = (one - ax) * (one - ay), ax * (one - ay), (one - ax) * ay, ax * ay
    reach = 2 * half + 2
    left, top = x0 - half, y0 - half
    bx = by = np.float32(0.0)
    for j in range(patch.shape[0]):
        upper = image[top + j, left : left + reach]
        lower = image[top + j + 1, left : left + reach]
        for i in range(patch.shape[1]):
            difference = (
                w00 * np.float32(upper[i])
                + w01 * np.float32(upper[i + 1])
                + w10 * np.float32(lower[i])
                + w11 * np.float32(lower[i + 1])
                - patch[j, i]
            )
            bx += gx[j, i] * difference
            by += gy[j, i] * difference
    return float(bx), float(by), True


def register(
    source: Image, target: Image, pixels: Float, warps: Float, guess: Float, *, window_px: int, max_shift_px: float
) -> tuple[Float, Bool]:
    """Where patches of one image are in another that sees them deformed, from a guess that is nearly right.

    Args:
        source: image that holds the patches.
        target: image to find them in.
        pixels: (N, 2) centres of the patches.
        warps: (N, 2, 2) derivative of the source pixel by the target pixel.
        guess: (N, 2) in the target.
        window_px: side of the patch, odd.
        max_shift_px: largest distance from the guess.

    Returns:
        Pixels (N, 2), equal to the guess where not found, and whether each was found (N,).
    """
    moved, found = _register_points(source, target, pixels, warps, guess, window_px // 2)
    shift = np.hypot(moved[:, 0] - guess[:, 0], moved[:, 1] - guess[:, 1])
    found &= shift <= max_shift_px
    return np.where(found[:, None], moved, guess), found


@fast_kernel
def _register_points(
    source: Image, target: Image, pixels: Float, warps: Float, guess: Float, half: int
) -> tuple[Float, Bool]:
    n = len(pixels)
    moved = guess.copy()
    found = np.zeros(n, dtype=np.bool_)
    side = 2 * half + 1
    bordered = np.empty((side + 2, side + 2), dtype=np.float32)
    patch = np.empty((side, side), dtype=np.float32)
    gx = np.empty((side, side), dtype=np.float32)
    gy = np.empty((side, side), dtype=np.float32)
    for i in range(n):
        if not _sample_warped(source, pixels[i, 0], pixels[i, 1], warps[i], half + 1, bordered):
            continue
        xx, xy, yy = _prepare(bordered, patch, gx, gy)
        moved[i, 0], moved[i, 1], found[i] = _align(
            target, guess[i, 0], guess[i, 1], half, patch, gx, gy, xx, xy, yy
        )
    return moved, found


@fast_kernel
def _align(
    image: Image, u: float, v: float, half: int, patch: AnyArray, gx: AnyArray, gy: AnyArray,
    xx: float, xy: float, yy: float,
) -> tuple[float, float, bool]:  # fmt: skip
    """Gauss-Newton from (u, v): the patch's place in an image, and whether the iteration converged there."""
    smaller = 0.5 * (xx + yy - np.sqrt((xx - yy) * (xx - yy) + 4.0 * xy * xy))
    if smaller < _MIN_GRADIENT * _MIN_GRADIENT * patch.size:
        return u, v, False
    determinant = xx * yy - xy * xy
    for _ in range(_MAX_ITERATIONS):
        bx, by, inside = _mismatch(image, u, v, half, patch, gx, gy)
        if not inside:
            break
        step_u = (yy * bx - xy * by) / determinant
        step_v = (xx * by - xy * bx) / determinant
        u -= step_u
        v -= step_v
        if step_u * step_u + step_v * step_v < _CONVERGED_PX * _CONVERGED_PX:
            return u, v, True
    return u, v, False


@fast_kernel
def _sample_warped(image: Image, x: float, y: float, warp: Float, half: int, out: AnyArray) -> bool:
    """Fill a patch around (x, y) whose pixels are ``warp`` apart; False where it leaves the image."""
    height, width = image.shape
    reach_x = half * (abs(warp[0, 0]) + abs(warp[0, 1]))
    reach_y = half * (abs(warp[1, 0]) + abs(warp[1, 1]))
    if not (reach_x <= x < width - 1 - reach_x and reach_y <= y < height - 1 - reach_y):
        return False
    one = np.float32(1.0)
    for j in range(2 * half + 1):
        for i in range(2 * half + 1):
            px = np.float32(x + warp[0, 0] * (i - half) + warp[0, 1] * (j - half))
            py = np.float32(y + warp[1, 0] * (i - half) + warp[1, 1] * (j - half))
            x0, y0 = int(px), int(py)
            ax, ay = px - np.float32(x0), py - np.float32(y0)
            upper = np.float32(image[y0, x0]) * (one - ax) + np.float32(image[y0, x0 + 1]) * ax
            lower = np.float32(image[y0 + 1, x0]) * (one - ax) + np.float32(image[y0 + 1, x0 + 1]) * ax
            out[j, i] = upper * (one - ay) + lower * ay
    return True
