"""3-point resection: the poses from which three known points are seen along three known rays.

Grunert's solution as given by R. Haralick, C.-N. Lee, K. Ottenberg, M. Nolle, *Review and analysis of solutions
of the three point perspective pose estimation problem*, IJCV 13(3), 1994, section 3.1.
"""

import numpy as np

from graphvio.arrays import Float
from graphvio.kernels import kernel


@kernel
def resect(points: Float, rays: Float) -> tuple[Float, int]:
    """Find all poses of a camera that sees three points along three rays.

    Args:
        points: (3, 3) one point in each row, frame a.
        rays: (3, 3) one unit ray in each row, frame cam.

    Returns:
        ``cam_T_a`` (4, 4, 4), of which only the first ones are set, and their number, 0 to 4.
    """
    poses = np.zeros((4, 4, 4))
    a2 = np.sum((points[1] - points[2]) ** 2)
    b2 = np.sum((points[0] - points[2]) ** 2)
    c2 = np.sum((points[0] - points[1]) ** 2)
    cos_a = np.sum(rays[1] * rays[2])
    cos_b = np.sum(rays[0] * rays[2])
    cos_g = np.sum(rays[0] * rays[1])
    count = 0
    if min(a2, b2, c2) < 1e-12:
        return poses, count
    p = (a2 - c2) / b2
    q = (a2 + c2) / b2
    coefficients = np.empty(5)  # of v^4 .. v^0, v = s3 / s1
    coefficients[0] = (p - 1.0) ** 2 - 4.0 * c2 / b2 * cos_a**2
    coefficients[1] = 4.0 * (p * (1.0 - p) * cos_b - (1.0 - q) * cos_a * cos_g + 2.0 * c2 / b2 * cos_a**2 * cos_b)
    coefficients[2] = 2.0 * (
        p**2
        - 1.0
        + 2.0 * p**2 * cos_b**2
        + 2.0 * (b2 - c2) / b2 * cos_a**2
        - 4.0 * q * cos_a * cos_b * cos_g
        + 2.0 * (b2 - a2) / b2 * cos_g**2
    )
    coefficients[3] = 4.0 * (-p * (1.0 + p) * cos_b + 2.0 * a2 / b2 * cos_g**2 * cos_b - (1.0 - q) * cos_a * cos_g)
    coefficients[4] = (1.0 + p) ** 2 - 4.0 * a2 / b2 * cos_g**2
    roots, n_roots = real_quartic_roots(coefficients)
    seen, axes_a, axes_cam = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    if not _triangle_axes(points, axes_a):
        return poses, count
    for i in range(n_roots):
        v = roots[i]
        denominator = 2.0 * (cos_g - v * cos_a)
        if v <= 0.0:
            continue
        if abs(denominator) > 1e-6:
            u = ((p - 1.0) * v * v - 2.0 * p * cos_b * v + 1.0 + p) / denominator
        else:  # 0/0, such as for an equilateral triangle seen straight on
            u = _side_ratio(v, cos_a, cos_b, cos_g, a2 / b2, c2 / b2)
        s1_squared = b2 / (1.0 + v * v - 2.0 * v * cos_b)
        if u <= 0.0 or not s1_squared > 0.0:
            continue
        s1 = np.sqrt(s1_squared)
        for c in range(3):
            seen[0, c], seen[1, c], seen[2, c] = s1 * rays[0, c], u * s1 * rays[1, c], v * s1 * rays[2, c]
        if _triangle_axes(seen, axes_cam):
            _align_triangles(points, axes_a, seen, axes_cam, poses[count])
            count += 1
    return poses, count


@kernel
def _side_ratio(v: float, cos_a: float, cos_b: float, cos_g: float, a2_b2: float, c2_b2: float) -> float:
    """Compute ``u = s2 / s1`` from side a: of its two solutions, the one that fits side c better."""
    first = 1.0 + v * v - 2.0 * v * cos_b
    half = np.sqrt(max((v * cos_a) ** 2 - v * v + a2_b2 * first, 0.0))
    best, least = 0.0, np.inf
    for u in (v * cos_a - half, v * cos_a + half):
        misfit = abs(1.0 + u * u - 2.0 * u * cos_g - c2_b2 * first)
        if misfit < least:
            best, least = u, misfit
    return best


@kernel
def _align_triangles(points: Float, axes_a: Float, seen: Float, axes_cam: Float, cam_T_a: Float) -> None:
    """Fill the transform that takes one triangle to a congruent one, by the axes attached to each."""
    for i in range(3):
        for j in range(3):
            cam_T_a[i, j] = (
                axes_cam[0, i] * axes_a[0, j] + axes_cam[1, i] * axes_a[1, j] + axes_cam[2, i] * axes_a[2, j]
            )
    for i in range(3):
        middle = 0.0
        for k in range(3):
            middle += seen[k, i]
            for j in range(3):
                middle -= cam_T_a[i, j] * points[k, j]
        cam_T_a[i, 3] = middle / 3.0
    cam_T_a[3, 3] = 1.0


@kernel
def _triangle_axes(corners: Float, axes: Float) -> bool:
    """Fill orthonormal axes (rows) attached to a triangle; False if its corners are on a line."""
    for c in range(3):
        axes[0, c] = corners[1, c] - corners[0, c]
        axes[1, c] = corners[2, c] - corners[0, c]
    length = _normalise(axes[0])
    _cross(axes[0], axes[1], axes[2])
    if _normalise(axes[2]) < 1e-9 * length:
        return False
    _cross(axes[2], axes[0], axes[1])
    return True


@kernel
def _normalise(v: Float) -> float:
    """Divide a vector (3,) by its length, and return the length."""
    length = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    for i in range(3):
        v[i] /= length
    return length


@kernel
def _cross(a: Float, b: Float, out: Float) -> None:
    """Fill the cross product; unlike ``np.cross``, this makes no new array."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@kernel
def real_quartic_roots(c: Float) -> tuple[Float, int]:
    """Find the real roots of ``c0 x^4 + c1 x^3 + c2 x^2 + c3 x + c4`` by Ferrari's method, polished by Newton's.

    Returns:
        Roots (4,), of which only the first ones are set, and their number.
    """
    roots = np.zeros(4)
    if abs(c[0]) < 1e-14 * np.max(np.abs(c)):
        return roots, 0
    b3, b2, b1, b0 = c[1] / c[0], c[2] / c[0], c[3] / c[0], c[4] / c[0]
    shift = b3 / 4.0  # x = y - shift gives y^4 + p y^2 + q y + r
    p = b2 - 6.0 * shift**2
    q = b1 - 2.0 * b2 * shift + 8.0 * shift**3
    r = b0 - b1 * shift + b2 * shift**2 - 3.0 * shift**4
    count = 0
    m = _largest_cubic_root(p, p * p / 4.0 - r, -q * q / 8.0)
    if m > 1e-14:
        s = np.sqrt(2.0 * m)
        for sign in (-1.0, 1.0):
            discriminant = -(2.0 * p + 2.0 * m + sign * 2.0 * q / s)
            if discriminant >= -1e-9 * (abs(p) + m):
                half = np.sqrt(max(discriminant, 0.0))
                roots[count] = 0.5 * (sign * s + half) - shift
                roots[count + 1] = 0.5 * (sign * s - half) - shift
                count += 2
    else:  # biquadratic
        discriminant = p * p / 4.0 - r
        if discriminant >= 0.0:
            for sign in (-1.0, 1.0):
                square = -p / 2.0 + sign * np.sqrt(discriminant)
                if square >= 0.0:
                    roots[count] = np.sqrt(square) - shift
                    roots[count + 1] = -np.sqrt(square) - shift
                    count += 2
    for i in range(count):
        x = roots[i]
        for _ in range(3):
            value = (((x + b3) * x + b2) * x + b1) * x + b0
            slope = ((4.0 * x + 3.0 * b3) * x + 2.0 * b2) * x + b1
            if abs(slope) < 1e-14:
                break
            x -= value / slope
        roots[i] = x
    return roots, count


@kernel
def _largest_cubic_root(a: float, b: float, c: float) -> float:
    """Find the largest real root of ``x^3 + a x^2 + b x + c``."""
    q = (a * a - 3.0 * b) / 9.0
    r = (2.0 * a**3 - 9.0 * a * b + 27.0 * c) / 54.0
    if r * r < q**3:
        theta = np.arccos(min(max(r / np.sqrt(q**3), -1.0), 1.0))
        return -2.0 * np.sqrt(q) * np.cos((theta + 2.0 * np.pi) / 3.0) - a / 3.0
    s = -np.sign(r) * np.cbrt(abs(r) + np.sqrt(r * r - q**3))
    return s + (q / s if s != 0.0 else 0.0) - a / 3.0
