"""P_12 as a factor graph of its own: one unknown pose, and a factor for each pose pair that is no outlier."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.backend.noise import gaussian, isotropic
from graphvio.calibration.consistency import (
    error_covariance,
    error_of,
    squared_distances,
    without_outliers,
)
from graphvio.calibration.observability import Observability, observe
from graphvio.calibration.pose_pairs import FEWEST, PosePairs
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_inverse, se3_log, se3_right_jacobian_inverse

_X = int(gtsam.symbol("X", 0))
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
    """

    left2_T_left1: Float
    covariance: Float
    inlier: Bool
    squares: Float
    observability: Observability


def solve(pairs: PosePairs, start: Float) -> GraphSolution:
    """The most likely ``left2_T_left1``, from a start (4, 4), which is kept in directions that the motions do not tell.

    Raises:
        CalibrationError: if fewer than three pose pairs agree.
    """
    left2_T_left1 = np.ascontiguousarray(start)
    held = observe(pairs, left2_T_left1).undetermined
    left2_T_left1, inlier = without_outliers(pairs, left2_T_left1, held)
    if inlier.sum() < FEWEST:
        raise CalibrationError(
            f"{inlier.sum()} of {len(pairs)} motions agree on one relative pose of the cameras; are they on one rig?"
        )
    chosen = pairs.chosen(inlier)
    for _ in range(_ROUNDS):
        graph = gtsam.NonlinearFactorGraph()
        for k in range(len(chosen)):
            graph.push_back(_factor(chosen, k, left2_T_left1))
        if len(held):
            graph.push_back(_holding(held, left2_T_left1))
        values = gtsam.Values()
        values.insert(_X, gtsam.Pose3(left2_T_left1))
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        left2_T_left1 = np.ascontiguousarray(values.atPose3(_X).matrix())
    observability = observe(chosen, left2_T_left1)
    covariance = (
        np.asarray(gtsam.Marginals(graph, values).marginalCovariance(_X))
        if observability.is_complete
        else observability.covariance
    )
    return GraphSolution(left2_T_left1, covariance, inlier, squared_distances(pairs, left2_T_left1), observability)


def _holding(held: Float, left2_T_left1: Float) -> gtsam.NonlinearFactor:
    """Keeps a pose in some directions (K, 6)."""
    there = se3_inverse(left2_T_left1)

    def error(_: Any, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        off = se3_log(there @ np.ascontiguousarray(values.atPose3(_X).matrix()))
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(held @ se3_right_jacobian_inverse(off))
        return np.asarray(held @ off)

    return gtsam.CustomFactor(isotropic(len(held), _HELD_SIGMA), [_X], error)


def _factor(pairs: PosePairs, k: int, left2_T_left1: Float) -> gtsam.NonlinearFactor:
    """The factor of pose pair k, weighed as at a given ``left2_T_left1``."""
    motion_1, motion_2 = pairs.motion_1[k], pairs.motion_2[k]

    def error(_: Any, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        off, jacobian = error_of(np.ascontiguousarray(values.atPose3(_X).matrix()), motion_1, motion_2)
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(jacobian)
        return off

    noise = gaussian(error_covariance(left2_T_left1, pairs.covariance_1[k], pairs.covariance_2[k]))
    return gtsam.CustomFactor(noise, [_X], error)
