"""P_12 as a factor graph of its own: one unknown pose, and a factor for each pose pair that is no outlier."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.backend.noise import gaussian, isotropic
from graphvio.calibration.consistency import Further, error_covariance, error_of, whitened, without_outliers
from graphvio.calibration.observability import Observability, observe
from graphvio.calibration.pose_pairs import FEWEST, PosePairs
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_inverse, se3_log, se3_right_jacobian_inverse

_X, _Z = int(gtsam.symbol("X", 0)), int(gtsam.symbol("Z", 0))
_ROUNDS = 3  # what is an outlier, and a little of the errors' covariances, depends on the solution
_HELD_SIGMA = 1e-6


@dataclass(frozen=True, eq=False)
class GraphSolution:
    """What the graph finds.

    Attributes:
        left2_T_left1: (4, 4), the paper's P_12.
        covariance: (6, 6) of it, tangent ``[rotation, translation]`` in left1; very large where nothing tells.
        inlier: (N,) pose pairs that are no outliers.
        squares: (N,) squared Mahalanobis distances of all pose pairs' errors, 6 degrees of freedom each.
        observability: what the inliers tell and what they do not.
        further: (M,) further unknowns.
        further_covariance: (M, M) of them.
    """

    left2_T_left1: Float
    covariance: Float
    inlier: Bool
    squares: Float
    observability: Observability
    further: Float
    further_covariance: Float


def solve(pairs: PosePairs, start: Float, further: Further | None = None) -> GraphSolution:
    """The most likely ``left2_T_left1``.

    Args:
        pairs: N pose pairs.
        start: ``left2_T_left1`` (4, 4), which is kept in directions that the motions do not tell.
        further: unknowns besides, which are variables of the graph, too.

    Raises:
        CalibrationError: if fewer than three pose pairs agree.
    """
    left2_T_left1 = np.ascontiguousarray(start)
    held = observe(pairs, left2_T_left1).undetermined
    consensus = without_outliers(pairs, left2_T_left1, held, further)
    inlier, left2_T_left1, values_of_further = consensus.inlier, consensus.left2_T_left1, consensus.further
    if inlier.sum() < FEWEST:
        raise CalibrationError(
            f"{inlier.sum()} of {len(pairs)} motions agree on one relative pose of the cameras; are they on one rig?"
        )
    chosen = pairs.chosen(inlier)
    derivatives = None if further is None else further.derivatives[inlier]
    for _ in range(_ROUNDS):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for k in range(len(chosen)):
            graph.push_back(_factor(chosen, k, left2_T_left1, None if derivatives is None else derivatives[k]))
        if len(held):
            graph.push_back(holding(_X, held, left2_T_left1))
        values.insert(_X, gtsam.Pose3(left2_T_left1))
        if further is not None:
            known = gtsam.noiseModel.Diagonal.Sigmas(further.sigmas)
            graph.push_back(gtsam.PriorFactorVector(_Z, np.zeros(len(further.sigmas)), known))
            values.insert(_Z, values_of_further)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        left2_T_left1 = np.ascontiguousarray(values.atPose3(_X).matrix())
        values_of_further = values_of_further if further is None else np.asarray(values.atVector(_Z))
    observability = observe(chosen, left2_T_left1)
    marginals = gtsam.Marginals(graph, values)
    errors, _ = whitened(pairs, left2_T_left1, further, values_of_further)
    return GraphSolution(
        left2_T_left1,
        np.asarray(marginals.marginalCovariance(_X)) if observability.is_complete else observability.covariance,
        inlier,
        np.sum(errors**2, axis=1),
        observability,
        values_of_further,
        np.zeros((0, 0)) if further is None else np.asarray(marginals.marginalCovariance(_Z)),
    )


def holding(key: int, held: Float, there: Float) -> gtsam.NonlinearFactor:
    """A factor that keeps a pose (4, 4) in some directions (K, 6), tangent in it."""
    inverse = se3_inverse(np.ascontiguousarray(there))

    def error(_: Any, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        off = se3_log(inverse @ np.ascontiguousarray(values.atPose3(key).matrix()))
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(held @ se3_right_jacobian_inverse(off))
        return np.asarray(held @ off)

    return gtsam.CustomFactor(isotropic(len(held), _HELD_SIGMA), [key], error)


def _factor(pairs: PosePairs, k: int, left2_T_left1: Float, by_further: Float | None) -> gtsam.NonlinearFactor:
    """The factor of pose pair k, weighed as at a given ``left2_T_left1``, with the derivatives (6, M) of its error by
    further unknowns."""
    motion_1, motion_2 = pairs.motion_1[k], pairs.motion_2[k]

    def error(_: Any, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        off, jacobian = error_of(np.ascontiguousarray(values.atPose3(_X).matrix()), motion_1, motion_2)
        if by_further is not None:
            off = off + by_further @ values.atVector(_Z)
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(jacobian)
            if by_further is not None:
                jacobians[1] = np.asfortranarray(by_further)
        return off

    noise = gaussian(error_covariance(left2_T_left1, pairs.covariance_1[k], pairs.covariance_2[k]))
    return gtsam.CustomFactor(noise, [_X] if by_further is None else [_X, _Z], error)
