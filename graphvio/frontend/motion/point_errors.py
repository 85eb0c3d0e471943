"""One point's errors in both images, their derivatives and their whitening, as scalars.

These kernels become part of loops over a block's points (`graphvio.frontend.motion.blocks`), which then work on several
points at once. A point is ``[x, y, 1/Z]`` in the left camera at the reference instant; its four errors are two of the
left image and two of the right one.
"""

import numpy as np

from graphvio.arrays import Float
from graphvio.frontend.motion.blocks import C00, C01, C02, C11, C12, C22, POINTS
from graphvio.frontend.motion.cost import MIN_DEPTH_RATIO, Matrix
from graphvio.kernels import vector_kernel

Row = tuple[float, float, float, float, float, float, float]
Vector = tuple[float, float, float]
Four = tuple[float, float, float, float]
Lower = tuple[float, float, float, float, float, float, float, float, float, float]


@vector_kernel
def project(m: Matrix, point: Vector) -> tuple[float, float, float, bool]:
    """Project a point ``[x, y, 1/Z]`` after a motion.

    Returns:
        Normalised coordinates, the depth over the one before, bounded to be in front of the camera, and whether the
        point is in front of the camera.
    """
    x, y, w = point
    depth = m[8] * x + m[9] * y + m[10] + w * m[11]
    z = max(depth, MIN_DEPTH_RATIO)
    u = (m[0] * x + m[1] * y + m[2] + w * m[3]) / z
    v = (m[4] * x + m[5] * y + m[6] + w * m[7]) / z
    return u, v, z, depth >= MIN_DEPTH_RATIO


@vector_kernel
def derivatives_by_point(
    m: Matrix, point: Vector, focal_px: float, at_u: float, at_v: float
) -> tuple[Vector, Vector, float, float]:
    """Compute derivatives of a point's coordinates in one image with respect to ``[x, y, 1/Z]``, and errors, pixels."""
    u, v, z, _ = project(m, point)
    scale = focal_px / z
    return (
        (scale * (m[0] - u * m[8]), scale * (m[1] - u * m[9]), scale * (m[3] - u * m[11])),
        (scale * (m[4] - v * m[8]), scale * (m[5] - v * m[9]), scale * (m[7] - v * m[11])),
        focal_px * (at_u - u),
        focal_px * (at_v - v),
    )


@vector_kernel
def derivatives_by_motion(
    m: Matrix, cam_T_body: Matrix, focal_px: float, point: Vector, at_u: float, at_v: float
) -> tuple[Row, Row, bool]:
    """Compute derivatives of a point's coordinates in one image with respect to ``d`` in ``exp(d) cur_T_ref``, pixels.

    Returns:
        The derivatives of each coordinate with its error as last element; and whether the point is in front of the
        camera.
    """
    r, w = cam_T_body, point[2]
    u, v, z, in_front = project(m, point)
    # d cam point = R_cam_body (-[p]x d_rotation + w d_translation), p the homogeneous point in body now
    qx, qy, qz = u * z - w * r[3], v * z - w * r[7], z - w * r[11]
    px = r[0] * qx + r[4] * qy + r[8] * qz
    py = r[1] * qx + r[5] * qy + r[9] * qz
    pz = r[2] * qx + r[6] * qy + r[10] * qz
    scale = focal_px / z
    a, b, c = scale * (r[0] - u * r[8]), scale * (r[1] - u * r[9]), scale * (r[2] - u * r[10])
    d, e, f = scale * (r[4] - v * r[8]), scale * (r[5] - v * r[9]), scale * (r[6] - v * r[10])
    return (
        (c * py - b * pz, a * pz - c * px, b * px - a * py, w * a, w * b, w * c, focal_px * (at_u - u)),
        (f * py - e * pz, d * pz - f * px, e * px - d * py, w * d, w * e, w * f, focal_px * (at_v - v)),
        in_front,
    )


@vector_kernel
def dot(a: Vector, b: Vector) -> float:
    """Compute the inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@vector_kernel
def covariance_times(block: Float, i: int, a: Vector) -> Vector:
    """Multiply the covariance of a block's point by a vector."""
    c00, c01, c02 = block[C00 + i], block[C01 + i], block[C02 + i]
    c11, c12, c22 = block[C11 + i], block[C12 + i], block[C22 + i]
    return (
        c00 * a[0] + c01 * a[1] + c02 * a[2],
        c01 * a[0] + c11 * a[1] + c12 * a[2],
        c02 * a[0] + c12 * a[1] + c22 * a[2],
    )


@vector_kernel
def inverse_cholesky(
    s00: float, s10: float, s11: float, s20: float, s21: float, s22: float,
    s30: float, s31: float, s32: float, s33: float, factor: float,
) -> Lower:  # fmt: skip
    """Invert the lower Cholesky factor of ``1 + A``, A positive semidefinite (4, 4), and multiply it by a factor.

    The pivots are at least 1, and are bounded to that: for a point next to the camera's plane, rounding may take them
    below.
    """
    d0 = 1.0 / np.sqrt(s00)
    c10, c20, c30 = s10 * d0, s20 * d0, s30 * d0
    d1 = 1.0 / np.sqrt(max(s11 - c10 * c10, 1.0))
    c21, c31 = (s21 - c20 * c10) * d1, (s31 - c30 * c10) * d1
    d2 = 1.0 / np.sqrt(max(s22 - c20 * c20 - c21 * c21, 1.0))
    c32 = (s32 - c30 * c20 - c31 * c21) * d2
    d3 = 1.0 / np.sqrt(max(s33 - c30 * c30 - c31 * c31 - c32 * c32, 1.0))
    l10 = -c10 * d0 * d1
    l20, l21 = -(c20 * d0 + c21 * l10) * d2, -c21 * d1 * d2
    l30 = -(c30 * d0 + c31 * l10 + c32 * l20) * d3
    l31, l32 = -(c31 * d1 + c32 * l21) * d3, -c32 * d2 * d3
    return (
        factor * d0, factor * l10, factor * d1, factor * l20, factor * l21, factor * d2,
        factor * l30, factor * l31, factor * l32, factor * d3,
    )  # fmt: skip


@vector_kernel
def whiten(lower: Lower, errors: Four) -> Four:
    """Multiply a lower triangle (4, 4) by a vector."""
    l00, l10, l11, l20, l21, l22, l30, l31, l32, l33 = lower
    a, b, d, e = errors
    return l00 * a, l10 * a + l11 * b, l20 * a + l21 * b + l22 * d, l30 * a + l31 * b + l32 * d + l33 * e


@vector_kernel
def whiten_transposed(lower: Lower, whitened: Four) -> Four:
    """Multiply the transpose of a lower triangle (4, 4) by a vector."""
    l00, l10, l11, l20, l21, l22, l30, l31, l32, l33 = lower
    a, b, d, e = whitened
    return l00 * a + l10 * b + l20 * d + l30 * e, l11 * b + l21 * d + l31 * e, l22 * d + l32 * e, l33 * e


@vector_kernel
def whitener_of(whiteners: Float, i: int, seen: float) -> Lower:
    """Read the whitener of a block's point, with its last two rows multiplied by ``seen``."""
    w = whiteners
    return (
        w[i], w[POINTS + i], w[2 * POINTS + i],
        seen * w[3 * POINTS + i], seen * w[4 * POINTS + i], seen * w[5 * POINTS + i],
        seen * w[6 * POINTS + i], seen * w[7 * POINTS + i], seen * w[8 * POINTS + i], seen * w[9 * POINTS + i],
    )  # fmt: skip


@vector_kernel
def put3(rows: Float, i: int, values: Vector) -> None:
    """Store a vector of three, one element in each row."""
    rows[i], rows[POINTS + i], rows[2 * POINTS + i] = values


@vector_kernel
def put4(rows: Float, i: int, values: Four) -> None:
    """Store a vector of four, one element in each row."""
    rows[i], rows[POINTS + i], rows[2 * POINTS + i], rows[3 * POINTS + i] = values


@vector_kernel
def put_whitener(rows: Float, i: int, values: Lower) -> None:
    """Store a whitener, as `whitener_of` reads it."""
    for k in range(10):
        rows[k * POINTS + i] = values[k]
