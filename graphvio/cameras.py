"""Lens models: kernels that map normalised image coordinates to distorted ones and pixels, and back.

Frame ``cam``: x right, y down, z forward; pixel (0, 0) is the centre of the upper left pixel. A model is given
by its number, ``intrinsics`` (4,) ``[fx, fy, cx, cy]`` in pixels and ``distortion`` (8,), the coefficients of
`COEFFICIENTS` in their order, filled with zeros. Normalised image coordinates are ``(X / Z, Y / Z)``, the paper's ``h``
(section 3): the half-space behind the camera has none, and rays beyond 80 degrees from the axis are invalid, whatever
the model could represent. Distorted coordinates are those that ``intrinsics`` map to pixels.

- ``radial-tangential`` and ``rational``: D. C. Brown, *Close-range camera calibration*, 1971, in OpenCV's order; the
  second with the denominator of OpenCV's rational polynomial;
- ``equidistant``: J. Kannala and S. Brandt, *A generic camera model and calibration method for conventional,
  wide-angle, and fish-eye lenses*, 2006, with four coefficients as in OpenCV's fisheye;
- ``double-sphere``: V. Usenko, N. Demmel and D. Cremers, *The double sphere camera model*, 2018;
- ``extended-unified``: B. Khomutenko, G. Garcia and P. Martinet, *An enhanced unified camera model*, 2016;
- ``omnidirectional``: C. Mei and P. Rives, *Single view point omnidirectional camera calibration from planar grids*,
  2007: the unified model, then radial-tangential distortion.

The last three share one formula here, and are called sphere models: a point is projected to the unit sphere, shifted
along the axis by `xi`, projected to a second sphere, or with `beta` to an ellipsoid, and from there to the image plane
from a centre that `alpha` sets.
"""

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.kernels import kernel

# The order matters: models below DOUBLE_SPHERE are polynomials (of a point in the plane, or of its angle) or ratios of
# them; from DOUBLE_SPHERE on they are sphere models. A new polynomial model must be numbered below DOUBLE_SPHERE.
RADIAL_TANGENTIAL = 0
EQUIDISTANT = 1
RATIONAL = 2
DOUBLE_SPHERE = 3
EXTENDED_UNIFIED = 4
OMNIDIRECTIONAL = 5
MODEL_NAMES = {
    "radial-tangential": RADIAL_TANGENTIAL,
    "equidistant": EQUIDISTANT,
    "rational": RATIONAL,
    "double-sphere": DOUBLE_SPHERE,
    "extended-unified": EXTENDED_UNIFIED,
    "omnidirectional": OMNIDIRECTIONAL,
}

N_COEFFICIENTS = 8
"""Length of the array ``distortion`` of every model."""
COEFFICIENTS = {
    "radial-tangential": ("k1", "k2", "p1", "p2", "k3"),
    "equidistant": ("k1", "k2", "k3", "k4"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "double-sphere": ("xi", "alpha"),
    "extended-unified": ("alpha", "beta"),
    "omnidirectional": ("xi", "k1", "k2", "p1", "p2"),
}
"""Coefficients of each model, in the order of ``distortion``."""
N_ESTIMATED = 5
"""The self-calibration estimates at most this many coefficients, the first ones; those of a denominator stay fixed."""

MAX_ANGLE_RAD = np.deg2rad(80.0)
_MAX_TAN = float(np.tan(MAX_ANGLE_RAD))
_NEWTON_STEPS = 20
_MORE_STEPS = 60  # polynomials of high degree approach their solution slowly from far away
_NEWTON_TOLERANCE = 1e-12
_BISECTIONS = 20
_CHECKS = 8


@kernel
def distort(model: int, distortion: Float, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """Compute the distorted normalised coordinates of (x, y), and their Jacobian (2, 2).

    Returns:
        ``(xd, yd, dxd/dx, dxd/dy, dyd/dx, dyd/dy)``; outside the domain of a rational or sphere model, (x, y) with
        the Jacobian ``-I``, which marks the result as invalid.
    """
    if model == EQUIDISTANT:
        r2 = x * x + y * y
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
    if model < DOUBLE_SPHERE:
        return _polynomial(model, distortion, x, y)
    scale, dscale = _sphere(model, distortion, x, y)
    if not scale > 0.0:
        return x, y, -1.0, 0.0, 0.0, -1.0
    u, v = x * scale, y * scale
    ux, uy, vy = scale + x * x * dscale, x * y * dscale, scale + y * y * dscale
    if model != OMNIDIRECTIONAL:
        return u, v, ux, uy, uy, vy
    xd, yd, a, b, c, d = _polynomial(model, distortion, u, v)
    return xd, yd, a * ux + b * uy, a * uy + b * vy, c * ux + d * uy, c * uy + d * vy


@kernel
def _polynomial(model: int, distortion: Float, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """Apply radial and tangential distortion, with a denominator for ``rational``; returns the same as `distort`.

    The other models are computed without a division, and so without its rounding.
    """
    first = 1 if model == OMNIDIRECTIONAL else 0
    k1, k2, p1, p2 = distortion[first], distortion[first + 1], distortion[first + 2], distortion[first + 3]
    k3 = 0.0 if model == OMNIDIRECTIONAL else distortion[4]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))  # d radial / d r2, times 2
    if model == RATIONAL:
        k4, k5, k6 = distortion[5], distortion[6], distortion[7]
        denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        if not denominator > 0.0:
            return x, y, -1.0, 0.0, 0.0, -1.0
        radial /= denominator
        slope = (slope - radial * 2.0 * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))) / denominator
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


@kernel
def _sphere_shape(model: int, distortion: Float) -> tuple[float, float, float]:
    """Return ``(xi, alpha, beta)`` of a model with a sphere."""
    if model == DOUBLE_SPHERE:
        return distortion[0], distortion[1], 1.0
    if model == EXTENDED_UNIFIED:
        return 0.0, distortion[0], distortion[1]
    return distortion[0], 0.0, 1.0


@kernel
def _sphere(model: int, distortion: Float, x: float, y: float) -> tuple[float, float]:
    """Compute the factor by which a sphere model scales (x, y), and ``(d scale / d r) / r``; 0 outside the domain.

    The domain is that of Usenko et al., (43) to (45), without their approximation to first order in xi: the domain
    ``z > -w d`` of the unified model, applied at the second sphere.
    """
    xi, alpha, beta = _sphere_shape(model, distortion)
    r2 = x * x + y * y
    d1 = np.sqrt(1.0 + r2)
    z = 1.0 + xi * d1  # at the second sphere
    d2 = np.sqrt(beta * r2 + z * z)
    denominator = alpha * d2 + (1.0 - alpha) * z
    if not (denominator > 0.0 and (1.0 - alpha) * d2 + alpha * z > 0.0):
        return 0.0, 0.0
    scale = 1.0 / denominator
    slope = alpha * (beta + z * xi / d1) / d2 + (1.0 - alpha) * xi / d1  # (d denominator / d r) / r
    return scale, -slope * scale * scale


@kernel
def distortion_basis(model: int, distortion: Float, x: float, y: float) -> Float:
    """Compute derivatives (5, 2) of the distorted coordinates of (x, y) with respect to the first five coefficients.

    They are zero for coefficients that the model does not have, and outside the domain of a sphere model.
    """
    basis = np.zeros((N_ESTIMATED, 2))
    if model == EQUIDISTANT:
        r2 = x * x + y * y
        r = np.sqrt(r2)
        if r > 1e-8:
            theta = np.arctan(r)
            power, t2 = theta / r, theta * theta
            for i in range(4):
                power *= t2
                basis[i, 0], basis[i, 1] = x * power, y * power
        return basis
    first, scale = 0, 1.0
    if model >= DOUBLE_SPHERE:
        on_plane, by_xi, by_alpha, by_beta = _sphere_derivatives(model, distortion, x, y)
        if model != OMNIDIRECTIONAL:
            one, other = (by_xi, by_alpha) if model == DOUBLE_SPHERE else (by_alpha, by_beta)
            basis[0, 0], basis[0, 1], basis[1, 0], basis[1, 1] = x * one, y * one, x * other, y * other
            return basis
        first, u, v = 1, x * on_plane, y * on_plane
        _, _, a, b, c, d = _polynomial(model, distortion, u, v)
        basis[0, 0], basis[0, 1] = (a * x + b * y) * by_xi, (c * x + d * y) * by_xi
        x, y = u, v
    r2 = x * x + y * y
    if model == RATIONAL:
        scale = 1.0 / (1.0 + r2 * (distortion[5] + r2 * (distortion[6] + r2 * distortion[7])))
    basis[first, 0], basis[first, 1] = x * r2 * scale, y * r2 * scale
    basis[first + 1, 0], basis[first + 1, 1] = x * r2 * r2 * scale, y * r2 * r2 * scale
    basis[first + 2, 0], basis[first + 2, 1] = 2.0 * x * y, r2 + 2.0 * y * y
    basis[first + 3, 0], basis[first + 3, 1] = r2 + 2.0 * x * x, 2.0 * x * y
    if first == 0:
        basis[4, 0], basis[4, 1] = x * r2 * r2 * r2 * scale, y * r2 * r2 * r2 * scale
    return basis


@kernel
def _sphere_derivatives(model: int, distortion: Float, x: float, y: float) -> tuple[float, float, float, float]:
    """Compute `_sphere`'s scale and derivatives with respect to xi, alpha and beta; 0 outside the model's domain."""
    scale, _ = _sphere(model, distortion, x, y)
    if not scale > 0.0:
        return 0.0, 0.0, 0.0, 0.0
    xi, alpha, beta = _sphere_shape(model, distortion)
    r2 = x * x + y * y
    d1 = np.sqrt(1.0 + r2)
    z = 1.0 + xi * d1
    d2 = np.sqrt(beta * r2 + z * z)
    by_denominator = -scale * scale
    by_xi, by_alpha, by_beta = (alpha * z / d2 + 1.0 - alpha) * d1, d2 - z, 0.5 * alpha * r2 / d2
    return scale, by_denominator * by_xi, by_denominator * by_alpha, by_denominator * by_beta


@kernel
def undistort(model: int, distortion: Float, xd: float, yd: float) -> tuple[float, float, bool]:
    """Find the normalised coordinates whose distorted ones are (xd, yd); False if there are none within 80 degrees."""
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
    x, y, z, found = ray_of(model, distortion, xd, yd)
    if model >= DOUBLE_SPHERE:
        if not (found and z > 0.0):
            return 0.0, 0.0, False
        x, y = x / z, y / z
    return x, y, found and x * x + y * y < _MAX_TAN * _MAX_TAN


@kernel
def ray_of(model: int, distortion: Float, xd: float, yd: float) -> tuple[float, float, float, bool]:
    """Find the direction whose distorted coordinates are (xd, yd), at any angle; not for ``equidistant``.

    Polynomials are inverted by Newton's method, sphere models in closed form: Usenko et al., (46) to (50).

    Returns:
        The direction ``(x, y, z)``, not normalised, and whether there is one.
    """
    x, y, converged = xd, yd, True
    if model < DOUBLE_SPHERE or model == OMNIDIRECTIONAL:
        x, y, converged = _inverse_polynomial(model, distortion, xd, yd)
        if model != OMNIDIRECTIONAL:
            return x, y, 1.0, converged
    xi, alpha, beta = _sphere_shape(model, distortion)
    r2 = x * x + y * y
    radicand = 1.0 - (2.0 * alpha - 1.0) * beta * r2
    if not radicand >= 0.0:
        return 0.0, 0.0, 0.0, False
    z = (1.0 - beta * alpha * alpha * r2) / (alpha * np.sqrt(radicand) + 1.0 - alpha)
    if model == EXTENDED_UNIFIED:
        return x, y, z, converged
    radicand = z * z + (1.0 - xi * xi) * r2
    if not radicand >= 0.0:
        return 0.0, 0.0, 0.0, False
    length = (z * xi + np.sqrt(radicand)) / (z * z + r2)
    return length * x, length * y, length * z - xi, converged and length > 0.0


@kernel
def fold_radius(model: int, distortion: Float) -> float:
    """Find the normalised radius from which distortion maps outer points inwards again, at most tan(80 degrees).

    For a model with a smaller domain it is the radius of the domain, where `distort` returns a negative slope.
    """
    radius = 0.0
    while radius < _MAX_TAN:
        for axis in range(2):
            x, y = (radius, 0.0) if axis == 0 else (0.0, radius)
            _, _, slope_x, _, _, slope_y = distort(model, distortion, x, y)
            if (slope_x if axis == 0 else slope_y) <= 0.0:
                return radius
        radius += 0.01
    return _MAX_TAN


@kernel
def _inverse_polynomial(model: int, distortion: Float, xd: float, yd: float) -> tuple[float, float, bool]:
    """Invert `_polynomial` by Newton's method; False where it does not converge."""
    x, y = xd, yd
    for attempt in range(2 if model == RATIONAL else 1):
        if attempt == 1:  # a ratio of polynomials may be so curved that Newton's method leaves the domain or oscillates
            x, y = _within_fold(model, distortion, xd, yd)
        x, y, found = _newton(model, distortion, xd, yd, x, y)
        if found and (model != RATIONAL or _is_before_fold(model, distortion, x, y)):
            return x, y, True
    return x, y, False


@kernel
def _is_before_fold(model: int, distortion: Float, x: float, y: float) -> bool:
    """Return whether distortion maps outer points outwards at 7 points between the axis and (x, y)."""
    for i in range(1, _CHECKS):
        share = i / _CHECKS
        _, _, a, b, c, d = _polynomial(model, distortion, share * x, share * y)
        if not (a > 0.0 and a * d - b * c > 0.0):
            return False
    return True


@kernel
def _within_fold(model: int, distortion: Float, xd: float, yd: float) -> tuple[float, float]:
    """Find by bisection the point towards (xd, yd), within the fold radius, that is distorted to the same radius."""
    distance, inner, outer = np.sqrt(xd * xd + yd * yd), 0.0, fold_radius(model, distortion)
    for _ in range(_BISECTIONS):
        radius = 0.5 * (inner + outer)
        u, v, _, _, _, _ = _polynomial(model, distortion, radius * xd / distance, radius * yd / distance)
        if u * xd + v * yd < distance * distance:
            inner = radius
        else:
            outer = radius
    return inner * xd / distance, inner * yd / distance


@kernel
def _newton(model: int, distortion: Float, xd: float, yd: float, x: float, y: float) -> tuple[float, float, bool]:
    """Invert `_polynomial` by Newton's method, beginning at (x, y)."""
    u, v, is_close = xd, yd, False
    a, b, c, d = 1.0, 0.0, 0.0, 1.0
    steps = _NEWTON_STEPS if model == RADIAL_TANGENTIAL else _MORE_STEPS
    for i in range(steps + 1):
        u, v, a, b, c, d = _polynomial(model, distortion, x, y)
        if is_close or i == steps:
            break
        if model == RATIONAL and a == -1.0:  # outside the domain, beyond a pole of the ratio
            x, y = 0.5 * x, 0.5 * y
            continue
        ex, ey = u - xd, v - yd
        determinant = a * d - b * c
        step_x = (d * ex - b * ey) / determinant
        step_y = (a * ey - c * ex) / determinant
        x -= step_x
        y -= step_y
        is_close = abs(step_x) + abs(step_y) < _NEWTON_TOLERANCE
    # For pixels beyond the fold radius, Newton's method ends at a point whose Jacobian is not positive.
    return x, y, abs(u - xd) + abs(v - yd) < 1e-8 and a * d - b * c > 0.0 and a > 0.0


@kernel
def project_points(model: int, intrinsics: Float, distortion: Float, points: Float) -> tuple[Float, Bool]:
    """Project points to pixels.

    Args:
        model: number of the lens model.
        intrinsics: (4,) pixels.
        distortion: coefficients (8,).
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


def central_scale(model: int, distortion: Float) -> float:
    """Return by what factor the lens scales normalised coordinates at the optical axis, without tangential terms."""
    return 1.0 / (1.0 + float(distortion[0])) if model in (DOUBLE_SPHERE, OMNIDIRECTIONAL) else 1.0
