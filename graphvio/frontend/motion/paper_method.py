"""The paper's visual odometry (sections 2, 3 and 3.1), equation by equation, in plain numpy.

These functions are to be read beside the paper, and tests compare the odometry's kernels with them. The kernels compute
the same faster, with the motions of all pairs expressed as one motion ``cur_T_ref`` of the body frame: eq. (1) to (3)
are in `graphvio.frontend.motion.cost`, eq. (4) in `graphvio.frontend.motion.selection`, the hypotheses in
`graphvio.frontend.motion.ransac` and the minimisation in `graphvio.frontend.motion.refinement`, which says where it
differs from the paper.

The paper's symbols, and how they are easily misread:

- ``P_k^j = P_j(t_k, t_k+1)`` is ``left_next_T_left_prev`` of pair j. It maps *points* from t_k to t_k+1; the motion of
  the camera is its inverse.
- ``P_12`` is ``left2_T_left1``, so that ``X_2 = P_12 X_1``; ``P_21`` is its inverse.
- ``P^{s_j}`` is ``right_T_left``. The paper calls it the pose of the right camera in the frame of the left one, which
  would be the inverse; eq. (2) needs the transform that takes points from left to right.
- ``x`` are normalised image coordinates, with the lens's distortion removed. Errors are multiplied by the focal length
  of their camera, so that the scale ``a`` is in pixels and means the same for cameras with different lenses.
- ``rho`` takes the error in one image as a vector of two: it is not applied to each coordinate.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.frontend.motion.cost import MAX_ERROR2, MIN_DEPTH_RATIO
from graphvio.frontend.motion.observations import Observations
from graphvio.rig import StereoPair


class PairPoints(NamedTuple):
    """K points of one pair, known at t_k and seen at t_k+1, on which eq. (2) is computed.

    Attributes:
        X: (K, 4) homogeneous coordinates ``[X/Z, Y/Z, 1, 1/Z]`` in the left camera's frame at t_k.
        x_left: (K, 2) normalised coordinates in the left image at t_k+1.
        x_right: (K, 2) the same in the right image; NaN for points that it does not see.
        P_s: (4, 4) ``right_T_left``.
        focal_px: focal lengths of the left and the right camera, pixels.
    """

    X: Float
    x_left: Float
    x_right: Float
    P_s: Float
    focal_px: tuple[float, float]

    @staticmethod
    def of(pair: StereoPair, observations: Observations) -> PairPoints:
        """Return one pair's observations, without their covariances, which eq. (2) does not use."""
        x, y, inverse_depth = observations.points.T
        return PairPoints(
            np.column_stack([x, y, np.ones_like(x), inverse_depth]),
            observations.left,
            np.where(observations.has_right[:, None], observations.right, np.nan),
            pair.right_T_left,
            (pair.left.focal_px, pair.right.focal_px),
        )


def motion_of_pair(P_1: Float, P_12: Float) -> Float:
    """Transfer a motion from pair 1 to pair 2, eq. (1): ``P_2 = P_12 P_1 P_12^-1``.

    Args:
        P_1: (4, 4) ``left1_next_T_left1_prev``.
        P_12: (4, 4) ``left2_T_left1``.

    Returns:
        ``left2_next_T_left2_prev`` (4, 4).
    """
    return np.asarray(P_12 @ P_1 @ np.linalg.inv(P_12))


def h(X: Float) -> Float:
    """Convert homogeneous coordinates (..., 4) to normalised image coordinates (..., 2)."""
    return np.asarray(X[..., :2] / X[..., 2:3])


def rho(y: Float, a: float) -> Float:
    """Compute the Cauchy cost ``log(1 + |y|^2 / a^2)`` of errors (..., 2), each a vector, as in eq. (2)."""
    return np.asarray(np.log1p(np.sum(y**2, axis=-1) / a**2))


def cost(P: Float, points: PairPoints, a_px: float) -> float:
    """Compute the robust reprojection cost ``c_j`` of a pair's motion on the pair's own points, eq. (2).

    Args:
        P: (4, 4) ``left_next_T_left_prev`` of the pair.
        points: points of the pair.
        a_px: scale ``a`` of the robust cost, pixels.
    """
    in_left = points.X @ P.T
    in_right = in_left @ points.P_s.T
    return _image_cost(points.x_left, in_left, points.focal_px[0], a_px) + _image_cost(
        points.x_right, in_right, points.focal_px[1], a_px
    )


def _image_cost(x: Float, X: Float, focal_px: float, a_px: float) -> float:
    """Sum the cost over one image in eq. (2).

    The paper does not say what a point costs that is behind the camera, or so near to the camera's plane that its error
    has no bound: here its cost is limited.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        costs = rho(focal_px * (x - h(X)), a_px)
    limit = np.log1p(MAX_ERROR2)
    costs = np.where(X[:, 2] < MIN_DEPTH_RATIO, limit, np.minimum(costs, limit))
    return float(np.sum(costs[~np.isnan(x[:, 0])]))


def global_cost(P: Float, pair: int, points: Sequence[PairPoints], body_T_left: Float, a_px: float) -> float:
    """Compute the cost of one pair's motion on the points of all pairs, eq. (3): of two, ``c_1(P) + c_2(P_12 P P_21)``.

    Args:
        P: (4, 4) ``left_next_T_left_prev`` of the pair.
        pair: index j of the pair.
        points: points of each pair.
        body_T_left: (J, 4, 4) poses of the pairs' left cameras; ``P_ij`` is ``left_i_T_body body_T_left_j``.
        a_px: scale ``a`` of the robust cost, pixels.
    """
    total = 0.0
    for i, points_of_i in enumerate(points):
        left_i_T_left_pair = np.linalg.inv(body_T_left[i]) @ body_T_left[pair]
        total += cost(motion_of_pair(P, left_i_T_left_pair), points_of_i, a_px)
    return total


def best_pair(motions: Sequence[Float], points: Sequence[PairPoints], body_T_left: Float, a_px: float) -> int:
    """Choose the pair whose motion has the least global cost, eq. (4).

    Args:
        motions: (4, 4) ``left_next_T_left_prev`` of each pair.
        points: points of each pair.
        body_T_left: (J, 4, 4) poses of the pairs' left cameras.
        a_px: scale ``a`` of the robust cost, pixels.
    """
    return int(np.argmin([global_cost(P, j, points, body_T_left, a_px) for j, P in enumerate(motions)]))
