"""Alignment of a left patch in the right image, where the surface that it shows may be slanted.

Seen from two places, the patch of a slanted surface is sheared along the epipolar line: its disparity varies
linearly over the patch. Two slopes beside the translation make the alignment exact for any plane, to first order.
Inverse compositional Gauss-Newton, as in `graphvio.frontend.lucas_kanade`.
"""

import numpy as np

from graphvio.arrays import AnyArray, Bool, Float, Image
from graphvio.frontend.patches import align, prepare, sample
from graphvio.kernels import fast_kernel

_MAX_ITERATIONS = 10
_CONVERGED_PX = 0.01
_MAX_SLOPE = 0.8
_SLOPE_PRIOR = 100.0  # squared grey levels: a slope of 0.3 against noise of 3 grey levels; decides where nothing else


@fast_kernel
def align_slanted(
    left: Image, right: Image, pixels: Float, guess: Float, directions: Float, half: int
) -> tuple[Float, Float, Float, Bool]:
    """Align patches of the left image in the right one.

    Args:
        left: image (height, width).
        right: image (height, width).
        pixels: (N, 2) centres of the patches.
        guess: (N, 2) where the search starts.
        directions: (N, 2) unit vectors along the epipolar lines in the right image.
        half: of the patch's side, without its middle.

    Returns:
        Pixels (N, 2) in the right image; slopes (N, 2), the derivative of the shift along the line by the left
        pixel; normalised cross-correlations there (N,); and whether each alignment converged (N,).
    """
    n = len(pixels)
    moved, slopes, correlations = guess.copy(), np.zeros((n, 2)), np.full(n, -1.0)
    found = np.zeros(n, dtype=np.bool_)
    side = 2 * half + 1
    bordered = np.empty((side + 2, side + 2), dtype=np.float32)
    patch, gx, gy, sheared = (
        np.empty((side, side), dtype=np.float32),
        np.empty((side, side), dtype=np.float32),
        np.empty((side, side), dtype=np.float32),
        np.empty((side, side), dtype=np.float32),
    )
    columns = np.empty((4, side, side), dtype=np.float32)
    for i in range(n):
        if not sample(left, pixels[i, 0], pixels[i, 1], half + 1, bordered):
            continue
        xx, xy, yy = prepare(bordered, patch, gx, gy)
        u, v, _ = align(right, guess[i, 0], guess[i, 1], half, patch, gx, gy, xx, xy, yy)
        ex, ey = directions[i, 0], directions[i, 1]
        inverse = np.linalg.inv(_steepest_descent(gx, gy, np.float32(ex), np.float32(ey), half, columns))
        parameters = np.array([u, v, 0.0, 0.0])
        for _ in range(_MAX_ITERATIONS):
            if not _sample_sheared(right, parameters, ex, ey, half, sheared):
                break
            step = inverse @ _project(columns, sheared, patch)
            _compose(parameters, step, ex, ey)
            if step[0] * step[0] + step[1] * step[1] < _CONVERGED_PX * _CONVERGED_PX:
                found[i] = True
                break
        moved[i, 0], moved[i, 1] = parameters[0], parameters[1]
        slopes[i, 0], slopes[i, 1] = parameters[2], parameters[3]
        if found[i]:
            correlations[i] = _correlation(patch, sheared)
    return moved, slopes, correlations, found


@fast_kernel
def _steepest_descent(gx: AnyArray, gy: AnyArray, ex: float, ey: float, half: int, columns: AnyArray) -> Float:
    """Fill the derivatives (4, side, side) of the patch by the parameters, of zero mean; return the normal matrix."""
    side = 2 * half + 1
    mean2 = mean3 = np.float32(0.0)
    for j in range(side):
        for i in range(side):
            along = gx[j, i] * ex + gy[j, i] * ey
            columns[0, j, i], columns[1, j, i] = gx[j, i], gy[j, i]
            columns[2, j, i] = along * np.float32(i - half)
            columns[3, j, i] = along * np.float32(j - half)
            mean2 += columns[2, j, i]
            mean3 += columns[3, j, i]
    area = np.float32(side * side)
    columns[2] -= mean2 / area
    columns[3] -= mean3 / area
    hessian = np.empty((4, 4))
    for a in range(4):
        for b in range(a + 1):
            total = np.float32(0.0)
            for j in range(side):
                for i in range(side):
                    total += columns[a, j, i] * columns[b, j, i]
            hessian[a, b] = hessian[b, a] = total
    hessian[2, 2] += _SLOPE_PRIOR
    hessian[3, 3] += _SLOPE_PRIOR
    hessian[0, 0] += 1e-3
    hessian[1, 1] += 1e-3
    return hessian


@fast_kernel
def _sample_sheared(image: Image, parameters: Float, ex: float, ey: float, half: int, out: AnyArray) -> bool:
    """Fill the patch that the parameters ``[u, v, slope x, slope y]`` point at; False where it leaves the image."""
    u, v, a, b = parameters[0], parameters[1], parameters[2], parameters[3]
    height, width = image.shape
    reach = half * (1.0 + abs(a) + abs(b))
    if not (reach <= u < width - 1 - reach and reach <= v < height - 1 - reach):
        return False
    one = np.float32(1.0)
    along_x, along_y = np.float32(1.0 + ex * a), np.float32(ey * a)
    for j in range(2 * half + 1):
        x = np.float32(u + ex * b * (j - half) - half * (1.0 + ex * a))
        y = np.float32(v + (j - half) * (1.0 + ey * b) - half * ey * a)
        for i in range(2 * half + 1):
            px, py = x + along_x * np.float32(i), y + along_y * np.float32(i)
            x0, y0 = int(px), int(py)
            ax, ay = px - np.float32(x0), py - np.float32(y0)
            upper = np.float32(image[y0, x0]) * (one - ax) + np.float32(image[y0, x0 + 1]) * ax
            lower = np.float32(image[y0 + 1, x0]) * (one - ax) + np.float32(image[y0 + 1, x0 + 1]) * ax
            out[j, i] = upper * (one - ay) + lower * ay
    return True


@fast_kernel
def _compose(parameters: Float, step: Float, ex: float, ey: float) -> None:
    """Undo a step before the warp: ``W <- W o dW^-1``, where both are a shift and a shear along the line."""
    share = (1.0 + parameters[2] * ex + parameters[3] * ey) / (1.0 + step[2] * ex + step[3] * ey)
    for k in range(2, 4):
        parameters[k] = min(max(parameters[k] - share * step[k], -_MAX_SLOPE), _MAX_SLOPE)
    along = parameters[2] * step[0] + parameters[3] * step[1]
    parameters[0] -= step[0] + ex * along
    parameters[1] -= step[1] + ey * along


@fast_kernel
def _project(columns: AnyArray, sheared: AnyArray, patch: AnyArray) -> Float:
    """Derivatives times the difference of the patches (4,)."""
    b0 = b1 = b2 = b3 = np.float32(0.0)
    for j in range(patch.shape[0]):
        for i in range(patch.shape[1]):
            difference = sheared[j, i] - patch[j, i]
            b0 += columns[0, j, i] * difference
            b1 += columns[1, j, i] * difference
            b2 += columns[2, j, i] * difference
            b3 += columns[3, j, i] * difference
    return np.array([b0, b1, b2, b3], dtype=np.float64)


@fast_kernel
def _correlation(patch: AnyArray, other: AnyArray) -> float:
    """Normalised cross-correlation of a patch of zero mean with another."""
    product = square = total = own = np.float32(0.0)
    for j in range(patch.shape[0]):
        for i in range(patch.shape[1]):
            product += patch[j, i] * other[j, i]
            square += other[j, i] * other[j, i]
            total += other[j, i]
            own += patch[j, i] * patch[j, i]
    variance = square - total * total / np.float32(patch.size)
    if variance < 1e-3 or own < 1e-3:
        return -1.0
    return float(product) / np.sqrt(float(variance) * float(own))
