"""Functions on SO(3) and SE(3): exponential, logarithm, adjoint, Jacobians, quaternions.

A transform ``a_T_b`` is a 4x4 float64 array that maps coordinates, ``X_a = a_T_b X_b``; chains are products,
``a_T_c = a_T_b @ b_T_c``. The tangent is ordered ``[rotation(3), translation(3)]`` and perturbs on the right
(in frame b): ``a_T_b @ se3_exp(xi)``. Both are GTSAM's conventions, and so is every 6x6 covariance.
All functions are numba kernels: they may be called from Python and from other kernels.

Reference: J. Sola, J. Deray, D. Atchuthan, *A micro Lie theory for state estimation in robotics*, 2018.
"""

import numpy as np

from graphvio.arrays import Float
from graphvio.kernels import kernel, put

_SMALL_ANGLE = 1e-5


@kernel
def skew(v: Float) -> Float:
    """Build the matrix (3, 3) of the cross product: ``skew(v) @ w == cross(v, w)``."""
    m = np.zeros((3, 3))
    m[0, 1], m[0, 2] = -v[2], v[1]
    m[1, 0], m[1, 2] = v[2], -v[0]
    m[2, 0], m[2, 1] = -v[1], v[0]
    return m


@kernel
def multiply(a: Float, b: Float) -> Float:
    """Multiply two matrices (3, 3); in a kernel faster than ``@``, which calls a library made for large matrices."""
    product = np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            product[i, k] = a[i, 0] * b[0, k] + a[i, 1] * b[1, k] + a[i, 2] * b[2, k]
    return product


@kernel
def rotate(rotation: Float, v: Float) -> Float:
    """Multiply a matrix (3, 3) by a vector (3,)."""
    rotated = np.empty(3)
    for i in range(3):
        rotated[i] = rotation[i, 0] * v[0] + rotation[i, 1] * v[1] + rotation[i, 2] * v[2]
    return rotated


@kernel
def _of_skew(phi: Float, a: float, b: float) -> Float:
    """Return ``I + a K + b K^2`` (3, 3) with ``K = skew(phi)``."""
    square = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    m = skew(phi)
    for i in range(3):
        for k in range(3):
            m[i, k] = a * m[i, k] + b * phi[i] * phi[k]
        m[i, i] += 1.0 - b * square
    return m


@kernel
def so3_exp(phi: Float) -> Float:
    """Compute the rotation matrix (3, 3) of a rotation vector (3,), radians."""
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    angle = np.sqrt(angle2)
    if angle < _SMALL_ANGLE:
        a = 1.0 - angle2 / 6.0
        b = 0.5 - angle2 / 24.0
    else:
        a = np.sin(angle) / angle
        b = (1.0 - np.cos(angle)) / angle2
    return _of_skew(phi, a, b)


@kernel
def so3_log(rotation: Float) -> Float:
    """Compute the rotation vector (3,), radians and of norm at most pi, of a rotation matrix (3, 3)."""
    q = quat_wxyz_from_rotation(rotation)
    sine = np.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if sine < _SMALL_ANGLE:
        scale = 2.0 / q[0] - 2.0 * sine * sine / (3.0 * q[0] * q[0] * q[0])
    else:
        scale = 2.0 * np.arctan2(sine, q[0]) / sine
    phi = np.empty(3)
    for i in range(3):
        phi[i] = scale * q[1 + i]
    return phi


@kernel
def so3_right_jacobian(phi: Float) -> Float:
    """Compute ``J`` (3, 3) with ``exp(phi + d) = exp(phi) exp(J d)`` to first order in d."""
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    angle = np.sqrt(angle2)
    if angle < _SMALL_ANGLE:
        b = 0.5 - angle2 / 24.0
        c = 1.0 / 6.0 - angle2 / 120.0
    else:
        b = (1.0 - np.cos(angle)) / angle2
        c = (angle - np.sin(angle)) / (angle2 * angle)
    return _of_skew(phi, -b, c)


@kernel
def so3_left_jacobian(phi: Float) -> Float:
    """Compute the left Jacobian (3, 3): ``exp(phi + d) = exp(J d) exp(phi)`` to first order."""
    return so3_right_jacobian(-phi)


@kernel
def so3_right_jacobian_inverse(phi: Float) -> Float:
    """Compute the inverse (3, 3) of `so3_right_jacobian`: ``log(exp(phi) exp(d)) = phi + J^-1 d`` to first order."""
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    angle = np.sqrt(angle2)
    if angle < 1e-3:  # the closed form below subtracts two large, nearly equal numbers
        c = 1.0 / 12.0 + angle2 / 720.0
    else:
        c = 1.0 / angle2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    return _of_skew(phi, 0.5, c)


@kernel
def quat_wxyz_from_rotation(rotation: Float) -> Float:
    """Convert a rotation matrix (3, 3) to a unit Hamilton quaternion (4,) ``[w, x, y, z]`` with ``w >= 0``."""
    r = rotation
    q = np.empty(4)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    if trace > 0.0:
        s = 2.0 * np.sqrt(trace + 1.0)
        q[0] = 0.25 * s
        q[1] = (r[2, 1] - r[1, 2]) / s
        q[2] = (r[0, 2] - r[2, 0]) / s
        q[3] = (r[1, 0] - r[0, 1]) / s
    else:
        i = 0
        if r[1, 1] > r[0, 0]:
            i = 1
        if r[2, 2] > r[i, i]:
            i = 2
        j = (i + 1) % 3
        k = (i + 2) % 3
        s = 2.0 * np.sqrt(1.0 + r[i, i] - r[j, j] - r[k, k])
        q[0] = (r[k, j] - r[j, k]) / s
        q[1 + i] = 0.25 * s
        q[1 + j] = (r[j, i] + r[i, j]) / s
        q[1 + k] = (r[k, i] + r[i, k]) / s
    norm = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[0] < 0.0:
        norm = -norm
    for i in range(4):
        q[i] /= norm
    return q


@kernel
def rotation_from_quat_wxyz(quat_wxyz: Float) -> Float:
    """Convert a Hamilton quaternion (4,) ``[w, x, y, z]`` of any norm but zero to a rotation matrix (3, 3)."""
    w, x, y, z = quat_wxyz / np.sqrt(np.sum(quat_wxyz * quat_wxyz))
    r = np.empty((3, 3))
    r[0, 0], r[0, 1], r[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    r[1, 0], r[1, 1], r[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    r[2, 0], r[2, 1], r[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return r


@kernel
def se3(rotation: Float, translation: Float) -> Float:
    """Build a transform (4, 4) from its rotation (3, 3) and translation (3,)."""
    t = np.zeros((4, 4))
    for i in range(3):
        for k in range(3):
            t[i, k] = rotation[i, k]
        t[i, 3] = translation[i]
    t[3, 3] = 1.0
    return t


@kernel
def se3_inverse(a_T_b: Float) -> Float:
    """Return the inverse ``b_T_a`` (4, 4) of a transform."""
    inverse = np.eye(4)
    for i in range(3):
        for j in range(3):
            inverse[i, j] = a_T_b[j, i]
    for i in range(3):
        inverse[i, 3] = -(a_T_b[0, i] * a_T_b[0, 3] + a_T_b[1, i] * a_T_b[1, 3] + a_T_b[2, i] * a_T_b[2, 3])
    return inverse


@kernel
def se3_compose(a_T_b: Float, b_T_c: Float) -> Float:
    """Return the product ``a_T_c`` (4, 4) of two transforms.

    In a kernel it is faster than ``@``, see `multiply`.
    """
    a, b = a_T_b, b_T_c
    product = np.zeros((4, 4))
    for i in range(3):
        for k in range(4):
            product[i, k] = a[i, 0] * b[0, k] + a[i, 1] * b[1, k] + a[i, 2] * b[2, k] + a[i, 3] * b[3, k]
    product[3, 3] = 1.0
    return product


@kernel
def se3_exp(xi: Float) -> Float:
    """Compute the transform (4, 4) of a tangent vector (6,) ``[rotation, translation]``."""
    phi = xi[:3]
    left_jacobian = so3_right_jacobian(-phi)
    return se3(so3_exp(phi), rotate(left_jacobian, xi[3:]))


@kernel
def se3_log(a_T_b: Float) -> Float:
    """Compute the tangent vector (6,) ``[rotation, translation]`` of a transform (4, 4)."""
    phi = so3_log(a_T_b)
    rho = rotate(so3_right_jacobian_inverse(-phi), a_T_b[:, 3])
    xi = np.empty(6)
    for i in range(3):
        xi[i], xi[3 + i] = phi[i], rho[i]
    return xi


@kernel
def se3_adjoint(a_T_b: Float) -> Float:
    """Compute the adjoint (6, 6): ``a_T_b exp(xi_b) = exp(Ad xi_b) a_T_b``."""
    turned = multiply(skew(a_T_b[:, 3]), a_T_b)
    adjoint = np.zeros((6, 6))
    for i in range(3):
        for k in range(3):
            adjoint[i, k] = adjoint[3 + i, 3 + k] = a_T_b[i, k]
            adjoint[3 + i, k] = turned[i, k]
    return adjoint


@kernel
def se3_right_jacobian_inverse(xi: Float) -> Float:
    """Compute ``J`` (6, 6) with ``log(exp(xi) exp(d)) = xi + J d`` to first order in d."""
    phi = xi[:3]
    rho = xi[3:]
    diagonal = so3_right_jacobian_inverse(phi)
    coupling = -_left_coupling(-phi, -rho)  # Q of the right Jacobian is Q of the left one at -xi
    inverse = np.zeros((6, 6))
    put(inverse[:3, :3], diagonal)
    put(inverse[3:, 3:], diagonal)
    put(inverse[3:, :3], diagonal @ coupling @ diagonal)
    return inverse


@kernel
def _left_coupling(phi: Float, rho: Float) -> Float:
    """Compute block Q (3, 3) of SE(3)'s left Jacobian (T. Barfoot, *State Estimation for Robotics*, eq. 7.86)."""
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    angle = np.sqrt(angle2)
    if angle < 1e-2:  # series: the closed form loses all digits in angle^5
        c1 = 1.0 / 6.0 - angle2 / 120.0
        c2 = 1.0 / 24.0 - angle2 / 720.0
        c3 = 1.0 / 120.0 - angle2 / 2520.0
    else:
        sine, cosine = np.sin(angle), np.cos(angle)
        c1 = (angle - sine) / angle**3
        c2 = (angle2 + 2.0 * cosine - 2.0) / (2.0 * angle**4)
        c3 = (2.0 * angle - 3.0 * sine + angle * cosine) / (2.0 * angle**5)
    p = skew(phi)
    r = skew(rho)
    pr = p @ r
    rp = r @ p
    prp = pr @ p
    return 0.5 * r + c1 * (pr + rp + prp) + c2 * (p @ pr + rp @ p - 3.0 * prp) + c3 * (prp @ p + p @ prp)


@kernel
def interpolate(a_T_b0: Float, a_T_b1: Float, fraction: float) -> Float:
    """Interpolate between two poses (4, 4), position linearly and rotation at a constant rate; fraction 0 to 1."""
    R_0, R_1 = np.ascontiguousarray(a_T_b0[:3, :3]), np.ascontiguousarray(a_T_b1[:3, :3])
    return se3(
        R_0 @ so3_exp(fraction * so3_log(R_0.T @ R_1)), (1.0 - fraction) * a_T_b0[:3, 3] + fraction * a_T_b1[:3, 3]
    )
