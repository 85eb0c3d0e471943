"""Prediction of tracks: where a motion puts points, and how it deforms their surroundings."""

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.cameras import distort, fold_radius
from graphvio.kernels import kernel

_NEARER = 0.01  # 1/m, a small step of inverse depth
_MIN_AREA = 0.1  # a patch that has shrunk more than this is no longer comparable


@kernel
def predict_pixels(
    rays: Float, inverse_depths: Float, motion: Float, model: int, intrinsics: Float, distortion: Float
) -> tuple[Float, Float, Bool]:
    """Predict pixels and inverse depths of points after a motion.

    Args:
        rays: (N, 2) normalised coordinates before.
        inverse_depths: (N,) before, 1/m.
        motion: (4, 4) maps points before to points after.
        model: number of the camera's model.
        intrinsics: (4,) of the camera.
        distortion: (8,) of the camera.

    Returns:
        Pixels (N, 2), inverse depths (N,), and whether each point is in front of the camera (N,).
    """
    n = len(rays)
    pixels, moved, valid = np.zeros((n, 2)), np.zeros(n), np.zeros(n, dtype=np.bool_)
    limit = fold_radius(model, distortion)
    for i in range(n):
        x, y, z = _moved(rays[i, 0], rays[i, 1], inverse_depths[i], motion)
        pixels[i, 0], pixels[i, 1], valid[i] = _project(x, y, z, limit, model, intrinsics, distortion)
        if valid[i]:
            moved[i] = inverse_depths[i] / z
    return pixels, moved, valid


@kernel
def predict_warps(
    rays: Float, inverse_depths: Float, step_px: float, motion: Float, model: int, intrinsics: Float, distortion: Float
) -> tuple[Float, Float, Bool]:
    """Predict how a motion deforms the surroundings of points.

    The affine map that is nearest to the deformation over a whole patch is not the one that is right at its centre:
    the deformation's curvature shifts the patch as a whole. Along a wall that one walks by it has the same sign all
    over, so that all points would seem to move too far.

    Args:
        rays: (5, N, 2) normalised coordinates before, see `around`.
        inverse_depths: (5, N) of the surface there, 1/m: where they differ, the surface is slanted.
        step_px: of `around`.
        motion: (4, 4) maps points before to points after.
        model: number of the camera's model.
        intrinsics: (4,) of the camera.
        distortion: (8,) of the camera.

    Returns:
        Derivatives (N, 2, 2) of the pixel before with respect to the pixel after; the shift (N, 2) of the affine map's
        centre from the point, in the image before, pixels; and whether both exist (N,).
    """
    n = inverse_depths.shape[1]
    warps, shifts, valid = np.zeros((n, 2, 2)), np.zeros((n, 2)), np.zeros(n, dtype=np.bool_)
    limit = fold_radius(model, distortion)
    u, v = np.empty(5), np.empty(5)
    for i in range(n):
        all_ok = True
        for k in range(5):
            x, y, z = _moved(rays[k, i, 0], rays[k, i, 1], inverse_depths[k, i], motion)
            u[k], v[k], ok = _project(x, y, z, limit, model, intrinsics, distortion)
            all_ok &= ok
        if not all_ok:
            continue
        a, b = (u[2] - u[1]) / (2.0 * step_px), (u[4] - u[3]) / (2.0 * step_px)
        c, d = (v[2] - v[1]) / (2.0 * step_px), (v[4] - v[3]) / (2.0 * step_px)
        area = a * d - b * c
        if area < _MIN_AREA:
            continue
        warps[i, 0, 0], warps[i, 0, 1] = d / area, -b / area
        warps[i, 1, 0], warps[i, 1, 1] = -c / area, a / area
        mean_u, mean_v = 0.5 * (u[1] + u[2] + u[3] + u[4]) - 2.0 * u[0], 0.5 * (v[1] + v[2] + v[3] + v[4]) - 2.0 * v[0]
        shifts[i, 0] = -warps[i, 0, 0] * mean_u - warps[i, 0, 1] * mean_v
        shifts[i, 1] = -warps[i, 1, 0] * mean_u - warps[i, 1, 1] * mean_v
        valid[i] = True
    return warps, shifts, valid


def around(pixels: Float, step_px: float) -> Float:
    """Return pixels (5, N, 2): those given (N, 2), and those a step to their left, right, above and below."""
    steps = np.array([[0.0, 0.0], [-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    return np.asarray(pixels + step_px * steps[:, None])


@kernel
def inverse_depths_around(
    rays: Float, inverse_depths: Float, slopes: Float, step_px: float, right_T_left: Float, model: int,
    intrinsics: Float, distortion: Float,
) -> Float:  # fmt: skip
    """Compute the inverse depths around points from the slant of their surface, which stereo matching measured.

    The right image shows a patch's surroundings shifted along the epipolar line, by the left pixel times the slope.
    The cameras' rotation and lenses account for a part of that shift, depth for the remainder.

    Args:
        rays: (5, N, 2) normalised coordinates in the left camera, see `around`.
        inverse_depths: (N,) of the points, 1/m.
        slopes: (N, 2), see `graphvio.frontend.slanted`.
        step_px: of `around`.
        right_T_left: (4, 4).
        model: number of the right camera's model.
        intrinsics: (4,) of the right camera.
        distortion: (8,) of the right camera.

    Returns:
        Inverse depths (5, N) of the surface's plane; the point's own where the right image does not show it.
    """
    n = len(inverse_depths)
    depths = np.empty((5, n))
    limit = fold_radius(model, distortion)
    u, v = np.empty(5), np.empty(5)
    changes, steps = np.empty(2), np.empty((2, 2))  # of inverse depth and ray, from left to right and downwards
    for i in range(n):
        w = inverse_depths[i]
        depths[:, i] = w
        x, y, z = _moved(rays[0, i, 0], rays[0, i, 1], w + _NEARER, right_T_left)
        near_u, near_v, all_ok = _project(x, y, z, limit, model, intrinsics, distortion)
        for k in range(5):
            x, y, z = _moved(rays[k, i, 0], rays[k, i, 1], w, right_T_left)
            u[k], v[k], ok = _project(x, y, z, limit, model, intrinsics, distortion)
            all_ok &= ok
        along_u, along_v = (near_u - u[0]) / _NEARER, (near_v - v[0]) / _NEARER
        length = np.hypot(along_u, along_v)  # pixels for an inverse depth of 1/m
        if not all_ok or length < 1e-6:
            continue
        along_u, along_v = along_u / length, along_v / length
        for k in range(2):
            left, right = 2 * k + 1, 2 * k + 2
            flat = ((u[right] - u[left]) * along_u + (v[right] - v[left]) * along_v) / (2.0 * step_px)
            seen = slopes[i, k] + (along_u if k == 0 else along_v)
            changes[k] = 2.0 * step_px * (seen - flat) / length
            steps[k, 0], steps[k, 1] = rays[right, i, 0] - rays[left, i, 0], rays[right, i, 1] - rays[left, i, 1]
        # A plane's inverse depth is linear in normalised coordinates, which are not linear in pixels.
        determinant = steps[0, 0] * steps[1, 1] - steps[0, 1] * steps[1, 0]
        if not determinant > 0.0:  # next to the edge of what the lens can see
            continue
        by_x = (changes[0] * steps[1, 1] - changes[1] * steps[0, 1]) / determinant
        by_y = (changes[1] * steps[0, 0] - changes[0] * steps[1, 0]) / determinant
        for k in range(1, 5):
            depths[k, i] += by_x * (rays[k, i, 0] - rays[0, i, 0]) + by_y * (rays[k, i, 1] - rays[0, i, 1])
    return depths


@kernel
def _moved(x: float, y: float, w: float, motion: Float) -> tuple[float, float, float]:
    """Move a point ``[x, y, 1, w]``; the result is up to scale, in units of the depth before."""
    m = motion
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] + w * m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] + w * m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] + w * m[2, 3],
    )


@kernel
def _project(
    x: float, y: float, z: float, limit: float, model: int, intrinsics: Float, distortion: Float
) -> tuple[float, float, bool]:
    """Project a point to a pixel; False where the camera's model does not reach that far from its axis."""
    if not z > 1e-6 or not x * x + y * y < (limit * z) ** 2:
        return 0.0, 0.0, False
    xd, yd, a, b, c, d = distort(model, distortion, x / z, y / z)
    return (intrinsics[0] * xd + intrinsics[2], intrinsics[1] * yd + intrinsics[3], a * d - b * c > 0.0 and a > 0.0)
