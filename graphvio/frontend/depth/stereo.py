"""Left-right matching along the epipolar curve, and triangulation with covariance (section 3).

A point is represented in the left camera's frame by its inverse depth, ``(x, y, w)`` with ``w = 1 / Z``: homogeneous
coordinates ``[x, y, 1, w]``. Points so far away that their depth is unknown are then as regular as any other, and
still constrain rotation.
"""

from collections.abc import Sequence

import numpy as np

from graphvio.arrays import AnyArray, Bool, Float, Image
from graphvio.cameras import distort, fold_radius
from graphvio.kernels import fast_kernel, kernel, put

HALF_PATCH = 5
HALF_COARSE_PATCH = 4
MAX_STEPS = 400  # of a search along an epipolar line
FINE_STEPS = 2  # of the half-sized image, to either side of the best place there
_AMBIGUOUS = 0.97
_GAUSS_NEWTON_STEPS = 4
_HALVINGS = 6

_Camera = tuple[Float, int, Float, Float, float]
"""right_T_left; model, intrinsics and distortion of the right camera; and the largest radius of its model."""


@kernel
def epipolar_search(
    left: Sequence[Image],
    right: Sequence[Image],
    pixels: Float,
    rays: Float,
    inverse_depths: Float,
    right_T_left: Float,
    model: int,
    intrinsics: Float,
    distortion: Float,
    min_correlation: float,
) -> tuple[Float, Bool, Bool]:
    """Search the right image for each corner along its epipolar curve, to the pixel.

    The curve is searched in images of half the size; the best place is then refined in the images of full size.

    Args:
        left: image (height, width), and the same in half the size.
        right: image (height, width), and the same in half the size.
        pixels: (N, 2) corners in the left image.
        rays: (N, 2) their normalised coordinates.
        inverse_depths: (N, 2) range that is searched, 1/m; near ends that the right camera's lens does not reach are
            left out.
        right_T_left: (4, 4) transform from the left to the right camera.
        model: number of the right camera's model.
        intrinsics: (4,) ``fx, fy, cx, cy`` of the right camera, pixels.
        distortion: (8,) distortion coefficients of the right camera.
        min_correlation: smallest normalised cross-correlation.

    Returns:
        Inverse depths (N,), 1/m; whether there is one clearly best place (N,); and whether any place looks like the
        corner (N,).
    """
    n = len(pixels)
    depths = np.zeros(n)
    found, alike = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    coarse, fine = empty_patch(HALF_COARSE_PATCH), empty_patch(HALF_PATCH)
    scores = np.empty(MAX_STEPS + 1)
    camera = (right_T_left, model, intrinsics, distortion, fold_radius(model, distortion))
    for i in range(n):
        x, y, w0, w1 = pixels[i, 0], pixels[i, 1], inverse_depths[i, 0], inverse_depths[i, 1]
        if not (_normalised_patch(left[1], 0.5 * x, 0.5 * y, coarse) and _normalised_patch(left[0], x, y, fine)):
            continue
        w1 = nearest_in_reach(rays[i], w0, w1, camera)
        best, steps = scan_curve(right[1], 0.5, coarse, rays[i], w0, w1, camera, scores)
        if steps == 0 or scores[best] < min_correlation:
            continue
        is_clear = not is_ambiguous(scores[: steps + 1], best)
        step = (w1 - w0) / steps
        w0, w1 = w0 + (best - FINE_STEPS) * step, w0 + (best + FINE_STEPS) * step
        best, steps = scan_curve(right[0], 1.0, fine, rays[i], w0, w1, camera, scores)
        if steps == 0 or scores[best] < min_correlation:
            continue
        depths[i], found[i], alike[i] = w0 + (w1 - w0) * best / steps, is_clear, True
    return depths, found, alike


@kernel
def nearest_in_reach(ray: Float, w0: float, w1: float, camera: _Camera) -> float:
    """Find, roughly, the largest inverse depth up to ``w1`` at which the right camera's model holds."""
    for _ in range(_HALVINGS):
        if _on_curve(ray, w1, camera)[2]:
            break
        w1 = 0.5 * (w0 + w1)
    return w1


@kernel
def scan_curve(
    image: Image, scale: float, patch: AnyArray, ray: Float, w0: float, w1: float, camera: _Camera, scores: Float,
) -> tuple[int, int]:  # fmt: skip
    """Fill a patch's correlations along its epipolar curve, a pixel apart, in an image scaled by ``scale``.

    Returns:
        Index of the best correlation, and the number of steps, 0 where the curve's ends are not in the image plane.
    """
    height, width = image.shape
    half = len(patch) // 2
    u0, v0, ok0 = _on_curve(ray, w0, camera)
    u1, v1, ok1 = _on_curve(ray, w1, camera)
    if not (ok0 and ok1):
        return 0, 0
    steps = min(max(int(scale * np.hypot(u1 - u0, v1 - v0)) + 1, 2), MAX_STEPS)
    best = 0
    for k in range(steps + 1):
        scores[k] = -1.0
        u, v, ok = _on_curve(ray, w0 + (w1 - w0) * k / steps, camera)
        x, y = round(scale * u), round(scale * v)
        if not ok or x < half or y < half or x >= width - half or y >= height - half:
            continue
        scores[k] = _correlation(image, int(x), int(y), patch)
        if scores[k] > scores[best]:
            best = k
    return best, steps


@kernel
def is_ambiguous(scores: Float, best: int) -> bool:
    """Check whether another place of the curve is nearly as good as the best, as in a texture that repeats."""
    for k in range(len(scores)):  # noqa: SIM110 (numba knows no generators)
        if abs(k - best) > FINE_STEPS and scores[k] > _AMBIGUOUS * scores[best]:
            return True
    return False


@kernel
def epipolar_lines(
    rays: Float, inverse_depths: Float, right_T_left: Float, model: int, intrinsics: Float, distortion: Float
) -> tuple[Float, Float, Bool]:
    """Project points of known depth into the right image.

    Args:
        rays: (N, 2) normalised coordinates in the left camera.
        inverse_depths: (N,) 1/m.
        right_T_left: (4, 4) transform from the left to the right camera.
        model: number of the right camera's model.
        intrinsics: (4,) ``fx, fy, cx, cy`` of the right camera, pixels.
        distortion: (8,) distortion coefficients of the right camera.

    Returns:
        Pixels (N, 2), the directions (N, 2) in which they move when they come nearer, and whether both exist (N,).
    """
    n = len(rays)
    pixels, directions, valid = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n, dtype=np.bool_)
    camera = (right_T_left, model, intrinsics, distortion, fold_radius(model, distortion))
    for i in range(n):
        w = inverse_depths[i]
        u, v, ok = _on_curve(rays[i], w, camera)
        u1, v1, ok1 = _on_curve(rays[i], w + 0.01, camera)
        length = np.hypot(u1 - u, v1 - v)
        if ok and ok1 and length > 1e-9:
            pixels[i, 0], pixels[i, 1] = u, v
            directions[i, 0], directions[i, 1] = (u1 - u) / length, (v1 - v) / length
            valid[i] = True
    return pixels, directions, valid


@kernel
def triangulate(
    left: Float, right: Float, right_T_left: Float, focal_left: float, focal_right: float
) -> tuple[Float, Float, Float]:
    """Triangulate points by least squared reprojection error in both images, with covariance for a pixel noise of 1 px.

    Args:
        left: (N, 2) normalised coordinates.
        right: (N, 2) normalised coordinates.
        right_T_left: (4, 4) transform from the left to the right camera.
        focal_left: focal length, pixels; the weight of the left image.
        focal_right: focal length, pixels; the weight of the right image.

    Returns:
        Points (N, 3) ``[x, y, 1/Z]`` in the left camera's frame, their covariances (N, 3, 3) per px^2, and the
        reprojection errors (N,) in pixels, which measure the distance from the epipolar line.
    """
    n = len(left)
    points = np.zeros((n, 3))
    covariances = np.zeros((n, 3, 3))
    errors = np.full(n, np.inf)
    r = right_T_left
    weight = focal_left * focal_left
    for i in range(n):
        a, b, w = left[i, 0], left[i, 1], 0.0
        for step in range(_GAUSS_NEWTON_STEPS + 1):
            y0 = r[0, 0] * a + r[0, 1] * b + r[0, 2] + w * r[0, 3]
            y1 = r[1, 0] * a + r[1, 1] * b + r[1, 2] + w * r[1, 3]
            y2 = r[2, 0] * a + r[2, 1] * b + r[2, 2] + w * r[2, 3]
            if y2 < 1e-3:
                break
            u, v, scale = y0 / y2, y1 / y2, focal_right / y2
            e0, e1 = focal_left * (left[i, 0] - a), focal_left * (left[i, 1] - b)
            e2, e3 = focal_right * (right[i, 0] - u), focal_right * (right[i, 1] - v)
            if step == _GAUSS_NEWTON_STEPS:
                points[i, 0], points[i, 1], points[i, 2] = a, b, w
                errors[i] = np.sqrt(e0 * e0 + e1 * e1 + e2 * e2 + e3 * e3)
                break
            # derivatives of (u, v) in pixels with respect to a, b, w
            ua, ub, uw = (
                scale * (r[0, 0] - u * r[2, 0]), scale * (r[0, 1] - u * r[2, 1]), scale * (r[0, 3] - u * r[2, 3]),
            )  # fmt: skip
            va, vb, vw = (
                scale * (r[1, 0] - v * r[2, 0]), scale * (r[1, 1] - v * r[2, 1]), scale * (r[1, 3] - v * r[2, 3]),
            )  # fmt: skip
            _invert_symmetric(
                weight + ua * ua + va * va, ua * ub + va * vb, ua * uw + va * vw,
                weight + ub * ub + vb * vb, ub * uw + vb * vw, uw * uw + vw * vw, covariances[i],
            )  # fmt: skip
            ga = focal_left * e0 + ua * e2 + va * e3
            gb = focal_left * e1 + ub * e2 + vb * e3
            gw = uw * e2 + vw * e3
            c = covariances[i]
            a += c[0, 0] * ga + c[0, 1] * gb + c[0, 2] * gw
            b += c[1, 0] * ga + c[1, 1] * gb + c[1, 2] * gw
            w += c[2, 0] * ga + c[2, 1] * gb + c[2, 2] * gw
    return points, covariances, errors


@kernel
def _invert_symmetric(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, inverse: Float) -> None:
    """Fill the inverse (3, 3) of a symmetric matrix."""
    cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    scale = 1.0 / (xx * cxx + xy * cxy + xz * cxz)
    inverse[0, 0] = cxx * scale
    inverse[0, 1] = inverse[1, 0] = cxy * scale
    inverse[0, 2] = inverse[2, 0] = cxz * scale
    inverse[1, 1] = (xx * zz - xz * xz) * scale
    inverse[1, 2] = inverse[2, 1] = (xy * xz - xx * yz) * scale
    inverse[2, 2] = (xx * yy - xy * xy) * scale


@kernel
def _on_curve(ray: Float, w: float, camera: _Camera) -> tuple[float, float, bool]:
    """Project the point of a ray at an inverse depth into the right image; False beyond the camera's model."""
    r, model, intrinsics, distortion, limit = camera
    z = r[2, 0] * ray[0] + r[2, 1] * ray[1] + r[2, 2] + w * r[2, 3]
    if z < 1e-3:
        return 0.0, 0.0, False
    x = (r[0, 0] * ray[0] + r[0, 1] * ray[1] + r[0, 2] + w * r[0, 3]) / z
    y = (r[1, 0] * ray[0] + r[1, 1] * ray[1] + r[1, 2] + w * r[1, 3]) / z
    if x * x + y * y >= limit * limit:
        return 0.0, 0.0, False
    xd, yd, _, _, _, _ = distort(model, distortion, x, y)
    return intrinsics[0] * xd + intrinsics[2], intrinsics[1] * yd + intrinsics[3], True


@kernel
def empty_patch(half: int) -> AnyArray:
    """Return room for a patch that reaches ``half`` pixels to each side."""
    return np.empty((2 * half + 1, 2 * half + 1), dtype=np.float32)


@kernel
def _normalised_patch(image: Image, x: float, y: float, patch: AnyArray) -> bool:
    """Fill a patch around (x, y) with zero mean and unit norm; False at the edge or without contrast."""
    cx, cy, side = round(x), round(y), len(patch)
    half = side // 2
    height, width = image.shape
    if cx < half or cy < half or cx >= width - half or cy >= height - half:
        return False
    left, top = int(cx) - half, int(cy) - half
    values = image[top : top + side, left : left + side].astype(np.float32)
    values -= np.mean(values)
    norm = np.sqrt(np.sum(values * values))
    if norm < 1e-6:
        return False
    put(patch, values / norm)
    return True


@fast_kernel
def _correlation(image: Image, cx: int, cy: int, patch: AnyArray) -> float:
    """Correlate a patch of zero mean and unit norm with the image around a pixel, normalised."""
    total = square = 0
    product = np.float32(0.0)
    side = len(patch)
    left, top = cx - side // 2, cy - side // 2
    for j in range(side):
        values, weights = image[top + j, left : left + side], patch[j]
        row = np.float32(0.0)  # a separate sum: a row need not wait for the one before
        for i in range(side):
            value = int(values[i])
            total += value
            square += value * value
            row += np.float32(value) * weights[i]
        product += row
    variance = square - float(total) * total / (side * side)
    if variance < 1e-3:
        return -1.0
    return float(product / np.sqrt(variance))
