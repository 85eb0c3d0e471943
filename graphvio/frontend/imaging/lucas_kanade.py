"""Sparse pyramidal Lucas-Kanade: finds small patches of one image in another.

Inverse compositional (S. Baker, I. Matthews, *Lucas-Kanade 20 years on*, IJCV 56(3), 2004): gradients and normal
matrix belong to the patch and are computed once for all iterations. The patch's mean brightness is left out of the
comparison, so that a change of exposure moves no point; between two cameras, contrast is estimated with the shift.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from graphvio.arrays import Bool, Float, Image
from graphvio.frontend.imaging.alignment import align, shift_by_bends
from graphvio.frontend.imaging.patches import (
    bordered_lattice,
    bordered_room,
    correlation,
    lattice,
    localisation2,
    prepare,
    room,
    weaker2,
)
from graphvio.frontend.imaging.sampling import PixelWords, sample, sample_affine, scratch_room
from graphvio.kernels import fast_kernel

MIN_GRADIENT = 1.0
"""Smallest rms gradient of a localised patch along its weaker direction, grey levels per pixel."""

_MAX_SIGMA_PX = 0.2
"""Largest standard deviation of a place along the weaker direction; sharp images have less than half of it."""

Pyramid = tuple[Image, ...]
"""An image, and the same image at half the size, a quarter of the size, and so on."""


def build_pyramid(image: Image, levels: int) -> Pyramid:
    """Build a pyramid: the image and ``levels - 1`` smaller ones, each of half the size."""
    pyramid = [image]
    for _ in range(levels - 1):
        pyramid.append(np.asarray(cv2.pyrDown(pyramid[-1]), dtype=np.uint8))
    return tuple(pyramid)


def track(
    source: Pyramid,
    target: Pyramid,
    pixels: Float,
    guess: Float,
    *,
    window_px: int,
    levels: int,
    max_return_px: float,
    min_gradient: float = MIN_GRADIENT,
    first_levels: int | None = None,
) -> tuple[Float, Bool]:
    """Track corners from one image to another and, as a check, back again.

    Args:
        source: pyramid of the image that holds the corners.
        target: pyramid of the image to find them in.
        pixels: (N, 2) corners in the source.
        guess: (N, 2) initial pixels in the target.
        window_px: side of the patch that is compared, odd.
        levels: pyramid levels that are used, 1 for the image alone.
        max_return_px: largest distance from the corner after tracking forth and back.
        min_gradient: smallest rms gradient of a patch along its weaker direction, grey levels per pixel.
        first_levels: levels that are tried first, where the guess is good; tracks that fail are tried again with all.

    Returns:
        Pixels (N, 2) and whether each was found (N,), which includes that its sigma along the weaker direction is at
        most 0.2 px.
    """
    half = window_px // 2
    few = levels if first_levels is None else min(first_levels, levels)
    moved, found = _forth_and_back(source, target, pixels, guess, half, few, max_return_px, min_gradient)
    if few < levels and not found.all():
        again = ~found
        moved[again], found[again] = _forth_and_back(
            source, target, pixels[again], guess[again], half, levels, max_return_px, min_gradient
        )
    return moved, found


@fast_kernel
def _forth_and_back(
    source: Sequence[Image], target: Sequence[Image], pixels: Float, guess: Float, half: int, levels: int,
    max_return_px: float, min_gradient: float,
) -> tuple[Float, Bool]:  # fmt: skip
    """Track points (N, 2) through some levels, the coarsest first, and back; the flags (N,) say which were found."""
    n = len(pixels)
    moved = guess.copy()
    found = np.zeros(n, dtype=np.bool_)
    bordered, patch, seen, gx, gy = bordered_room(half), room(half), room(half), room(half), room(half)
    inside, most2 = lattice(half).inside, _MAX_SIGMA_PX**2
    for i in range(n):
        for level in range(levels - 1, -1, -1):
            scale = 1.0 / (1 << level)
            x, y = pixels[i, 0] * scale, pixels[i, 1] * scale
            u, v = moved[i, 0] * scale, moved[i, 1] * scale
            if not sample(source[level], x, y, half + 1, bordered):
                continue  # near the edge of a coarse level: the finer ones may still see it
            normal = prepare(bordered, inside, patch, gx, gy)
            u, v, converged = align(target[level], u, v, patch, gx, gy, normal, min_gradient, False)
            if converged or level > 0:
                moved[i, 0], moved[i, 1] = u / scale, v / scale
            found[i] = converged and level == 0
        if found[i]:
            # The way back begins where it should end, so it needs no coarse levels.
            found[i] = sample(target[0], moved[i, 0], moved[i, 1], half + 1, bordered)
        if found[i]:
            normal = prepare(bordered, inside, seen, gx, gy)
            found[i] = localisation2(patch, seen, normal) <= most2
        if found[i]:
            x, y = pixels[i, 0], pixels[i, 1]
            u, v, converged = align(source[0], x, y, seen, gx, gy, normal, min_gradient, False)
            found[i] = converged and (u - x) ** 2 + (v - y) ** 2 <= max_return_px * max_return_px
    return moved, found


@fast_kernel
def register(
    source: PixelWords, target: Image, pixels: Float, warps: Float, bends: Float, guess: Float, wanted: Bool, half: int,
    max_shift_px: float, min_gradient: float, is_other_camera: bool,
) -> tuple[Float, Bool, Bool, Float]:  # fmt: skip
    """Register patches of one image in another that shows them deformed, from a guess that is nearly right.

    Args:
        source: image that holds the patches, as returned by `graphvio.frontend.imaging.sampling.pixel_words`.
        target: image to find them in.
        pixels: (N, 2) centres of the patches.
        warps: (N, 2, 2) derivative of the source pixel with respect to the target pixel.
        bends: (N, 2, 2) half of the second derivative of the target pixel along the rows of the source, and along its
            columns, 1/px. Their effect is computed as if the patch's pixels were as far apart in both images.
        guess: (N, 2) initial pixels in the target.
        wanted: (N,) which patches to find.
        half: half the side of the patches, which have ``2 half + 1`` pixels on each side.
        max_shift_px: largest distance from the guess.
        min_gradient: smallest rms gradient of a patch along its weaker direction, grey levels per pixel.
        is_other_camera: whether the images are of two cameras, which may be exposed differently.

    Returns:
        Pixels (N, 2), equal to the guess where not found; whether each was found (N,), which includes that its sigma
        along the weaker direction is at most 0.2 px; whether its patch is in the source and has ``min_gradient`` (N,);
        and the normalised cross-correlations at the places found (N,).
    """
    n = len(pixels)
    moved, correlations = guess.copy(), np.full(n, -1.0)
    found, localised = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    bordered, patch, seen, gx, gy = bordered_room(half), room(half), room(half), room(half), room(half)
    grid, bordered_grid = lattice(half), bordered_lattice(half)
    scratch = scratch_room(bordered_grid)
    most2, least2 = _MAX_SIGMA_PX**2, (min_gradient * (2 * half + 1)) ** 2
    for i in range(n):
        x, y, warp = pixels[i, 0], pixels[i, 1], warps[i]
        if not wanted[i] or not sample_affine(
            source,
            x,
            y,
            warp[0, 0],
            warp[0, 1],
            warp[1, 0],
            warp[1, 1],
            bordered_grid,
            scratch,
            bordered,
        ):
            continue
        normal = prepare(bordered, grid.inside, patch, gx, gy)
        localised[i] = weaker2(normal.xx, normal.xy, normal.yy) >= least2
        x, y = guess[i, 0], guess[i, 1]
        u, v, converged = align(target, x, y, patch, gx, gy, normal, min_gradient, is_other_camera)
        if converged and (u - x) ** 2 + (v - y) ** 2 <= max_shift_px * max_shift_px:
            if not sample(target, u, v, half + 1, bordered):
                continue
            shift_x, shift_y = shift_by_bends(gx, gy, grid, normal, bends[i])
            normal = prepare(bordered, grid.inside, seen, gx, gy)
            if not localisation2(patch, seen, normal) <= most2:
                continue
            moved[i, 0], moved[i, 1], found[i] = u - shift_x, v - shift_y, True
            correlations[i] = correlation(patch, seen)
    return moved, found, localised, correlations
