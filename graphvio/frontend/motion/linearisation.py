"""Whitened reprojection errors of many points, and their normal equations for a step of the motion (sections 3 and 5).

A point's error in both images is one vector of four. Its covariance is that of its pair's pixels plus that of the
triangulated point, projected into the current images, ``S = sigma^2 (1 + J_X C_X J_X^T)``: near points, whose depth is
known well, count for more. Points are treated as errors in variables: derivatives are taken at the position that both
instants together give a point, not at the triangulated one, whose noise is in the residual too and would bias the
motion (maximum likelihood with the points eliminated; R. Hartley, A. Zisserman, *Multiple View Geometry*, 2004,
section 5.2).
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.frontend.motion.blocks import LEFT_U, LEFT_V, POINTS, RIGHT_U, RIGHT_V, SEEN, Blocks, W, X, Y
from graphvio.frontend.motion.cost import MAX_ERROR2, elements
from graphvio.frontend.motion.observations import RigArrays
from graphvio.frontend.motion.point_errors import (
    covariance_times,
    derivatives_by_motion,
    derivatives_by_point,
    dot,
    inverse_cholesky,
    put3,
    put4,
    put_whitener,
    whiten,
    whiten_transposed,
    whitener_of,
)
from graphvio.kernels import put, vector_kernel

_RELINEARISATIONS = 2
_MAX_FOLLOWED_ERROR2 = (
    16.0  # squared whitened error up to which a point may follow its residual; outliers would gain leverage
)
_COLUMN = 4 * POINTS  # size of a column of whitened derivatives: the four rows of each of a block's points


class LinearisationPoints(NamedTuple):
    """Points at which their errors are linearised, in blocks as `graphvio.frontend.motion.blocks.Blocks`.

    Attributes:
        shifts: (B, 3 POINTS) corrections of the points, by the errors at both instants.
        points: (B, 3 POINTS) points corrected by the shifts of the iteration before.
        offsets: (B, 4 POINTS) effect of that correction on the errors, pixels.
        whiteners: (B, 10 POINTS) inverse Cholesky factors of the covariances S, lower triangles row by row.
    """

    shifts: Float
    points: Float
    offsets: Float
    whiteners: Float


@vector_kernel
def allocate_points(blocks: Blocks) -> LinearisationPoints:
    """Allocate linearisation points, with no correction yet."""
    n = len(blocks.pair)
    return LinearisationPoints(
        np.zeros((n, 3 * POINTS)), np.empty((n, 3 * POINTS)), np.empty((n, 4 * POINTS)), np.empty((n, 10 * POINTS))
    )


@vector_kernel
def relinearise_points(
    motions: Float, rig: RigArrays, blocks: Blocks, sigmas_px: Float, points_at: LinearisationPoints
) -> None:
    """Re-estimate each point from both instants (errors in variables), and compute its whitener ``S^-1/2``.

    The iteration of the points' positions continues from those of the last call.

    Args:
        motions: (P, 2, 4, 4), see `graphvio.frontend.motion.cost.camera_motions`.
        rig: calibration of P pairs.
        blocks: blocks of N points.
        sigmas_px: (P,) pixel noise of each pair.
        points_at: linearisation points, updated in place.
    """
    for b in range(len(blocks.pair)):
        j = blocks.pair[b]
        for _ in range(_RELINEARISATIONS):
            _relinearise_block(
                motions[j, 0], motions[j, 1], rig.focal_px[j, 0], rig.focal_px[j, 1], sigmas_px[j], blocks.values[b],
                points_at.shifts[b], points_at.points[b], points_at.offsets[b], points_at.whiteners[b],
            )  # fmt: skip


@vector_kernel
def _relinearise_block(
    to_left: Float, to_right: Float, focal_left: float, focal_right: float, sigma: float, block: Float,
    shifts: Float, points: Float, offsets: Float, whiteners: Float,
) -> None:  # fmt: skip
    """Relinearise one block, see `relinearise_points`."""
    left, right = elements(to_left), elements(to_right)
    for i in range(POINTS):
        shift = shifts[X + i], shifts[Y + i], shifts[W + i]
        point = block[X + i] + shift[0], block[Y + i] + shift[1], block[W + i] + shift[2]
        # Derivatives of the four coordinates with respect to the point, and their errors; zero without a right image.
        ja, jb, ra, rb = derivatives_by_point(left, point, focal_left, block[LEFT_U + i], block[LEFT_V + i])
        jd, je, rd, re = derivatives_by_point(
            right, point, block[SEEN + i] * focal_right, block[RIGHT_U + i], block[RIGHT_V + i]
        )
        oa, ob, od, oe = -dot(ja, shift), -dot(jb, shift), -dot(jd, shift), -dot(je, shift)
        ca, cb, cd, ce = (
            covariance_times(block, i, ja),
            covariance_times(block, i, jb),
            covariance_times(block, i, jd),
            covariance_times(block, i, je),
        )
        lower = inverse_cholesky(
            1.0 + dot(ca, ja), dot(cb, ja), 1.0 + dot(cb, jb), dot(cd, ja), dot(cd, jb), 1.0 + dot(cd, jd),
            dot(ce, ja), dot(ce, jb), dot(ce, jd), 1.0 + dot(ce, je), 1.0 / sigma,
        )  # fmt: skip
        wa, wb, wd, we = whiten(lower, (ra - oa, rb - ob, rd - od, re - oe))
        e2 = wa * wa + wb * wb + wd * wd + we * we
        share = sigma * sigma * min(1.0, _MAX_FOLLOWED_ERROR2 / max(e2, 1e-12))
        # C J^T S^-1 r: the shift of the point by which the residual r is explained best
        ba, bb, bd, be = whiten_transposed(lower, (share * wa, share * wb, share * wd, share * we))
        put3(shifts, i, (
            ca[0] * ba + cb[0] * bb + cd[0] * bd + ce[0] * be,
            ca[1] * ba + cb[1] * bb + cd[1] * bd + ce[1] * be,
            ca[2] * ba + cb[2] * bb + cd[2] * bd + ce[2] * be,
        ))  # fmt: skip
        put3(points, i, point)
        put4(offsets, i, (oa, ob, od, oe))
        put_whitener(whiteners, i, lower)


@vector_kernel
def linearise(
    motions: Float, rig: RigArrays, blocks: Blocks, points_at: LinearisationPoints, active: Float, scale: float,
    hessian: Float, gradient: Float, errors2: Float,
) -> float:  # fmt: skip
    """Fill the normal equations for a perturbation ``exp(d) cur_T_ref`` and return the robust cost.

    Args:
        motions: (P, 2, 4, 4) at which to linearise.
        rig: calibration of P pairs.
        blocks: blocks of N points.
        points_at: linearisation points, see `relinearise_points`.
        active: (B, POINTS) 1 for points that count; for the others, which are 0, only the errors are computed.
        scale: scale of the Cauchy cost, in whitened units.
        hessian: (6, 6) output.
        gradient: (6,) output.
        errors2: (B, POINTS) output, squared whitened errors, infinite behind a camera.
    """
    columns, weights, normal = np.empty(7 * _COLUMN), np.empty(POINTS), np.zeros((7, 7))
    cost, inverse_scale2 = 0.0, 1.0 / (scale * scale)
    for b in range(len(blocks.pair)):
        _whiten_block(motions, rig, blocks, points_at, b, columns, errors2[b])
        product = 1.0  # see `graphvio.frontend.motion.cost`
        for i in range(POINTS):
            e2 = min(errors2[b, i] * inverse_scale2, MAX_ERROR2)
            product *= 1.0 + active[b, i] * e2
            weights[i] = active[b, i] / (1.0 + e2) if e2 < MAX_ERROR2 else 0.0
        cost += np.log(product)
        _add_squares(columns, weights, normal)
    put(hessian, _symmetric(normal))
    put(gradient, normal[:6, 6])
    return cost


@vector_kernel
def information_through_points(
    motions: Float, rig: RigArrays, blocks: Blocks, points_at: LinearisationPoints, sigmas_px: Float, factors: Float
) -> Float:
    """Sum ``f (J^T S^-1 J - sigma^2 J^T S^-2 J)`` (6, 6) over the points, each with a factor f (B, POINTS).

    It is the part of the score's variance that the points' own errors contribute.
    """
    columns, weights, normal = np.empty(7 * _COLUMN), np.empty(POINTS), np.zeros((7, 7))
    for b in range(len(blocks.pair)):
        _whiten_block(motions, rig, blocks, points_at, b, columns, weights)
        put(weights, factors[b])
        _add_squares(columns, weights, normal)
        _whiten_again(points_at.whiteners[b], columns)
        weights *= -(sigmas_px[blocks.pair[b]] ** 2)
        _add_squares(columns, weights, normal)
    return _symmetric(normal)


@vector_kernel
def _whiten_block(
    motions: Float, rig: RigArrays, blocks: Blocks, points_at: LinearisationPoints, b: int, columns: Float,
    errors2: Float,
) -> None:  # fmt: skip
    """Fill a block's whitened derivatives (6, 4, POINTS), then its errors (4, POINTS), and their squares (POINTS,)."""
    j, block, points, offsets, whiteners = (
        blocks.pair[b], blocks.values[b], points_at.points[b], points_at.offsets[b], points_at.whiteners[b],
    )  # fmt: skip
    to_left, to_right = elements(motions[j, 0]), elements(motions[j, 1])
    left_T_body, right_T_body = elements(rig.cam_T_body[j, 0]), elements(rig.cam_T_body[j, 1])
    focal_left, focal_right = rig.focal_px[j, 0], rig.focal_px[j, 1]
    for i in range(POINTS):
        point = points[X + i], points[Y + i], points[W + i]
        left_u, left_v, in_front = derivatives_by_motion(
            to_left, left_T_body, focal_left, point, block[LEFT_U + i], block[LEFT_V + i]
        )
        right_u, right_v, in_front_of_right = derivatives_by_motion(
            to_right, right_T_body, focal_right, point, block[RIGHT_U + i], block[RIGHT_V + i]
        )
        # The right image's rows are always computed, and zeroed where it does not see the point, without branches.
        seen = block[SEEN + i]
        lower = whitener_of(whiteners, i, seen)
        for c in range(6):
            put4(columns, c * _COLUMN + i, whiten(lower, (left_u[c], left_v[c], right_u[c], right_v[c])))
        errors = whiten(lower, (
            left_u[6] - offsets[i],
            left_v[6] - offsets[POINTS + i],
            right_u[6] - offsets[2 * POINTS + i],
            right_v[6] - offsets[3 * POINTS + i],
        ))  # fmt: skip
        put4(columns, 6 * _COLUMN + i, errors)
        e2 = errors[0] ** 2 + errors[1] ** 2 + errors[2] ** 2 + errors[3] ** 2
        errors2[i] = e2 if in_front and (in_front_of_right or seen == 0.0) else np.inf


@vector_kernel
def _whiten_again(whiteners: Float, columns: Float) -> None:
    """Replace a block's whitened derivatives ``L^-1 J`` by ``L^-T L^-1 J``."""
    for c in range(6):
        column = columns[c * _COLUMN : (c + 1) * _COLUMN]
        for i in range(POINTS):
            once = column[i], column[POINTS + i], column[2 * POINTS + i], column[3 * POINTS + i]
            put4(column, i, whiten_transposed(whitener_of(whiteners, i, 1.0), once))


@vector_kernel
def _add_squares(columns: Float, weights: Float, normal: Float) -> None:
    """Add the weighted products of a block's derivatives and errors to the upper triangle of a matrix (7, 7)."""
    weighted = np.empty(_COLUMN)
    for c in range(7):
        for start in range(0, _COLUMN, POINTS):
            for i in range(POINTS):
                weighted[start + i] = weights[i] * columns[c * _COLUMN + start + i]
        for k in range(c, 7):
            column = columns[k * _COLUMN : (k + 1) * _COLUMN]
            total = 0.0
            for i in range(_COLUMN):
                total += weighted[i] * column[i]
            normal[c, k] += total


@vector_kernel
def _symmetric(normal: Float) -> Float:
    """Return the symmetric matrix (6, 6) of its upper triangle."""
    whole = np.empty((6, 6))
    for r in range(6):
        for c in range(r, 6):
            whole[r, c] = whole[c, r] = normal[r, c]
    return whole
