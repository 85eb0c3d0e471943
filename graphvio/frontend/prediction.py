"""Where points should be after a predicted motion, and how it deforms their surroundings."""

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.cameras import distort, fold_radius
from graphvio.kernels import kernel

_NEARER = 0.01  # 1/m, a small step
_MIN_AREA = 0.1  # a patch that has shrunk more than this is no longer comparable


@kernel
def predict_pixels(
    rays: Float, inverse_depths: Float, motion: Float, model: int, intrinsics: Float, distortion: Float
) -> tuple[Float, Float, Bool]:
    """Pixels and inverse depths of points after a motion.

    Args:
        rays: (N, 2) normalised coordinates before.
        inverse_depths: (N,) before, 1/m.
        motion: (4, 4) maps points before to points after.
        model: of the camera, with its ``intrinsics`` (4,) and ``distortion`` (5,).

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
    rays: Float, inverse_depths: Float, motion: Float, model: int, intrinsics: Float, distortion: Float
) -> tuple[Float, Bool]:
    """How a motion deforms the surroundings of points.

    Args:
        rays: (3, N, 2) normalised coordinates before, of each point's pixel, the next to its right, the next below.
        inverse_depths: (3, N) of what is seen there before, 1/m: where they differ, the surface is slanted.
        motion: (4, 4) maps points before to points after.
        model: of the camera, with its ``intrinsics`` (4,) and ``distortion`` (5,).

    Returns:
        Derivatives (N, 2, 2) of the pixel before by the pixel after, and whether each exists (N,).
    """
    n = inverse_depths.shape[1]
    warps, valid = np.zeros((n, 2, 2)), np.zeros(n, dtype=np.bool_)
    limit = fold_radius(model, distortion)
    for i in range(n):
        x, y, z = _moved(rays[0, i, 0], rays[0, i, 1], inverse_depths[0, i], motion)
        u, v, ok = _project(x, y, z, limit, model, intrinsics, distortion)
        x, y, z = _moved(rays[1, i, 0], rays[1, i, 1], inverse_depths[1, i], motion)
        u_right, v_right, ok_right = _project(x, y, z, limit, model, intrinsics, distortion)
        x, y, z = _moved(rays[2, i, 0], rays[2, i, 1], inverse_depths[2, i], motion)
        u_below, v_below, ok_below = _project(x, y, z, limit, model, intrinsics, distortion)
        a, b, c, d = u_right - u, u_below - u, v_right - v, v_below - v
        area = a * d - b * c
        if ok and ok_right and ok_below and area > _MIN_AREA:
            warps[i, 0, 0], warps[i, 0, 1] = d / area, -b / area
            warps[i, 1, 0], warps[i, 1, 1] = -c / area, a / area
            valid[i] = True
    return warps, valid


@kernel
def surface_inverse_depths(
    rays: Float, inverse_depths: Float, slopes: Float, right_T_left: Float, model: int, intrinsics: Float,
    distortion: Float,
) -> Float:  # fmt: skip
    """Inverse depths beside points, by what stereo matching says of the surface's slant.

    The right image shows a patch's surroundings shifted along the epipolar line, by the left pixel times the slope.
    The cameras' rotation and lenses make some of that shift; depth makes the rest.

    Args:
        rays: (3, N, 2) normalised coordinates in the left camera, of each point's pixel, the next to its right, the
            next below.
        inverse_depths: (N,) of the points, 1/m.
        slopes: (N, 2), see `graphvio.frontend.slanted`.
        right_T_left: (4, 4).
        model: of the right camera, with its ``intrinsics`` (4,) and ``distortion`` (5,).

    Returns:
        Inverse depths (3, N) at the three pixels; the point's own where its place in the right image is not known.
    """
    n = len(inverse_depths)
    beside = np.empty((3, n))
    limit = fold_radius(model, distortion)
    for i in range(n):
        w = inverse_depths[i]
        beside[:, i] = w
        x, y, z = _moved(rays[0, i, 0], rays[0, i, 1], w, right_T_left)
        u, v, ok = _project(x, y, z, limit, model, intrinsics, distortion)
        x, y, z = _moved(rays[0, i, 0], rays[0, i, 1], w + _NEARER, right_T_left)
        u_near, v_near, ok_near = _project(x, y, z, limit, model, intrinsics, distortion)
        along_u, along_v = (u_near - u) / _NEARER, (v_near - v) / _NEARER
        length = np.hypot(along_u, along_v)
        if not (ok and ok_near) or length < 1e-6:
            continue
        along_u, along_v = along_u / length, along_v / length
        for k in range(2):
            x, y, z = _moved(rays[k + 1, i, 0], rays[k + 1, i, 1], w, right_T_left)
            u_beside, v_beside, ok_beside = _project(x, y, z, limit, model, intrinsics, distortion)
            if ok_beside:
                by_lens = (u_beside - u) * along_u + (v_beside - v) * along_v
                as_if_flat = along_u if k == 0 else along_v
                beside[k + 1, i] += (slopes[i, k] + as_if_flat - by_lens) / length
    return beside


@kernel
def _moved(x: float, y: float, w: float, motion: Float) -> tuple[float, float, float]:
    """The point ``[x, y, 1, w]`` after a motion, up to scale: in units of the depth before it."""
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
    """Pixel of a point, and whether the camera's model reaches that far from its axis."""
    if not z > 1e-6 or not x * x + y * y < (limit * z) ** 2:
        return 0.0, 0.0, False
    xd, yd, a, b, c, d = distort(model, distortion, x / z, y / z)
    return (
        intrinsics[0] * xd + intrinsics[2],
        intrinsics[1] * yd + intrinsics[3],
        a * d - b * c > 0.0 and a > 0.0,
    )
