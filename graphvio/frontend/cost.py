"""The robust reprojection cost of a motion on the points of all pairs, eq. (2) and (3)."""

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.frontend.observations import Observations, RigArrays
from graphvio.kernels import kernel


@kernel
def left_motions(cur_T_ref: Float, rig: RigArrays) -> Float:
    """``cam_T_left`` (P, 2, 4, 4): from each left camera at the reference instant to its pair's cameras now.

    Side 0 is the transfer of the motion to the pair, eq. (1); side 1 has the paper's ``P^s`` in front.
    """
    n_pairs = len(rig.body_T_left)
    motions = np.empty((n_pairs, 2, 4, 4))
    for j in range(n_pairs):
        body_T_left_ref = cur_T_ref @ rig.body_T_left[j]
        for side in range(2):
            motions[j, side] = np.ascontiguousarray(rig.cam_T_body[j, side]) @ body_T_left_ref
    return motions


@kernel
def squared_error_px(motion: Float, point: Float, seen: Float, focal_px: float) -> float:
    """Squared reprojection error in pixels of a point ``[x, y, 1/Z]``; infinite behind the camera."""
    a, b, w = point[0], point[1], point[2]
    z = motion[2, 0] * a + motion[2, 1] * b + motion[2, 2] + w * motion[2, 3]
    if z < 1e-3:
        return np.inf
    x = motion[0, 0] * a + motion[0, 1] * b + motion[0, 2] + w * motion[0, 3]
    y = motion[1, 0] * a + motion[1, 1] * b + motion[1, 2] + w * motion[1, 3]
    dx, dy = (seen[0] - x / z) * focal_px, (seen[1] - y / z) * focal_px
    return dx * dx + dy * dy


@kernel
def robust_cost(
    cur_T_ref: Float, rig: RigArrays, observations: Observations, rows: Int, cauchy_scale_px: float
) -> float:
    """Sum of ``rho(y) = log(1 + |y|^2 / a^2)`` over both images of the given rows: eq. (3), or eq. (2) for one pair.

    A point that falls behind a camera counts as one with an error of a thousand scales.
    """
    motions = left_motions(cur_T_ref, rig)
    inverse_a2 = 1.0 / (cauchy_scale_px * cauchy_scale_px)
    total = 0.0
    product = 1.0  # sum of logarithms = logarithm of the product, which is much cheaper
    for i in rows:
        j = observations.pair[i]
        point = observations.points[i]
        e2 = squared_error_px(motions[j, 0], point, observations.left[i], rig.focal_px[j, 0])
        product *= 1.0 + min(e2 * inverse_a2, 1e6)
        if observations.has_right[i]:
            e2 = squared_error_px(motions[j, 1], point, observations.right[i], rig.focal_px[j, 1])
            product *= 1.0 + min(e2 * inverse_a2, 1e6)
        if product > 1e200:
            total += np.log(product)
            product = 1.0
    return total + np.log(product)
