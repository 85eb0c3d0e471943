"""Alignment of a left patch in the right image, where the surface that it shows may be slanted.

Seen from two places, the patch of a slanted surface is sheared along the epipolar line: its disparity varies linearly
over the patch. With two slopes in addition to the translation, and with the deformation by lenses and the cameras'
rotation, the alignment is exact for any plane, to first order. The second-order deformation by lenses shifts a patch by
an amount that depends on its gradients, which is corrected. The method is inverse compositional Gauss-Newton, as in
`graphvio.frontend.imaging.lucas_kanade`.
"""

import numpy as np

from graphvio.arrays import Bool, Float, Image
from graphvio.frontend.imaging.alignment import SAME_CONTRAST, align, different_contrast, shift_by_bends
from graphvio.frontend.imaging.patches import Lattice, Patch, bordered_room, correlation, lattice, prepare, room
from graphvio.frontend.imaging.sampling import PixelWords, Scratch, sample, sample_affine, scratch_room
from graphvio.kernels import fast_kernel

_MAX_ITERATIONS = 10
_CONVERGED_PX = 0.01  # where texture is weak, steps are short: stopping early would bias towards the earlier depth
_CONVERGED_SLOPE = 0.003  # an earlier slope must be free to change, or its error would persist
_CONVERGED_SHARE = 0.5  # of such a step: largest next step, extrapolated from how steps have become shorter
_MAX_SLOPE = 0.8
_SLOPE_PRIOR = 100.0  # squared grey levels: noise of 3 grey levels over a slope of 0.3; decides without texture
_SHIFT_PRIOR = 1e-3  # keeps the normal matrix of a flat patch regular

_Columns = tuple[Patch, Patch, Patch, Patch]
"""A patch's derivatives with respect to the shift and the slopes."""


@fast_kernel
def align_slanted(
    left: Image, right: Image, right_words: PixelWords, pixels: Float, guess: Float, directions: Float, warps: Float,
    bends: Float, slopes: Float, known: Bool, wanted: Bool, half: int,
) -> tuple[Float, Float, Float, Bool]:  # fmt: skip
    """Align patches of the left image in the right one.

    Args:
        left: image (height, width).
        right: image (height, width).
        right_words: the right image as returned by `graphvio.frontend.imaging.sampling.pixel_words`.
        pixels: (N, 2) centres of the patches.
        guess: (N, 2) initial pixels in the right image.
        directions: (N, 2) unit vectors along the epipolar lines in the right image.
        warps: (N, 2, 2) derivatives of the right pixel with respect to the left one, of surfaces at constant depth, see
            `graphvio.frontend.depth.prediction.stereo_warps`.
        bends: (N, 2, 2) halves of the second derivatives, likewise.
        slopes: (N, 2) initial slopes: derivative of the shift along the epipolar line with respect to the left pixel,
            caused by the slant.
        known: (N,) whether guess and slopes are known from before; if not, the shift is first aligned alone.
        wanted: (N,) which patches to align.
        half: half the side of the patches, which have ``2 half + 1`` pixels on each side.

    Returns:
        Pixels (N, 2) in the right image; slopes (N, 2); normalised cross-correlations there (N,); and whether each
        alignment converged (N,).
    """
    n = len(pixels)
    moved, found_slopes, correlations = guess.copy(), np.zeros((n, 2)), np.full(n, -1.0)
    found = np.zeros(n, dtype=np.bool_)
    bordered, patch, sheared = bordered_room(half), room(half), room(half)
    columns, grid = (room(half), room(half), room(half), room(half)), lattice(half)
    scratch = scratch_room(grid)
    factor, parameters, step = np.empty((4, 4)), np.empty(4), np.empty(4)
    for i in range(n):
        if not wanted[i] or not sample(left, pixels[i, 0], pixels[i, 1], half + 1, bordered):
            continue
        normal = prepare(bordered, grid.inside, patch, columns[0], columns[1])
        ex, ey = _in_left_image(directions[i], warps[i])
        parameters[0], parameters[1] = guess[i, 0], guess[i, 1]
        parameters[2], parameters[3] = slopes[i, 0], slopes[i, 1]
        if not known[i]:
            parameters[0], parameters[1], _ = align(
                right, guess[i, 0], guess[i, 1], patch, columns[0], columns[1], normal, 0.0, True
            )
        shift_x, shift_y = shift_by_bends(columns[0], columns[1], grid, normal, bends[i])
        _steepest_descent(columns, grid, ex, ey)
        gain, before, is_exposed_alike = 1.0, 0.0, True
        for k in range(_MAX_ITERATIONS):
            if not _sample_sheared(right_words, parameters, warps[i], directions[i], grid, scratch, sheared):
                break
            contrast = _contrast(sheared, normal.pp)
            if k == 0:
                gain = different_contrast(contrast)
                is_exposed_alike = gain == 1.0
                if not is_exposed_alike:
                    _eliminate_contrast(columns, patch, normal.pp)
                _factorise(columns, factor)
            if is_exposed_alike:  # a remaining difference would be taken for slopes
                gain = min(max(contrast, 1.0 / SAME_CONTRAST), SAME_CONTRAST)
            _project(columns, sheared, patch, gain, step)
            _solve(factor, step)
            _compose(parameters, step, ex, ey, warps[i])
            size = _size(step)
            if size < 1.0 or size * size < _CONVERGED_SHARE * before:
                found[i] = True
                break
            before = size
        if found[i]:
            parameters[0] -= shift_x
            parameters[1] -= shift_y
            correlations[i] = correlation(patch, sheared)
        moved[i, 0], moved[i, 1] = parameters[0], parameters[1]
        found_slopes[i, 0], found_slopes[i, 1] = parameters[2], parameters[3]
    return moved, found_slopes, correlations, found


@fast_kernel
def _in_left_image(direction: Float, warp: Float) -> tuple[float, float]:
    """Return the shift in the left image that corresponds to a unit shift along the epipolar line in the right one."""
    a, b, c, d = warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]
    area = a * d - b * c
    return (d * direction[0] - b * direction[1]) / area, (a * direction[1] - c * direction[0]) / area


@fast_kernel
def _steepest_descent(columns: _Columns, grid: Lattice, ex: float, ey: float) -> None:
    """Fill the derivatives with respect to the slopes, of zero mean, from those with respect to the shift."""
    gx, gy, by_x, by_y = columns[0].flat, columns[1].flat, columns[2].flat, columns[3].flat
    xs, ys, inside = grid.columns.flat, grid.rows.flat, grid.inside.flat
    along_x, along_y, area = np.float32(ex), np.float32(ey), np.float32(len(grid.rows.rows) ** 2)
    mean_x = mean_y = np.float32(0.0)
    for k in range(gx.size):
        along = gx[k] * along_x + gy[k] * along_y
        by_x[k], by_y[k] = along * xs[k], along * ys[k]
        mean_x += along * xs[k]
        mean_y += along * ys[k]
    mean_x /= area
    mean_y /= area
    for k in range(gx.size):
        by_x[k] -= inside[k] * mean_x
        by_y[k] -= inside[k] * mean_y


@fast_kernel
def _contrast(sheared: Patch, pp: float) -> float:
    """Return the contrast of the image over that of the patch, given the patch's sum of squares."""
    total = square = np.float32(0.0)
    values = sheared.flat
    for k in range(values.size):
        total += values[k]
        square += values[k] * values[k]
    variance = float(square - total * total / np.float32(len(sheared.rows) ** 2))
    return float(np.sqrt(max(variance, 0.0) / pp))


@fast_kernel
def _eliminate_contrast(columns: _Columns, patch: Patch, pp: float) -> None:
    """Make the derivatives orthogonal to the patch, given its sum of squares, so that contrast moves no parameter."""
    c0, c1, c2, c3, values = columns[0].flat, columns[1].flat, columns[2].flat, columns[3].flat, patch.flat
    p0 = p1 = p2 = p3 = np.float32(0.0)
    for k in range(values.size):
        p0 += c0[k] * values[k]
        p1 += c1[k] * values[k]
        p2 += c2[k] * values[k]
        p3 += c3[k] * values[k]
    square = np.float32(pp)
    p0, p1, p2, p3 = p0 / square, p1 / square, p2 / square, p3 / square
    for k in range(values.size):
        c0[k] -= p0 * values[k]
        c1[k] -= p1 * values[k]
        c2[k] -= p2 * values[k]
        c3[k] -= p3 * values[k]


@fast_kernel
def _factorise(columns: _Columns, factor: Float) -> None:
    """Fill the lower Cholesky factor (4, 4) of the normal matrix."""
    c0, c1, c2, c3 = columns[0].flat, columns[1].flat, columns[2].flat, columns[3].flat
    h00 = h01 = h11 = h02 = h03 = h12 = h13 = h22 = h23 = h33 = np.float32(0.0)
    for k in range(c0.size):
        h00 += c0[k] * c0[k]
        h01 += c0[k] * c1[k]
        h11 += c1[k] * c1[k]
        h02 += c0[k] * c2[k]
        h03 += c0[k] * c3[k]
        h12 += c1[k] * c2[k]
        h13 += c1[k] * c3[k]
        h22 += c2[k] * c2[k]
        h23 += c2[k] * c3[k]
        h33 += c3[k] * c3[k]
    factor[0, 0], factor[1, 0], factor[1, 1] = h00 + _SHIFT_PRIOR, h01, h11 + _SHIFT_PRIOR
    factor[2, 0], factor[2, 1], factor[2, 2] = h02, h12, h22 + _SLOPE_PRIOR
    factor[3, 0], factor[3, 1], factor[3, 2], factor[3, 3] = h03, h13, h23, h33 + _SLOPE_PRIOR
    for a in range(4):
        for b in range(a):
            for k in range(b):
                factor[a, b] -= factor[a, k] * factor[b, k]
            factor[a, b] /= factor[b, b]
            factor[a, a] -= factor[a, b] * factor[a, b]
        factor[a, a] = np.sqrt(max(factor[a, a], _SHIFT_PRIOR))


@fast_kernel
def _solve(factor: Float, b: Float) -> None:
    """Replace b (4,) by the solution of ``L L^T x = b``."""
    for a in range(4):
        for k in range(a):
            b[a] -= factor[a, k] * b[k]
        b[a] /= factor[a, a]
    for a in range(3, -1, -1):
        for k in range(a + 1, 4):
            b[a] -= factor[k, a] * b[k]
        b[a] /= factor[a, a]


@fast_kernel
def _size(step: Float) -> float:
    """Return the size of a step as a multiple of one after which an iteration has converged."""
    shift = np.sqrt(step[0] * step[0] + step[1] * step[1]) / _CONVERGED_PX
    slope = np.sqrt(step[2] * step[2] + step[3] * step[3]) / _CONVERGED_SLOPE
    return float(max(shift, slope))


@fast_kernel
def _sample_sheared(
    image: PixelWords, parameters: Float, warp: Float, direction: Float, grid: Lattice, scratch: Scratch, out: Patch
) -> bool:
    """Sample the patch at the parameters ``[u, v, slope x, slope y]``; False where it leaves the image."""
    u, v, a, b = parameters[0], parameters[1], parameters[2], parameters[3]
    ex, ey = direction[0], direction[1]
    xx, xy, yx, yy = warp[0, 0] + ex * a, warp[0, 1] + ex * b, warp[1, 0] + ey * a, warp[1, 1] + ey * b
    return sample_affine(image, u, v, xx, xy, yx, yy, grid, scratch, out)


@fast_kernel
def _compose(parameters: Float, step: Float, ex: float, ey: float, warp: Float) -> None:
    """Apply the inverse of a step before the warp: ``W <- W o dW^-1``, both a shift and a shear along the line."""
    share = (1.0 + parameters[2] * ex + parameters[3] * ey) / (1.0 + step[2] * ex + step[3] * ey)
    for k in range(2, 4):
        parameters[k] = min(max(parameters[k] - share * step[k], -_MAX_SLOPE), _MAX_SLOPE)
    along = parameters[2] * step[0] + parameters[3] * step[1]
    x, y = step[0] + ex * along, step[1] + ey * along
    parameters[0] -= warp[0, 0] * x + warp[0, 1] * y
    parameters[1] -= warp[1, 0] * x + warp[1, 1] * y


@fast_kernel
def _project(columns: _Columns, sheared: Patch, patch: Patch, gain: float, out: Float) -> None:
    """Fill the derivatives times the difference of the patches (4,), the sheared one divided by its contrast."""
    c0, c1, c2, c3 = columns[0].flat, columns[1].flat, columns[2].flat, columns[3].flat
    seen, expected = sheared.flat, patch.flat
    b0 = b1 = b2 = b3 = np.float32(0.0)
    inverse = np.float32(1.0 / gain)
    for k in range(seen.size):
        difference = inverse * seen[k] - expected[k]
        b0 += c0[k] * difference
        b1 += c1[k] * difference
        b2 += c2[k] * difference
        b3 += c3[k] * difference
    out[0], out[1], out[2], out[3] = b0, b1, b2, b3
