"""Prediction of tracks: the pixels of points after a motion, and the deformation of their patches."""

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.cameras import distort, fold_radius
from graphvio.kernels import kernel

_RightCamera = tuple[Float, float, int, Float, Float]
"""right_T_left, the largest radius of the lens, model, intrinsics and distortion."""

_NEARER = 0.01  # 1/m, a small step of inverse depth
_BEND_STEP_PX = 4.0  # over which derivatives are compared: about half a patch
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
        intrinsics: (4,) ``fx, fy, cx, cy`` of the camera, pixels.
        distortion: (8,) distortion coefficients of the camera.

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
    the deformation's curvature shifts the patch as a whole. On a wall that the camera moves along, the curvature has
    the same sign all over, so that all points would seem to move too far.

    Args:
        rays: (5, N, 2) normalised coordinates before, see `around`.
        inverse_depths: (5, N) of the surface there, 1/m: where they differ, the surface is slanted.
        step_px: step of `around`.
        motion: (4, 4) maps points before to points after.
        model: number of the camera's model.
        intrinsics: (4,) ``fx, fy, cx, cy`` of the camera, pixels.
        distortion: (8,) distortion coefficients of the camera.

    Returns:
        Derivatives (N, 2, 2) of the pixel before with respect to the pixel after; halves of the second derivatives
        (N, 2, 2) of the pixel after, along the rows and along the columns before, 1/px; and whether both exist (N,).
    """
    n = inverse_depths.shape[1]
    warps, bends, valid = np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros(n, dtype=np.bool_)
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
        for axis in range(2):
            first, second = 2 * axis + 1, 2 * axis + 2
            bends[i, axis, 0] = (0.5 * (u[first] + u[second]) - u[0]) / (step_px * step_px)
            bends[i, axis, 1] = (0.5 * (v[first] + v[second]) - v[0]) / (step_px * step_px)
        valid[i] = True
    return warps, bends, valid


@kernel
def stereo_warps(
    rays: Float, inverse_depths: Float, right_T_left: Float,
    left_model: int, left_intrinsics: Float, left_distortion: Float,
    right_model: int, right_intrinsics: Float, right_distortion: Float,
) -> tuple[Float, Float]:  # fmt: skip
    """Compute the deformation of points' surroundings in the right image by lenses and the cameras' rotation.

    Args:
        rays: (N, 2) normalised coordinates in the left camera.
        inverse_depths: (N,) of the points and their surroundings, 1/m.
        right_T_left: (4, 4) transform from the left to the right camera.
        left_model: number of the left camera's model.
        left_intrinsics: (4,) ``fx, fy, cx, cy`` of the left camera, pixels.
        left_distortion: (8,) distortion coefficients of the left camera.
        right_model: number of the right camera's model.
        right_intrinsics: (4,) ``fx, fy, cx, cy`` of the right camera, pixels.
        right_distortion: (8,) distortion coefficients of the right camera.

    Returns:
        Derivatives (N, 2, 2) of the right pixel with respect to the left one, and halves of its second derivatives
        (N, 2, 2), along the left image's rows and along its columns, 1/px; the identity and zero where a camera's model
        does not reach that far.
    """
    n = len(rays)
    warps, bends = np.zeros((n, 2, 2)), np.zeros((n, 2, 2))
    limit = fold_radius(right_model, right_distortion)
    camera = (right_T_left, limit, right_model, right_intrinsics, right_distortion)
    here, there, warp = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    for i in range(n):
        warps[i, 0, 0] = warps[i, 1, 1] = 1.0
        x, y, w = rays[i, 0], rays[i, 1], inverse_depths[i]
        if not _ray_by_pixel(x, y, left_model, left_intrinsics, left_distortion, here) or not _warp_at(
            x, y, w, here, camera, warp
        ):
            continue
        for row in range(2):
            warps[i, row, 0], warps[i, row, 1] = warp[row, 0], warp[row, 1]
        for axis in range(2):
            u, v = x + _BEND_STEP_PX * here[0, axis], y + _BEND_STEP_PX * here[1, axis]
            if _ray_by_pixel(u, v, left_model, left_intrinsics, left_distortion, there) and _warp_at(
                u, v, w, there, camera, warp
            ):
                for row in range(2):
                    bends[i, axis, row] = 0.5 * (warp[row, axis] - warps[i, row, axis]) / _BEND_STEP_PX
    return warps, bends


@kernel
def _ray_by_pixel(x: float, y: float, model: int, intrinsics: Float, distortion: Float, out: Float) -> bool:
    """Fill the derivative (2, 2) of a ray with respect to its pixel; False where the lens does not reach that far."""
    _, _, a, b, c, d = distort(model, distortion, x, y)
    area = a * d - b * c
    if not area > 0.0:
        return False
    out[0, 0], out[0, 1] = d / (area * intrinsics[0]), -b / (area * intrinsics[1])
    out[1, 0], out[1, 1] = -c / (area * intrinsics[0]), a / (area * intrinsics[1])
    return True


@kernel
def _warp_at(x: float, y: float, w: float, ray_by_pixel: Float, camera: _RightCamera, out: Float) -> bool:
    """Fill the derivative (2, 2) of the right pixel with respect to the left one; False outside the right lens."""
    m, limit, model, intrinsics, distortion = camera
    u, v, z = _moved(x, y, w, m)
    if not z > 1e-6 or not u * u + v * v < (limit * z) ** 2:
        return False
    u, v = u / z, v / z
    _, _, a, b, c, d = distort(model, distortion, u, v)
    for k in range(2):
        by_x = ray_by_pixel[0, k] * (m[0, 0] - u * m[2, 0]) + ray_by_pixel[1, k] * (m[0, 1] - u * m[2, 1])
        by_y = ray_by_pixel[0, k] * (m[1, 0] - v * m[2, 0]) + ray_by_pixel[1, k] * (m[1, 1] - v * m[2, 1])
        out[0, k], out[1, k] = intrinsics[0] * (a * by_x + b * by_y) / z, intrinsics[1] * (c * by_x + d * by_y) / z
    return bool(a * d - b * c > 0.0 and a > 0.0)


def patch_deviation_px(half: int) -> float:
    """Return the standard deviation of a pixel coordinate over a patch of ``2 half + 1`` pixels on each side."""
    return float(np.sqrt(half * (half + 1) / 3.0))


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

    Args:
        rays: (5, N, 2) normalised coordinates in the left camera, see `around`.
        inverse_depths: (N,) of the points, 1/m.
        slopes: (N, 2) slopes of the disparity, see `graphvio.frontend.depth.slanted`.
        step_px: step of `around`.
        right_T_left: (4, 4) transform from the left to the right camera.
        model: number of the right camera's model.
        intrinsics: (4,) ``fx, fy, cx, cy`` of the right camera, pixels.
        distortion: (8,) distortion coefficients of the right camera.

    Returns:
        Inverse depths (5, N) of the surface's plane; the point's own where the right image does not show it.
    """
    n = len(inverse_depths)
    depths = np.empty((5, n))
    limit = fold_radius(model, distortion)
    for i in range(n):
        w = inverse_depths[i]
        depths[:, i] = w
        x, y, z = _moved(rays[0, i, 0], rays[0, i, 1], w, right_T_left)
        u, v, ok = _project(x, y, z, limit, model, intrinsics, distortion)
        x, y, z = _moved(rays[0, i, 0], rays[0, i, 1], w + _NEARER, right_T_left)
        near_u, near_v, also_ok = _project(x, y, z, limit, model, intrinsics, distortion)
        length = np.hypot(near_u - u, near_v - v) / _NEARER  # pixels for an inverse depth of 1/m
        if not (ok and also_ok) or length < 1e-6:
            continue
        rightwards, downwards = 2.0 * step_px * slopes[i, 0] / length, 2.0 * step_px * slopes[i, 1] / length
        a, c = rays[2, i, 0] - rays[1, i, 0], rays[2, i, 1] - rays[1, i, 1]
        b, d = rays[4, i, 0] - rays[3, i, 0], rays[4, i, 1] - rays[3, i, 1]
        # A plane's inverse depth is linear in normalised coordinates, which are not linear in pixels.
        determinant = a * d - b * c
        if not determinant > 0.0:  # next to the edge of what the lens can see
            continue
        by_x, by_y = (rightwards * d - downwards * c) / determinant, (downwards * a - rightwards * b) / determinant
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
