"""Alignment of a patch with an image: estimation of the place in the image that shows the patch.

The method is Gauss-Newton, whose gradients and normal matrix belong to the patch (inverse compositional, S. Baker,
I. Matthews, *Lucas-Kanade 20 years on*, IJCV 56(3), 2004).
"""

import numpy as np

from graphvio.arrays import Float, Image
from graphvio.frontend.imaging.patches import LANES, Lattice, NormalEquations, Patch, weaker2
from graphvio.frontend.imaging.sampling import interpolated_row, spline_weights
from graphvio.kernels import fast_kernel

SAME_CONTRAST = 1.25
"""Largest ratio of contrasts of images that are exposed alike."""

_MIN_CONTRAST, _MAX_CONTRAST = 0.4, 2.5  # limits of an image's contrast over that of a patch
_MAX_ITERATIONS = 20
_CONVERGED_PX = 0.03  # the step is still taken, after which the error is several times smaller
_ZERO = np.float32(0.0)


@fast_kernel
def mismatch(image: Image, u: float, v: float, patch: Patch, gx: Patch, gy: Patch) -> tuple[float, float, float, bool]:
    """Sum gradients and patch times the difference between the image at (u, v) and the patch; False outside the image.

    The gradients and the patch have zero mean, so that a constant difference of brightness contributes nothing.
    """
    height, width = image.shape
    side, stride = patch.rows.shape
    half = side // 2
    if not (half + 1 <= u < width - half - 2 and half + 1 <= v < height - half - 2):
        return 0.0, 0.0, 0.0, False
    x0, y0 = int(np.floor(u)), int(np.floor(v))
    first = (y0 - half - 1) * width + x0 - half - 1
    if first + (side + 2) * width + stride + 3 > height * width:
        return 0.0, 0.0, 0.0, False  # the padding of the lowest row would read on beyond the image's end
    a0, a1, a2, a3 = spline_weights(np.float32(u - x0))
    b0, b1, b2, b3 = spline_weights(np.float32(v - y0))
    flat, columns = image.reshape(-1), LANES + 3
    bx = by = bp = _ZERO
    for j in range(side):
        for k in range(0, stride, LANES):
            s0 = first + j * width + k
            s1, s2, s3 = s0 + width, s0 + 2 * width, s0 + 3 * width
            r0, r1 = flat[s0 : s0 + columns], flat[s1 : s1 + columns]
            r2, r3 = flat[s2 : s2 + columns], flat[s3 : s3 + columns]
            values, dx, dy = patch.rows[j, k : k + LANES], gx.rows[j, k : k + LANES], gy.rows[j, k : k + LANES]
            row_x = row_y = row_p = _ZERO  # separate sums: a row need not wait for the one before
            for i in range(LANES):
                q0, q1 = interpolated_row(r0, i, a0, a1, a2, a3), interpolated_row(r1, i, a0, a1, a2, a3)
                q2, q3 = interpolated_row(r2, i, a0, a1, a2, a3), interpolated_row(r3, i, a0, a1, a2, a3)
                difference = b0 * q0 + b1 * q1 + b2 * q2 + b3 * q3 - values[i]
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

    Estimating it costs precision, for nothing where both images are exposed alike: a patch that is seen larger, or at
    another slant, also seems to have another contrast.
    """
    if 1.0 / SAME_CONTRAST < ratio < SAME_CONTRAST:
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
def shift_by_bends(gx: Patch, gy: Patch, grid: Lattice, normal: NormalEquations, bends: Float) -> tuple[float, float]:
    """Compute by how much an alignment is off because an affine map leaves out second derivatives.

    Mixed second derivatives are left out: they shift patches whose gradients lie along a diagonal, in either direction.

    Args:
        gx: the patch's gradient along its rows.
        gy: the patch's gradient along its columns.
        grid: lattice of the patch.
        normal: normal equations of the patch.
        bends: (2, 2) half of the second derivative along the rows, and along the columns, 1/px.
    """
    dx, dy, xs, ys = gx.flat, gy.flat, grid.columns.flat, grid.rows.flat
    bx = by = _ZERO
    b00, b01, b10, b11 = (
        np.float32(bends[0, 0]),
        np.float32(bends[0, 1]),
        np.float32(bends[1, 0]),
        np.float32(bends[1, 1]),
    )
    for k in range(dx.size):
        x2, y2 = xs[k] * xs[k], ys[k] * ys[k]
        along = dx[k] * (b00 * x2 + b10 * y2) + dy[k] * (b01 * x2 + b11 * y2)
        bx += dx[k] * along
        by += dy[k] * along
    determinant = normal.xx * normal.yy - normal.xy * normal.xy
    x, y = (normal.yy * bx - normal.xy * by) / determinant, (normal.xx * by - normal.xy * bx) / determinant
    return float(x), float(y)
