"""Derivatives of a motion with respect to errors of stereo depths, which errors of a pair's calibration cause.

Errors of the principal points and of the rotation from left to right add an offset to all inverse depths of a pair, at
the reference and now alike; an error of the baseline adds a share of them. For near points alone, both look like a
translation; for far points alone, an offset looks like a rotation. The effect on the motion depends on where its points
are.
"""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.frontend.motion.cost import camera_motions
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.geometry import se3_compose, se3_inverse
from graphvio.kernels import kernel, put
from graphvio.linear_algebra import solve_symmetric

_WEAKEST_SIGMA = 1e3  # radians and metres per pixel of noise, in directions that no point constrains


@kernel
def by_depth_errors(rig: RigArrays, observations: Observations, inlier: Bool, cur_T_ref: Float) -> Float:
    """Return the derivatives of a motion with respect to errors of the pairs' depths.

    They are those of the least-squares solution on the inliers, in which only the pixels now and the depths at the
    reference are uncertain. They agree with those of the refined motion to about a third.

    Args:
        rig: calibration of P pairs and single cameras.
        observations: N points of any subset of them.
        inlier: (N,) the points that the motion was refined on.
        cur_T_ref: (4, 4) the motion.

    Returns:
        (P, 2, 6) with respect to an offset of all inverse depths of a pair, 1/m, and to a share of them; tangent
        ``[rotation, translation]`` of ``cur_T_ref`` in the body frame at the current instant, so of opposite sign to
        the change of the pose there. Zero for single cameras and pairs without points.
    """
    n_pairs, motions = len(rig.focal_px), camera_motions(cur_T_ref, rig)
    information, derivatives = np.eye(6) / _WEAKEST_SIGMA**2, np.zeros((n_pairs, 2, 6))
    baselines = np.empty((n_pairs, 4, 4))
    for j in range(n_pairs):
        put(baselines[j], se3_compose(rig.cam_T_body[j, 1], se3_inverse(rig.cam_T_body[j, 0])))
    columns, by_depth = np.empty((4, 8)), np.empty(4)  # rows: coordinates; columns: by motion, offset, share
    for i in range(len(inlier)):
        if not inlier[i]:
            continue
        j, then, n = observations.pair[i], observations.points[i, 2], 4 if observations.has_right[i] else 2
        now = _add_image(rig, motions, j, 0, observations.points[i], columns, by_depth)
        if n == 4:
            _add_image(rig, motions, j, 1, observations.points[i], columns, by_depth)
        length2 = 0.0
        for k in range(n):
            shift = 0.0  # of the right pixel now, by the same error of the depth
            if k >= 2:
                shift = baselines[j, k - 2, 3] - observations.right[i, k - 2] * baselines[j, 2, 3]
                shift *= rig.focal_px[j, 1]
            columns[k, 6] = by_depth[k] - shift
            columns[k, 7] = then * by_depth[k] - now * shift
            length2 += by_depth[k] * by_depth[k]
        variance = observations.covariances[i, 2, 2]
        gain = variance / (1.0 + variance * length2)
        for r in range(6):
            along = 0.0
            for k in range(n):
                along += by_depth[k] * columns[k, r]
            for c in range(8):
                total = 0.0
                for k in range(n):
                    total += (columns[k, r] - gain * along * by_depth[k]) * columns[k, c]
                if c < 6:
                    information[r, c] += total
                else:
                    derivatives[j, c - 6, r] -= total
    for j in range(n_pairs):
        for kind in range(2):
            put(derivatives[j, kind], solve_symmetric(information, derivatives[j, kind]))
    return derivatives


@kernel
def _add_image(
    rig: RigArrays, motions: Float, j: int, side: int, point: Float, columns: Float, by_depth: Float
) -> float:
    """Fill the derivatives of a point's pixel in one image with respect to the motion and the point's inverse depth.

    Args:
        rig: calibration of P pairs and single cameras.
        motions: (P, 2, 4, 4) motions of the cameras, see `camera_motions`.
        j: Index of the pair.
        side: Side of the image, 0 for left and 1 for right.
        point: (3,) ``[x, y, 1/Z]`` at the reference; derivatives are with respect to the inverse depth there.
        columns: (4, 8) output; the two rows of the image and the six columns of the motion are filled.
        by_depth: (4,) output; the two elements of the image are filled.

    Returns:
        The point's inverse depth now.
    """
    cam_T_body, motion, focal_px = rig.cam_T_body[j, side], motions[j, side], rig.focal_px[j, side]
    seen, in_body, by_place = np.empty(3), np.empty(3), np.empty(3)
    for k in range(3):
        seen[k] = motion[k, 0] * point[0] + motion[k, 1] * point[1] + motion[k, 2] + motion[k, 3] * point[2]
    depth_ratio = seen[2]
    now: float = point[2] / depth_ratio
    for k in range(3):
        seen[k] /= depth_ratio
    for k in range(3):  # the point in body, over its depth
        in_body[k] = 0.0
        for m in range(3):
            in_body[k] += cam_T_body[m, k] * (seen[m] - now * cam_T_body[m, 3])
    for k in range(2):
        row = 2 * side + k
        for m in range(3):
            by_place[m] = focal_px * (cam_T_body[k, m] - seen[k] * cam_T_body[2, m])
            columns[row, 3 + m] = now * by_place[m]
        columns[row, 0] = in_body[1] * by_place[2] - in_body[2] * by_place[1]
        columns[row, 1] = in_body[2] * by_place[0] - in_body[0] * by_place[2]
        columns[row, 2] = in_body[0] * by_place[1] - in_body[1] * by_place[0]
        by_depth[row] = focal_px * (motion[k, 3] - seen[k] * motion[2, 3]) / depth_ratio
    return now
