"""P_12 as a factor graph of its own: one unknown pose, and a factor for each pose pair that is no outlier."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.backend.noise import gaussian
from graphvio.calibration.consistency import (
    error_covariance,
    error_of,
    information,
    squared_distances,
    without_outliers,
)
from graphvio.calibration.pose_pairs import FEWEST, PosePairs
from graphvio.errors import CalibrationError

_X = int(gtsam.symbol("X", 0))
_ROUNDS = 3  # what is an outlier, and a little of the errors' covariances, depends on the solution
_KNOWN = 1e-12  # smallest eigenvalue of the information over the largest


@dataclass(frozen=True, eq=False)
class GraphSolution:
    """What the graph finds.

    Attributes:
        left2_T_left1: (4, 4), the paper's P_12.
        covariance: (6, 6) of it, tangent ``[rotation, translation]`` in left1.
        inlier: (N,) pose pairs that are no outliers.
        squares: (N,) squared Mahalanobis distances of all pose pairs' errors, 6 degrees of freedom each.
    """

    left2_T_left1: Float
    covariance: Float
    inlier: Bool
    squares: Float


def solve(pairs: PosePairs, start: Float) -> GraphSolution:
    """The most likely ``left2_T_left1``, from a start (4, 4).

    Raises:
        CalibrationError: if fewer than three pose pairs agree, or they do not determine all of it.
    """
    left2_T_left1, inlier = without_outliers(pairs, np.ascontiguousarray(start))
    if inlier.sum() < FEWEST:
        raise CalibrationError(
            f"{inlier.sum()} of {len(pairs)} motions agree on one relative pose of the cameras; are they on one rig?"
        )
    chosen = pairs.chosen(inlier)
    eigenvalues = np.linalg.eigvalsh(information(chosen, left2_T_left1))
    if eigenvalues[0] <= _KNOWN * eigenvalues[-1]:
        raise CalibrationError("the motions do not determine the relative pose of the cameras: turn about two axes")
    for _ in range(_ROUNDS):
        graph = gtsam.NonlinearFactorGraph()
        for k in range(len(chosen)):
            graph.push_back(_factor(chosen, k, left2_T_left1))
        values = gtsam.Values()
        values.insert(_X, gtsam.Pose3(left2_T_left1))
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        left2_T_left1 = np.ascontiguousarray(values.atPose3(_X).matrix())
    covariance = np.asarray(gtsam.Marginals(graph, values).marginalCovariance(_X))
    return GraphSolution(left2_T_left1, covariance, inlier, squared_distances(pairs, left2_T_left1))


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
