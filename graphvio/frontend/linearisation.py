"""Whitened reprojection errors of many points, and their normal equations for a step of the motion (section 3, 5).

A point's error in both images is one vector of four. Its covariance is that of the pixels plus that of the
triangulated point as it is seen from here, ``S = sigma^2 (1 + J_X C_X J_X^T)``: near points, whose depth is known
well, count for more. Points are errors in variables: derivatives are taken where both instants together say that a
point is, not where it was triangulated, whose noise is in the residual too and would bias the motion (maximum
likelihood with the points eliminated; R. Hartley, A. Zisserman, *Multiple View Geometry*, 2004, section 5.2).
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.frontend.observations import Observations, RigArrays
from graphvio.kernels import inner_kernel, kernel

_NEAREST = 1e-3
_EXPANSIONS = 3
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
def expand(motions: Float, rig: RigArrays, observations: Observations, sigma: float) -> Expansion:
    """Linearise all points at motions (P, 2, 4, 4), see `graphvio.frontend.cost.left_motions`."""
    n = len(observations.pair)
    points, offsets, whiteners = observations.points.copy(), np.zeros((n, 4)), np.empty((n, 4, 4))
    jacobian, residual, white, pull = np.zeros((4, 3)), np.empty(4), np.zeros(4), np.empty(3)
    spread, lower = np.empty((4, 3)), np.zeros((4, 4))
    for i in range(n):
        j = observations.pair[i]
        covariance = observations.covariances[i]
        rows = 4 if observations.has_right[i] else 2
        for repeat in range(_EXPANSIONS):
            for side in range(2):
                _derivatives_by_point(
                    motions[j, side], points[i], observations.left[i] if side == 0 else observations.right[i],
                    rig.focal_px[j, side], jacobian[2 * side : 2 * side + 2], residual[2 * side : 2 * side + 2],
                )  # fmt: skip
            for p in range(4):
                offsets[i, p] = 0.0
                for k in range(3):
                    offsets[i, p] -= jacobian[p, k] * (points[i, k] - observations.points[i, k])
            _whitener(jacobian, covariance, sigma, spread, lower, whiteners[i])
            if repeat == _EXPANSIONS - 1:
                break
            e2 = 0.0
            for p in range(rows):
                white[p] = 0.0
                for q in range(p + 1):
                    white[p] += whiteners[i, p, q] * (residual[q] - offsets[i, q])
                e2 += white[p] * white[p]
            share = sigma * sigma * min(1.0, _FARTHEST / max(e2, 1e-12))
            _pull_back(jacobian, whiteners[i], white, rows, pull)
            for k in range(3):
                along = covariance[k, 0] * pull[0] + covariance[k, 1] * pull[1] + covariance[k, 2] * pull[2]
                points[i, k] = observations.points[i, k] + share * along
    return Expansion(points, offsets, whiteners)


@inner_kernel
def _derivatives_by_point(
    motion: Float, point: Float, seen: Float, focal_px: float, jacobian: Float, residual: Float
) -> None:
    """Fill the error in one image (2,), pixels, and the derivative (2, 3) of the projection by ``[x, y, 1/Z]``."""
    m = motion
    x, y, w = point[0], point[1], point[2]
    z = max(m[2, 0] * x + m[2, 1] * y + m[2, 2] + w * m[2, 3], _NEAREST)
    u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] + w * m[0, 3]) / z
    v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] + w * m[1, 3]) / z
    for k in range(3):
        q = k if k < 2 else 3
        jacobian[0, k] = focal_px * (m[0, q] - u * m[2, q]) / z
        jacobian[1, k] = focal_px * (m[1, q] - v * m[2, q]) / z
    residual[0], residual[1] = focal_px * (seen[0] - u), focal_px * (seen[1] - v)


@inner_kernel
def _pull_back(jacobian: Float, whitener: Float, white: Float, rows: int, pull: Float) -> None:
    """Fill ``J^T S^-1 r`` (3,): the direction in which the residual r would have the point."""
    pull[:] = 0.0
    for q in range(rows):
        back = 0.0
        for p in range(q, rows):
            back += whitener[p, q] * white[p]
        for k in range(3):
            pull[k] += jacobian[q, k] * back


@inner_kernel
def _whitener(jacobian: Float, covariance: Float, sigma: float, spread: Float, lower: Float, inverse_l: Float) -> None:
    """Fill one point's inverse Cholesky factor (4, 4) of S, by way of ``J C`` (4, 3) and the factor (4, 4)."""
    for i in range(4):
        for d in range(3):
            spread[i, d] = (
                jacobian[i, 0] * covariance[0, d]
                + jacobian[i, 1] * covariance[1, d]
                + jacobian[i, 2] * covariance[2, d]
            )
    for i in range(4):
        for j in range(i + 1):
            total = 1.0 if i == j else 0.0
            for d in range(3):
                total += spread[i, d] * jacobian[j, d]
            total *= sigma * sigma
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = np.sqrt(total) if i == j else total / lower[j, j]
    inverse_l[:] = 0.0
    for j in range(4):
        inverse_l[j, j] = 1.0 / lower[j, j]
        for i in range(j + 1, 4):
            total = 0.0
            for k in range(j, i):
                total -= lower[i, k] * inverse_l[k, j]
            inverse_l[i, j] = total / lower[i, i]


@inner_kernel
def _derivatives_by_motion(
    motion: Float, cam_T_body: Float, point: Float, focal_px: float, seen: Float, rows: Float
) -> bool:
    """Fill derivatives by ``d`` in ``exp(d) cur_T_ref``, and in the last column the errors (2, 7); False if behind."""
    m, r = motion, cam_T_body
    a, b, w = point[0], point[1], point[2]
    z = m[2, 0] * a + m[2, 1] * b + m[2, 2] + w * m[2, 3]
    if z < _NEAREST:
        return False
    x = m[0, 0] * a + m[0, 1] * b + m[0, 2] + w * m[0, 3]
    y = m[1, 0] * a + m[1, 1] * b + m[1, 2] + w * m[1, 3]
    # d cam point = R_cam_body (-[p]x d_rotation + w d_translation), p the homogeneous point in body now
    qx, qy, qz = x - w * r[0, 3], y - w * r[1, 3], z - w * r[2, 3]
    px = r[0, 0] * qx + r[1, 0] * qy + r[2, 0] * qz
    py = r[0, 1] * qx + r[1, 1] * qy + r[2, 1] * qz
    pz = r[0, 2] * qx + r[1, 2] * qy + r[2, 2] * qz
    scale = focal_px / z
    for k in range(2):
        at = x / z if k == 0 else y / z
        g0 = scale * (r[k, 0] - at * r[2, 0])
        g1 = scale * (r[k, 1] - at * r[2, 1])
        g2 = scale * (r[k, 2] - at * r[2, 2])
        rows[k, 0] = -g1 * pz + g2 * py
        rows[k, 1] = g0 * pz - g2 * px
        rows[k, 2] = -g0 * py + g1 * px
        rows[k, 3], rows[k, 4], rows[k, 5] = w * g0, w * g1, w * g2
        rows[k, 6] = focal_px * (seen[k] - at)
    return True


@inner_kernel
def _whitened(
    i: int, motions: Float, rig: RigArrays, observations: Observations, at: Expansion,
    raw: Float, white: Float, jacobian: Float,
) -> bool:  # fmt: skip
    """Fill one point's whitened error (4,) and its derivative (4, 6), by way of raw (4, 7); False behind a camera."""
    j = observations.pair[i]
    rows = 4 if observations.has_right[i] else 2
    for side in range(rows // 2):
        seen = observations.left[i] if side == 0 else observations.right[i]
        if not _derivatives_by_motion(
            motions[j, side], rig.cam_T_body[j, side], at.points[i], rig.focal_px[j, side], seen,
            raw[2 * side : 2 * side + 2],
        ):  # fmt: skip
            return False
        for k in range(2 * side, 2 * side + 2):
            raw[k, 6] -= at.offsets[i, k]
    whiteners = at.whiteners[i]
    for p in range(rows):
        for c in range(6):
            value = 0.0
            for q in range(p + 1):
                value += whiteners[p, q] * raw[q, c]
            jacobian[p, c] = value
        value = 0.0
        for q in range(p + 1):
            value += whiteners[p, q] * raw[q, 6]
        white[p] = value
    return True


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
    hessian[:] = 0.0
    gradient[:] = 0.0
    cost = 0.0
    raw, white, jacobian = np.empty((4, 7)), np.empty(4), np.empty((4, 6))
    inverse_scale2 = 1.0 / (scale * scale)
    for i in range(len(observations.pair)):
        if not _whitened(i, motions, rig, observations, at, raw, white, jacobian):
            errors2[i] = np.inf
            cost += np.log1p(1e6) if active[i] else 0.0
            continue
        rows = 4 if observations.has_right[i] else 2
        e2 = 0.0
        for p in range(rows):
            e2 += white[p] * white[p]
        errors2[i] = e2
        if not active[i]:
            continue
        cost += np.log1p(e2 * inverse_scale2)
        weight = 1.0 / (1.0 + e2 * inverse_scale2)
        for p in range(rows):
            for c in range(6):
                gradient[c] += weight * jacobian[p, c] * white[p]
                for d in range(c + 1):
                    hessian[c, d] += weight * jacobian[p, c] * jacobian[p, d]
    for c in range(6):
        for d in range(c):
            hessian[d, c] = hessian[c, d]
    return cost


@kernel
def information_through_points(
    motions: Float, rig: RigArrays, observations: Observations, at: Expansion, sigma: float, factors: Float
) -> Float:
    """``sum f (J^T S^-1 J - sigma^2 J^T S^-2 J)`` (6, 6): the part of the score's variance that the points' own errors
    contribute, each point with a factor f (N,)."""
    total = np.zeros((6, 6))
    raw, white, jacobian, twice = np.empty((4, 7)), np.empty(4), np.empty((4, 6)), np.empty(6)
    for i in range(len(observations.pair)):
        if factors[i] == 0.0 or not _whitened(i, motions, rig, observations, at, raw, white, jacobian):
            continue
        rows = 4 if observations.has_right[i] else 2
        for p in range(rows):
            for c in range(6):
                twice[c] = 0.0
                for q in range(p, rows):
                    twice[c] += at.whiteners[i, q, p] * jacobian[q, c]
            for c in range(6):
                for d in range(6):
                    total[c, d] += factors[i] * (jacobian[p, c] * jacobian[p, d] - sigma * sigma * twice[c] * twice[d])
    return total
