"""Sparse pyramidal Lucas-Kanade: where small patches of one image are in another.

Inverse compositional (S. Baker, I. Matthews, *Lucas-Kanade 20 years on*, IJCV 56(3), 2004): gradients and normal
matrix belong to the patch and are computed once for all iterations. The patch's mean brightness is left out of the
comparison, so that a change of exposure moves no point.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from graphvio.arrays import Bool, Float, Image
from graphvio.frontend.patches import align, prepare, sample, sample_warped
from graphvio.kernels import fast_kernel

Pyramid = tuple[Image, ...]
"""An image and its halves, quarters..."""


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
            if not sample(source[level], x, y, half + 1, bordered):
                continue  # near the edge of a coarse level: the finer ones may still see it
            xx, xy, yy = prepare(bordered, patch, gx, gy)
            u, v, converged = align(target[level], u, v, half, patch, gx, gy, xx, xy, yy)
            if converged or level > 0:
                moved[i, 0], moved[i, 1] = u / scale, v / scale
            found[i] = converged and level == 0
    return moved, found


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
        if not sample_warped(source, pixels[i, 0], pixels[i, 1], warps[i], half + 1, bordered):
            continue
        xx, xy, yy = prepare(bordered, patch, gx, gy)
        moved[i, 0], moved[i, 1], found[i] = align(target, guess[i, 0], guess[i, 1], half, patch, gx, gy, xx, xy, yy)
    return moved, found
