"""Camera models: pinhole with radial-tangential distortion, and equidistant (Kannala-Brandt) fisheye.

Frame ``cam``: x right, y down, z forward; pixel (0, 0) is the centre of the upper left pixel. A model is given
by its number, ``intrinsics`` (4,) ``[fx, fy, cx, cy]`` in pixels and ``distortion`` (5,):
``[k1, k2, p1, p2, k3]`` (radial-tangential, OpenCV's order) or ``[k1, k2, k3, k4, 0]`` (equidistant).
Normalised image coordinates are ``(X / Z, Y / Z)``, the paper's ``h`` (section 3): the half-space behind the camera
has none, and rays beyond 80 degrees from the axis are invalid.
"""

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.kernels import kernel

RADIAL_TANGENTIAL = 0
EQUIDISTANT = 1
MODEL_NAMES = {"radial-tangential": RADIAL_TANGENTIAL, "equidistant": EQUIDISTANT}

MAX_ANGLE_RAD = np.deg2rad(80.0)
_MAX_TAN = float(np.tan(MAX_ANGLE_RAD))
_NEWTON_STEPS = 20
_NEWTON_TOLERANCE = 1e-12


@kernel
def distort(model: int, distortion: Float, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """Compute the distorted normalised coordinates of (x, y), and their Jacobian (2, 2).

    Returns:
        ``(xd, yd, dxd/dx, dxd/dy, dyd/dx, dyd/dy)``.
    """
    r2 = x * x + y * y
    if model == RADIAL_TANGENTIAL:
        k1, k2, p1, p2, k3 = distortion[0], distortion[1], distortion[2], distortion[3], distortion[4]
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))  # d radial / d r2, times 2
        xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        cross = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        return (
            xd,
            yd,
            radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            cross,
            cross,
            radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        )
    r = np.sqrt(r2)
    if r < 1e-8:
        return x, y, 1.0, 0.0, 0.0, 1.0
    theta = np.arctan(r)
    t2 = theta * theta
    k1, k2, k3, k4 = distortion[0], distortion[1], distortion[2], distortion[3]
    theta_d = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    slope_theta = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    scale = theta_d / r
    dscale = (slope_theta / (1.0 + r2) - scale) / r2  # (d scale / d r) / r
    return (x * scale, y * scale, scale + x * x * dscale, x * y * dscale, x * y * dscale, scale + y * y * dscale)


@kernel
def distortion_basis(model: int, x: float, y: float) -> Float:
    """Compute the derivatives (5, 2) of the distorted normalised coordinates of (x, y) by the coefficients.

    Both models are linear in these.
    """
    basis = np.zeros((5, 2))
    r2 = x * x + y * y
    if model == RADIAL_TANGENTIAL:
        basis[0, 0], basis[0, 1] = x * r2, y * r2
        basis[1, 0], basis[1, 1] = x * r2 * r2, y * r2 * r2
        basis[2, 0], basis[2, 1] = 2.0 * x * y, r2 + 2.0 * y * y
        basis[3, 0], basis[3, 1] = r2 + 2.0 * x * x, 2.0 * x * y
        basis[4, 0], basis[4, 1] = x * r2 * r2 * r2, y * r2 * r2 * r2
        return basis
    r = np.sqrt(r2)
    if r > 1e-8:
        theta = np.arctan(r)
        power, t2 = theta / r, theta * theta
        for i in range(4):
            power *= t2
            basis[i, 0], basis[i, 1] = x * power, y * power
    return basis


@kernel
def undistort(model: int, distortion: Float, xd: float, yd: float) -> tuple[float, float, bool]:
    """Find the normalised coordinates whose distortion is (xd, yd), by Newton's method; False where there are none."""
    x, y = xd, yd
    if model == EQUIDISTANT:
        theta_d = np.sqrt(xd * xd + yd * yd)
        if theta_d < 1e-8:
            return xd, yd, True
        theta = theta_d
        for _ in range(_NEWTON_STEPS):
            t2 = theta * theta
            k1, k2, k3, k4 = distortion[0], distortion[1], distortion[2], distortion[3]
            error = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - theta_d
            step = error / (1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4))))
            theta -= step
            if abs(step) < _NEWTON_TOLERANCE:
                break
        if not 0.0 <= theta < MAX_ANGLE_RAD or abs(step) > 1e-6:
            return 0.0, 0.0, False
        scale = np.tan(theta) / theta_d
        return xd * scale, yd * scale, True
    for _ in range(_NEWTON_STEPS):
        u, v, a, b, c, d = distort(model, distortion, x, y)
        ex, ey = u - xd, v - yd
        determinant = a * d - b * c
        step_x = (d * ex - b * ey) / determinant
        step_y = (a * ey - c * ex) / determinant
        x -= step_x
        y -= step_y
        if abs(step_x) + abs(step_y) < _NEWTON_TOLERANCE:
            break
    # Beyond the radius where distortion folds back, Newton lands on a point whose Jacobian is not positive.
    u, v, a, b, c, d = distort(model, distortion, x, y)
    converged = abs(u - xd) + abs(v - yd) < 1e-8 and a * d - b * c > 0.0 and a > 0.0
    return x, y, converged and x * x + y * y < _MAX_TAN * _MAX_TAN


@kernel
def fold_radius(model: int, distortion: Float) -> float:
    """Find the normalised radius from which distortion maps outer points inwards again, at most tan(80 degrees)."""
    radius = 0.0
    while radius < _MAX_TAN:
        _, _, slope, _, _, _ = distort(model, distortion, radius, 0.0)
        _, _, _, _, _, slope_y = distort(model, distortion, 0.0, radius)
        if slope <= 0.0 or slope_y <= 0.0:
            return radius
        radius += 0.01
    return _MAX_TAN


@kernel
def project_points(model: int, intrinsics: Float, distortion: Float, points: Float) -> tuple[Float, Bool]:
    """Project points to pixels.

    Args:
        model: number of the model.
        intrinsics: (4,) pixels.
        distortion: (5,).
        points: (N, 3) metres, frame cam.

    Returns:
        Pixels (N, 2) and whether each is valid (N,): in front of the camera and within 80 degrees of its axis.
    """
    n = len(points)
    pixels = np.zeros((n, 2))
    valid = np.zeros(n, dtype=np.bool_)
    limit = fold_radius(model, distortion)
    for i in range(n):
        z = points[i, 2]
        if not z > 1e-6:  # also rejects NaN
            continue
        x, y = points[i, 0] / z, points[i, 1] / z
        if not x * x + y * y < limit * limit:
            continue
        xd, yd, a, b, c, d = distort(model, distortion, x, y)
        pixels[i, 0] = intrinsics[0] * xd + intrinsics[2]
        pixels[i, 1] = intrinsics[1] * yd + intrinsics[3]
        valid[i] = a * d - b * c > 0.0 and a > 0.0
    return pixels, valid


@kernel
def unproject_pixels(model: int, intrinsics: Float, distortion: Float, pixels: Float) -> tuple[Float, Bool]:
    """Compute the normalised image coordinates (N, 2) of pixels (N, 2), and whether each exists (N,)."""
    n = len(pixels)
    normalised = np.zeros((n, 2))
    valid = np.zeros(n, dtype=np.bool_)
    for i in range(n):
        xd = (pixels[i, 0] - intrinsics[2]) / intrinsics[0]
        yd = (pixels[i, 1] - intrinsics[3]) / intrinsics[1]
        x, y, ok = undistort(model, distortion, xd, yd)
        if ok:
            normalised[i, 0], normalised[i, 1], valid[i] = x, y, True
    return normalised, valid
