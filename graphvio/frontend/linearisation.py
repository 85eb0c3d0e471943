"""Whitened reprojection errors of many points, and their normal equations for a step of the motion (section 3, 5).

A point's error in both images is one vector of four. Its covariance is that of its pair's pixels plus that of the
triangulated point as it is seen from here, ``S = sigma^2 (1 + J_X C_X J_X^T)``: near points, whose depth is known
well, count for more. Points are errors in variables: derivatives are taken where both instants together say that a
point is, not where it was triangulated, whose noise is in the residual too and would bias the motion (maximum
likelihood with the points eliminated; R. Hartley, A. Zisserman, *Multiple View Geometry*, 2004, section 5.2).
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.frontend.cost import NEAREST, WORST
from graphvio.frontend.observations import Observations, RigArrays
from graphvio.kernels import inner_kernel, kernel

_EXPANSIONS = 3
_Row = tuple[float, float, float, float, float, float, float]
_Vector = tuple[float, float, float]
_Lower = tuple[float, float, float, float, float, float, float, float, float, float]
_FARTHEST = 16.0  # squared whitened error up to which a point may follow its residual; outliers would gain leverage


class Expansion(NamedTuple):
    """Where the errors of N points are linearised.

    Attributes:
        points: (N, 3) corrected by what both instants say.
        offsets: (N, 4) what the correction is worth, pixels.
        whiteners: (N, 4, 4) inverse Cholesky factors of the covariances S.
    """

    points: Float
    offsets: Float
    whiteners: Float


@kernel
def expand(motions: Float, rig: RigArrays, observations: Observations, sigmas_px: Float) -> Expansion:
    """Linearise all points at motions (P, 2, 4, 4), see `graphvio.frontend.cost.left_motions`.

    The pixels of each pair have a noise of their own (P,).
    """
    n = len(observations.pair)
    points, offsets, whiteners = np.empty((n, 3)), np.empty((n, 4)), np.zeros((n, 4, 4))
    for i in range(n):
        j, covariance = observations.pair[i], observations.covariances[i]
        sigma = sigmas_px[j]
        measured = observations.points[i, 0], observations.points[i, 1], observations.points[i, 2]
        shift, seen = (0.0, 0.0, 0.0), 1.0 if observations.has_right[i] else 0.0
        for repeat in range(_EXPANSIONS):
            point = measured[0] + shift[0], measured[1] + shift[1], measured[2] + shift[2]
            # Derivatives of the four coordinates by the point, and their errors; zero where there is no right image.
            ja, jb, ra, rb = _by_point(
                motions[j, 0], point, rig.focal_px[j, 0], observations.left[i, 0], observations.left[i, 1]
            )
            jd, je, rd, re = _by_point(
                motions[j, 1], point, seen * rig.focal_px[j, 1], observations.right[i, 0], observations.right[i, 1]
            )
            oa, ob, od, oe = -_dot(ja, shift), -_dot(jb, shift), -_dot(jd, shift), -_dot(je, shift)
            ca, cb, cd, ce = (
                _times(covariance, ja),
                _times(covariance, jb),
                _times(covariance, jd),
                _times(covariance, je),
            )
            l00, l10, l11, l20, l21, l22, l30, l31, l32, l33 = _inverse_cholesky(
                1.0 + _dot(ca, ja), _dot(cb, ja), 1.0 + _dot(cb, jb), _dot(cd, ja), _dot(cd, jb), 1.0 + _dot(cd, jd),
                _dot(ce, ja), _dot(ce, jb), _dot(ce, jd), 1.0 + _dot(ce, je), 1.0 / sigma,
            )  # fmt: skip
            if repeat == _EXPANSIONS - 1:
                break
            wa = l00 * (ra - oa)
            wb = l10 * (ra - oa) + l11 * (rb - ob)
            wd = l20 * (ra - oa) + l21 * (rb - ob) + l22 * (rd - od)
            we = l30 * (ra - oa) + l31 * (rb - ob) + l32 * (rd - od) + l33 * (re - oe)
            e2 = wa * wa + wb * wb + wd * wd + we * we
            share = sigma * sigma * min(1.0, _FARTHEST / max(e2, 1e-12))
            # C J^T S^-1 r: where the residual r would have the point
            ba = share * (l00 * wa + l10 * wb + l20 * wd + l30 * we)
            bb = share * (l11 * wb + l21 * wd + l31 * we)
            bd, be = share * (l22 * wd + l32 * we), share * l33 * we
            shift = (
                ca[0] * ba + cb[0] * bb + cd[0] * bd + ce[0] * be,
                ca[1] * ba + cb[1] * bb + cd[1] * bd + ce[1] * be,
                ca[2] * ba + cb[2] * bb + cd[2] * bd + ce[2] * be,
            )
        points[i, 0], points[i, 1], points[i, 2] = point
        offsets[i, 0], offsets[i, 1], offsets[i, 2], offsets[i, 3] = oa, ob, od, oe
        whitener = whiteners[i]
        whitener[0, 0], whitener[1, 0], whitener[1, 1] = l00, l10, l11
        whitener[2, 0], whitener[2, 1], whitener[2, 2] = l20, l21, l22
        whitener[3, 0], whitener[3, 1], whitener[3, 2], whitener[3, 3] = l30, l31, l32, l33
    return Expansion(points, offsets, whiteners)


@inner_kernel
def _by_point(
    motion: Float, point: _Vector, focal_px: float, at_u: float, at_v: float
) -> tuple[_Vector, _Vector, float, float]:
    """Derivatives of a point's two coordinates in one image by ``[x, y, 1/Z]``, and their errors, pixels."""
    m = motion
    u, v, z, _ = _project(m, point)
    scale = focal_px / z
    return (
        (scale * (m[0, 0] - u * m[2, 0]), scale * (m[0, 1] - u * m[2, 1]), scale * (m[0, 3] - u * m[2, 3])),
        (scale * (m[1, 0] - v * m[2, 0]), scale * (m[1, 1] - v * m[2, 1]), scale * (m[1, 3] - v * m[2, 3])),
        focal_px * (at_u - u),
        focal_px * (at_v - v),
    )


@inner_kernel
def _dot(a: _Vector, b: _Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner_kernel
def _times(matrix: Float, a: _Vector) -> _Vector:
    m = matrix
    return (
        m[0, 0] * a[0] + m[0, 1] * a[1] + m[0, 2] * a[2],
        m[1, 0] * a[0] + m[1, 1] * a[1] + m[1, 2] * a[2],
        m[2, 0] * a[0] + m[2, 1] * a[1] + m[2, 2] * a[2],
    )


@inner_kernel
def _inverse_cholesky(
    s00: float, s10: float, s11: float, s20: float, s21: float, s22: float,
    s30: float, s31: float, s32: float, s33: float, factor: float,
) -> _Lower:  # fmt: skip
    """A factor times the inverse of the lower Cholesky factor of a symmetric matrix (4, 4), element by element."""
    d0 = 1.0 / np.sqrt(s00)
    c10, c20, c30 = s10 * d0, s20 * d0, s30 * d0
    d1 = 1.0 / np.sqrt(s11 - c10 * c10)
    c21, c31 = (s21 - c20 * c10) * d1, (s31 - c30 * c10) * d1
    d2 = 1.0 / np.sqrt(s22 - c20 * c20 - c21 * c21)
    c32 = (s32 - c30 * c20 - c31 * c21) * d2
    d3 = 1.0 / np.sqrt(s33 - c30 * c30 - c31 * c31 - c32 * c32)
    l10 = -c10 * d0 * d1
    l20, l21 = -(c20 * d0 + c21 * l10) * d2, -c21 * d1 * d2
    l30 = -(c30 * d0 + c31 * l10 + c32 * l20) * d3
    l31, l32 = -(c31 * d1 + c32 * l21) * d3, -c32 * d2 * d3
    return (
        factor * d0, factor * l10, factor * d1, factor * l20, factor * l21, factor * d2,
        factor * l30, factor * l31, factor * l32, factor * d3,
    )  # fmt: skip


@inner_kernel
def _project(motion: Float, point: _Vector) -> tuple[float, float, float, bool]:
    """Normalised coordinates of a point ``[x, y, 1/Z]`` after a motion, its depth over the one before, at least what
    counts as in front of the camera, and whether it is there."""
    m = motion
    x, y, w = point
    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] + w * m[2, 3]
    z = max(depth, NEAREST)
    u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] + w * m[0, 3]) / z
    v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] + w * m[1, 3]) / z
    return u, v, z, depth >= NEAREST


@inner_kernel
def _by_motion(
    pair: int, side: int, motions: Float, rig: RigArrays, point: _Vector, seen: Float
) -> tuple[_Row, _Row, bool]:
    """Derivatives of a point's two coordinates in one image by ``d`` in ``exp(d) cur_T_ref``, and their errors behind
    them; False if the point ``[x, y, 1/Z]`` is behind the camera."""
    r, focal_px, w = rig.cam_T_body[pair, side], rig.focal_px[pair, side], point[2]
    u, v, z, in_front = _project(motions[pair, side], point)
    # d cam point = R_cam_body (-[p]x d_rotation + w d_translation), p the homogeneous point in body now
    qx, qy, qz = u * z - w * r[0, 3], v * z - w * r[1, 3], z - w * r[2, 3]
    px = r[0, 0] * qx + r[1, 0] * qy + r[2, 0] * qz
    py = r[0, 1] * qx + r[1, 1] * qy + r[2, 1] * qz
    pz = r[0, 2] * qx + r[1, 2] * qy + r[2, 2] * qz
    scale = focal_px / z
    a, b, c = scale * (r[0, 0] - u * r[2, 0]), scale * (r[0, 1] - u * r[2, 1]), scale * (r[0, 2] - u * r[2, 2])
    d, e, f = scale * (r[1, 0] - v * r[2, 0]), scale * (r[1, 1] - v * r[2, 1]), scale * (r[1, 2] - v * r[2, 2])
    return (
        (c * py - b * pz, a * pz - c * px, b * px - a * py, w * a, w * b, w * c, focal_px * (seen[0] - u)),
        (f * py - e * pz, d * pz - f * px, e * px - d * py, w * d, w * e, w * f, focal_px * (seen[1] - v)),
        in_front,
    )


@inner_kernel
def _whitened(i: int, motions: Float, rig: RigArrays, observations: Observations, at: Expansion, rows: Float) -> bool:
    """Fill one point's whitened derivatives (4, 6), in the seventh column its errors; False behind a camera.

    The right image's rows are computed always, and zero where it does not see the point: fixed lengths and no
    branches make this several times faster.
    """
    j, point = observations.pair[i], (at.points[i, 0], at.points[i, 1], at.points[i, 2])
    left_u, left_v, in_front = _by_motion(j, 0, motions, rig, point, observations.left[i])
    right_u, right_v, in_front_of_right = _by_motion(j, 1, motions, rig, point, observations.right[i])
    has_right = observations.has_right[i]
    if not in_front or (has_right and not in_front_of_right):
        return False
    o0, o1, o2, o3 = at.offsets[i, 0], at.offsets[i, 1], at.offsets[i, 2], at.offsets[i, 3]
    l00, l10, l11, l20, l21, l22, l30, l31, l32, l33 = _lower(at.whiteners[i], 1.0 if has_right else 0.0)
    for c in range(7):
        a, b, d, e = left_u[c], left_v[c], right_u[c], right_v[c]
        if c == 6:
            a, b, d, e = a - o0, b - o1, d - o2, e - o3
        rows[0, c] = l00 * a
        rows[1, c] = l10 * a + l11 * b
        rows[2, c] = l20 * a + l21 * b + l22 * d
        rows[3, c] = l30 * a + l31 * b + l32 * d + l33 * e
    return True


@inner_kernel
def _lower(whitener: Float, seen: float) -> _Lower:
    """The elements of a lower triangle (4, 4), row by row, the last two rows times a factor."""
    w = whitener
    return (
        w[0, 0], w[1, 0], w[1, 1],
        seen * w[2, 0], seen * w[2, 1], seen * w[2, 2],
        seen * w[3, 0], seen * w[3, 1], seen * w[3, 2], seen * w[3, 3],
    )  # fmt: skip


@inner_kernel
def _add_squares(rows: Float, factor: float, normal: Float) -> None:
    """Add ``factor rows^T rows`` to a matrix (7, 8) whose last column means nothing: whole vector registers."""
    for c in range(7):
        a, b, d, e = factor * rows[0, c], factor * rows[1, c], factor * rows[2, c], factor * rows[3, c]
        for k in range(8):
            normal[c, k] += a * rows[0, k] + b * rows[1, k] + d * rows[2, k] + e * rows[3, k]


@kernel
def linearise(
    motions: Float, rig: RigArrays, observations: Observations, at: Expansion, active: Bool, scale: float,
    hessian: Float, gradient: Float, errors2: Float,
) -> float:  # fmt: skip
    """Fill the normal equations for a perturbation ``exp(d) cur_T_ref`` and return the robust cost.

    Args:
        motions: (P, 2, 4, 4) at which to linearise.
        rig: of P pairs.
        observations: N points.
        at: where the points are linearised.
        active: (N,) points that count; the others only get their errors.
        scale: of the Cauchy cost, in whitened units.
        hessian: (6, 6) output.
        gradient: (6,) output.
        errors2: (N,) output, squared whitened errors, infinite behind a camera.
    """
    cost = 0.0
    rows, normal = np.zeros((4, 8)), np.zeros((7, 8))
    inverse_scale2 = 1.0 / (scale * scale)
    for i in range(len(observations.pair)):
        if not _whitened(i, motions, rig, observations, at, rows):
            errors2[i] = np.inf
            cost += np.log1p(WORST) if active[i] else 0.0
            continue
        e2 = rows[0, 6] ** 2 + rows[1, 6] ** 2 + rows[2, 6] ** 2 + rows[3, 6] ** 2
        errors2[i] = e2
        if active[i]:
            cost += np.log1p(e2 * inverse_scale2)
            _add_squares(rows, 1.0 / (1.0 + e2 * inverse_scale2), normal)
    hessian[:] = normal[:6, :6]
    gradient[:] = normal[:6, 6]
    return cost


@kernel
def information_through_points(
    motions: Float, rig: RigArrays, observations: Observations, at: Expansion, sigmas_px: Float, factors: Float
) -> Float:
    """``sum f (J^T S^-1 J - sigma^2 J^T S^-2 J)`` (6, 6): the part of the score's variance that the points' own errors
    contribute, each point with a factor f (N,)."""
    rows, twice, normal = np.zeros((4, 8)), np.zeros((4, 8)), np.zeros((7, 8))
    for i in range(len(observations.pair)):
        if factors[i] == 0.0 or not _whitened(i, motions, rig, observations, at, rows):
            continue
        l00, l10, l11, l20, l21, l22, l30, l31, l32, l33 = _lower(
            at.whiteners[i], 1.0 if observations.has_right[i] else 0.0
        )
        for c in range(6):
            a, b, d, e = rows[0, c], rows[1, c], rows[2, c], rows[3, c]
            twice[0, c] = l00 * a + l10 * b + l20 * d + l30 * e
            twice[1, c] = l11 * b + l21 * d + l31 * e
            twice[2, c] = l22 * d + l32 * e
            twice[3, c] = l33 * e
        _add_squares(rows, factors[i], normal)
        _add_squares(twice, -(sigmas_px[observations.pair[i]] ** 2) * factors[i], normal)
    return normal[:6, :6].copy()
