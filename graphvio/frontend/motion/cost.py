"""The robust reprojection cost of a motion on the points of all pairs, eq. (2) and (3)."""

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.geometry import se3_compose
from graphvio.kernels import fast_kernel, kernel, put, vector_kernel

MIN_DEPTH_RATIO = 1e-3
"""Depth over the reference depth below which a point counts as behind the camera."""
MAX_ERROR2 = 1e6
"""Squared error over the squared scale that a point behind the camera gets, and the upper limit for all others."""
_BLOCK = 32  # (1 + 1e6)^32 is below the largest float; as many as the points of `graphvio.frontend.motion.blocks`

Matrix = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""The upper three rows of a transform."""


@vector_kernel
def elements(transform: Float) -> Matrix:
    """Return the upper three rows of a transform (4, 4), which a loop then holds in registers."""
    t = transform
    return (
        t[0, 0], t[0, 1], t[0, 2], t[0, 3],
        t[1, 0], t[1, 1], t[1, 2], t[1, 3],
        t[2, 0], t[2, 1], t[2, 2], t[2, 3],
    )  # fmt: skip


@kernel
def camera_motions(cur_T_ref: Float, rig: RigArrays) -> Float:
    """Transfer a motion of body to each camera, eq. (1).

    Returns:
        ``cam_T_left`` (P, 2, 4, 4), from each left camera at the reference instant to its pair's cameras now: the
        paper's ``P_j``, and on side 1 ``P^s P_j``.
    """
    n_pairs = len(rig.body_T_left)
    motions = np.empty((n_pairs, 2, 4, 4))
    for j in range(n_pairs):
        body_T_left_ref = se3_compose(cur_T_ref, rig.body_T_left[j])
        for side in range(2):
            put(motions[j, side], se3_compose(rig.cam_T_body[j, side], body_T_left_ref))
    return motions


@kernel
def squared_error_px(motion: Float, point: Float, seen: Float, focal_px: float) -> float:
    """Compute the squared reprojection error in pixels of a point ``[x, y, 1/Z]``; infinite behind the camera."""
    a, b, w = point[0], point[1], point[2]
    z = motion[2, 0] * a + motion[2, 1] * b + motion[2, 2] + w * motion[2, 3]
    if z < MIN_DEPTH_RATIO:
        return np.inf
    x = motion[0, 0] * a + motion[0, 1] * b + motion[0, 2] + w * motion[0, 3]
    y = motion[1, 0] * a + motion[1, 1] * b + motion[1, 2] + w * motion[1, 3]
    dx, dy = (seen[0] - x / z) * focal_px, (seen[1] - y / z) * focal_px
    return dx * dx + dy * dy


@kernel
def robust_cost(
    cur_T_ref: Float, rig: RigArrays, observations: Observations, rows: Int, cauchy_scale_px: float
) -> float:
    """Sum ``rho(y) = log(1 + |y|^2 / a^2)`` over both images of the given rows: eq. (3), or eq. (2) for one pair.

    A point that falls behind a camera counts as one with an error of a thousand scales.
    """
    return score_all(np.expand_dims(cur_T_ref, 0), rig, observations, rows, cauchy_scale_px)[0]


@kernel
def score_all(
    hypotheses: Float, rig: RigArrays, observations: Observations, rows: Int, cauchy_scale_px: float
) -> Float:
    """Compute `robust_cost` (H,) of each hypothesis (H, 4, 4) on the given rows."""
    scores = np.zeros(len(hypotheses))
    for j in range(len(rig.body_T_left)):
        points, left, right, n = _columns_of_pair(observations, rows, j)
        if n == 0:
            continue
        scale_left = rig.focal_px[j, 0] / cauchy_scale_px
        scale_right = rig.focal_px[j, 1] / cauchy_scale_px
        for h in range(len(hypotheses)):
            body_T_left_ref = se3_compose(hypotheses[h], rig.body_T_left[j])
            scores[h] += _image_cost(se3_compose(rig.cam_T_body[j, 0], body_T_left_ref), points, left, scale_left)
            scores[h] += _image_cost(se3_compose(rig.cam_T_body[j, 1], body_T_left_ref), points, right, scale_right)
    return scores


@kernel
def _columns_of_pair(observations: Observations, rows: Int, pair: int) -> tuple[Float, Float, Float, int]:
    """Collect one pair's n points, and their left and right coordinates with weights, as contiguous rows of memory.

    Each array is (3, n), padded to whole blocks with points of zero weight.
    """
    n = 0
    for i in rows:
        n += observations.pair[i] == pair
    whole = (n + _BLOCK - 1) // _BLOCK * _BLOCK
    points, left, right = np.zeros((3, whole)), np.zeros((3, whole)), np.zeros((3, whole))
    left[2, :n] = right[2, :n] = 1.0
    k = 0
    for i in rows:
        if observations.pair[i] != pair:
            continue
        for c in range(3):
            points[c, k] = observations.points[i, c]
        left[0, k], left[1, k] = observations.left[i, 0], observations.left[i, 1]
        if observations.has_right[i]:
            right[0, k], right[1, k] = observations.right[i, 0], observations.right[i, 1]
        else:
            right[2, k] = 0.0
        k += 1
    return points, left, right, n


@fast_kernel
def _image_cost(motion: Float, points: Float, seen: Float, scale: float) -> float:
    """Sum the robust cost in one image, with one logarithm for the product of a block's terms, which fits a float."""
    m, total = elements(motion), 0.0
    a, b, w = points[0], points[1], points[2]
    u, v, weight = seen[0], seen[1], seen[2]
    for start in range(0, len(a), _BLOCK):
        product = 1.0
        for i in range(start, start + _BLOCK):
            x = m[0] * a[i] + m[1] * b[i] + m[2] + w[i] * m[3]
            y = m[4] * a[i] + m[5] * b[i] + m[6] + w[i] * m[7]
            z = m[8] * a[i] + m[9] * b[i] + m[10] + w[i] * m[11]
            inverse_z = 1.0 / max(z, MIN_DEPTH_RATIO)
            dx, dy = scale * (u[i] - x * inverse_z), scale * (v[i] - y * inverse_z)
            error = min(dx * dx + dy * dy, MAX_ERROR2) if z >= MIN_DEPTH_RATIO else MAX_ERROR2
            product *= 1.0 + weight[i] * error
        total += np.log(product)
    return total
