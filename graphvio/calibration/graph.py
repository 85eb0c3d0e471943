"""Estimation of P_12 by a factor graph with one unknown pose, and a factor for each pose pair that is no outlier."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.backend.noise import gaussian, isotropic
from graphvio.calibration.consistency import error_covariance, error_of, whitened, without_outliers
from graphvio.calibration.nuisances import Nuisances
from graphvio.calibration.observability import Observability, observe
from graphvio.calibration.pose_pairs import MIN_PAIRS, PosePairs
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_inverse, se3_log, se3_right_jacobian_inverse

_X, _Z = int(gtsam.symbol("X", 0)), int(gtsam.symbol("Z", 0))
_ROUNDS = 3  # the errors' covariances depend a little on the solution
_HELD_SIGMA = 1e-6


@dataclass(frozen=True, eq=False)
class GraphSolution:
    """The solution of the factor graph."""

    left2_T_left1: Float  # (4, 4), the paper's P_12
    # (6, 6) of left2_T_left1, tangent ``[rotation, translation]`` in left1; very large in directions that the motions
    # do not determine
    covariance: Float
    inlier: Bool  # (N,) pose pairs that are not outliers
    squares: Float  # (N,) squared Mahalanobis distances of all pose pairs' errors, 6 degrees of freedom each
    observability: Observability  # observability of left2_T_left1 from the inliers
    nuisances: Float  # (M,) values of the nuisance variables
    nuisance_covariance: Float  # (M, M) of these


def solve(pairs: PosePairs, start: Float, nuisances: Nuisances | None = None) -> GraphSolution:
    """Find the maximum-likelihood ``left2_T_left1``.

    Args:
        pairs: N pose pairs.
        start: initial ``left2_T_left1`` (4, 4), which is kept in directions that the motions do not determine.
        nuisances: nuisance variables to estimate as well, or None.

    Raises:
        CalibrationError: if fewer than three pose pairs agree.
    """
    nuisances = Nuisances.none(len(pairs)) if nuisances is None else nuisances
    held = observe(pairs, np.ascontiguousarray(start)).undetermined
    consensus = without_outliers(pairs, np.ascontiguousarray(start), held, nuisances)
    inlier, left2_T_left1, values_of_nuisances = consensus.inlier, consensus.left2_T_left1, consensus.nuisances
    if inlier.sum() < MIN_PAIRS:
        raise CalibrationError(
            f"{inlier.sum()} of {len(pairs)} motions agree on one relative pose of the cameras; are they on one rig?"
        )
    chosen, has_nuisances = pairs.select(inlier), len(nuisances.sigmas) > 0
    derivatives = nuisances.derivatives[inlier]
    for _ in range(_ROUNDS):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for k in range(len(chosen)):
            graph.push_back(_factor(chosen, k, left2_T_left1, derivatives[k] if has_nuisances else None))
        if len(held):
            graph.push_back(holding(_X, held, left2_T_left1))
        values.insert(_X, gtsam.Pose3(left2_T_left1))
        if has_nuisances:
            prior = gtsam.noiseModel.Diagonal.Sigmas(nuisances.sigmas)
            graph.push_back(gtsam.PriorFactorVector(_Z, np.zeros(len(nuisances.sigmas)), prior))
            values.insert(_Z, values_of_nuisances)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        left2_T_left1 = np.ascontiguousarray(values.atPose3(_X).matrix())
        values_of_nuisances = np.asarray(values.atVector(_Z)) if has_nuisances else values_of_nuisances
    observability = observe(chosen, left2_T_left1)
    marginals = gtsam.Marginals(graph, values)
    errors, _ = whitened(pairs, left2_T_left1, nuisances, values_of_nuisances)
    return GraphSolution(
        left2_T_left1,
        np.asarray(marginals.marginalCovariance(_X)) if observability.is_complete else observability.covariance,
        inlier,
        np.sum(errors**2, axis=1),
        observability,
        values_of_nuisances,
        np.asarray(marginals.marginalCovariance(_Z)) if has_nuisances else np.zeros((0, 0)),
    )


def holding(key: int, held: Float, there: Float) -> gtsam.NonlinearFactor:
    """Return a factor that keeps a pose near another one (4, 4) in directions (K, 6) of the latter's tangent."""
    inverse = se3_inverse(np.ascontiguousarray(there))

    def error(_: Any, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        off = se3_log(inverse @ np.ascontiguousarray(values.atPose3(key).matrix()))
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(held @ se3_right_jacobian_inverse(off))
        return np.asarray(held @ off)

    return gtsam.CustomFactor(isotropic(len(held), _HELD_SIGMA), [key], error)


def _factor(pairs: PosePairs, k: int, left2_T_left1: Float, by_nuisances: Float | None) -> gtsam.NonlinearFactor:
    """Return the factor of pose pair k, weighted at ``left2_T_left1``; ``by_nuisances`` are derivatives (6, M)."""
    motion_1, motion_2 = pairs.motion_1[k], pairs.motion_2[k]

    def error(_: Any, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        off, jacobian = error_of(np.ascontiguousarray(values.atPose3(_X).matrix()), motion_1, motion_2)
        if by_nuisances is not None:
            off = off + by_nuisances @ values.atVector(_Z)
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(jacobian)
            if by_nuisances is not None:
                jacobians[1] = np.asfortranarray(by_nuisances)
        return off

    noise = gaussian(error_covariance(left2_T_left1, pairs.covariance_1[k], pairs.covariance_2[k]))
    return gtsam.CustomFactor(noise, [_X] if by_nuisances is None else [_X, _Z], error)
