"""Square patches of an image: sampled with sub-pixel precision, compared with each other, and aligned."""

import numpy as np

from graphvio.arrays import AnyArray, Float, Image
from graphvio.kernels import fast_kernel

_MAX_ITERATIONS = 20
_CONVERGED_PX = 0.01
_MIN_GRADIENT = 1.0  # rms grey levels per pixel along the weaker direction; below, a point is not localised


@fast_kernel
def sample(image: Image, x: float, y: float, half: int, out: AnyArray) -> bool:
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
def prepare(bordered: AnyArray, patch: AnyArray, gx: AnyArray, gy: AnyArray) -> tuple[float, float, float]:
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
def mismatch(
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


@fast_kernel
def align(
    image: Image, u: float, v: float, half: int, patch: AnyArray, gx: AnyArray, gy: AnyArray,
    xx: float, xy: float, yy: float,
) -> tuple[float, float, bool]:  # fmt: skip
    """Gauss-Newton from (u, v): the patch's place in an image, and whether the iteration converged there."""
    smaller = 0.5 * (xx + yy - np.sqrt((xx - yy) * (xx - yy) + 4.0 * xy * xy))
    if smaller < _MIN_GRADIENT * _MIN_GRADIENT * patch.size:
        return u, v, False
    determinant = xx * yy - xy * xy
    for _ in range(_MAX_ITERATIONS):
        bx, by, inside = mismatch(image, u, v, half, patch, gx, gy)
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
def sample_warped(image: Image, x: float, y: float, warp: Float, half: int, out: AnyArray) -> bool:
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
