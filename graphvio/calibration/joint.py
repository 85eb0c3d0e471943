"""Calibration of all cameras at once by one factor graph, whose relative poses close every loop.

For each segment the first camera's true motion is an unknown, of which every camera's own motion is a
measurement through that camera's pose on the rig. With two cameras this is the graph of `calibration.graph`; with
more, no motion's noise is counted twice, as it would be by an average of results for two at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.backend.noise import gaussian
from graphvio.calibration.consistency import LIMIT, error_covariance, error_of
from graphvio.calibration.graph import holding
from graphvio.calibration.pose_pairs import MIN_PAIRS
from graphvio.calibration.segments import Segments
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_adjoint, se3_inverse, se3_right_jacobian_inverse
from graphvio.kernels import kernel

_ROUNDS = 3  # outliers depend on the solution
_AGREEING = 0.5  # share of the other cameras that a motion must agree with


@dataclass(frozen=True, eq=False)
class JointSolution:
    """The poses of the first camera in each of J cameras."""

    left_T_left1: Float  # (J, 4, 4) pose of the first left camera in each; the first is the identity
    covariance: Float  # (6 (J - 1), 6 (J - 1)) of the others, tangents ``[rotation, translation]`` in left1

    def between(self, one: int, other: int) -> Float:
        """Return ``left_other_T_left_one`` (4, 4)."""
        return np.asarray(self.left_T_left1[other] @ se3_inverse(np.ascontiguousarray(self.left_T_left1[one])))


def solve(segments: Segments, start: Float, held: Sequence[Float]) -> JointSolution:
    """Find the maximum-likelihood poses of all cameras.

    Args:
        segments: N segments of J cameras that do not overlap.
        start: initial ``left_T_left1`` (J, 4, 4).
        held: for each camera but the first, directions (K, 6) in which the initial pose is kept.

    Raises:
        CalibrationError: if a camera agrees with the others in fewer than three motions.
    """
    left_T_left1 = np.array(start)
    cameras = range(1, segments.cameras)
    for _ in range(_ROUNDS):
        used = _agreeing(segments, left_T_left1)
        if used[:, 1:].sum(axis=0).min() < MIN_PAIRS:
            worst = int(np.argmin(used[:, 1:].sum(axis=0))) + 1
            raise CalibrationError(f"camera {worst} agrees with the others in fewer than {MIN_PAIRS} motions")
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for j in cameras:
            values.insert(_place(j), gtsam.Pose3(left_T_left1[j]))
            if len(held[j - 1]):
                graph.push_back(holding(_place(j), held[j - 1], left_T_left1[j]))
        for k in np.flatnonzero(used.sum(axis=1) > 1).tolist():
            j = int(np.argmax(used[k]))  # the first that is used
            there = left_T_left1[j]
            values.insert(_motion(k), gtsam.Pose3(se3_inverse(there) @ segments.motions[k, j] @ there))
            for j in np.flatnonzero(used[k]).tolist():
                graph.push_back(_factor(k, j, segments.motions[k, j], segments.covariances[k, j]))
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        for j in cameras:
            left_T_left1[j] = values.atPose3(_place(j)).matrix()
    joint = gtsam.Marginals(graph, values).jointMarginalCovariance(gtsam.KeyVector([_place(j) for j in cameras]))
    covariance = np.block([[joint.at(_place(i), _place(j)) for j in cameras] for i in cameras])
    return JointSolution(left_T_left1, covariance)


def _place(camera: int) -> int:
    return int(gtsam.symbol("X", camera))


def _motion(segment: int) -> int:
    return int(gtsam.symbol("M", segment))


def _factor(segment: int, camera: int, measured: Float, covariance: Float) -> gtsam.NonlinearFactor:
    """Return the factor of a camera's motion as a measurement of the first camera's; a prior for the first camera."""
    noise, measured = gaussian(covariance), np.ascontiguousarray(measured)
    if camera == 0:
        return gtsam.PriorFactorPose3(_motion(segment), gtsam.Pose3(measured), noise)

    def error(_: Any, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        place, motion = (np.ascontiguousarray(values.atPose3(key).matrix()) for key in keys)
        off, by_place = error_of(place, motion, measured)
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(by_place)
            jacobians[1] = np.asfortranarray(se3_right_jacobian_inverse(off) @ se3_adjoint(place))
        return off

    keys = [_place(camera), _motion(segment)]
    return gtsam.CustomFactor(noise, keys, error)


def _agreeing(segments: Segments, left_T_left1: Float) -> Bool:
    """Return the mask (N, J) of motions that agree with at least half of the others over the same segment."""
    agree = _agreements(segments.motions, segments.covariances, segments.known, left_T_left1, LIMIT)
    others = segments.known.sum(axis=1, keepdims=True) - 1
    return np.asarray(segments.known & (agree > 0) & (agree >= _AGREEING * others))


@kernel
def _agreements(motions: Float, covariances: Float, known: Bool, left_T_left1: Float, limit: float) -> Float:
    """Count (N, J) with how many others each motion agrees."""
    segments, cameras = known.shape
    agree = np.zeros((segments, cameras))
    for k in range(segments):
        for i in range(cameras):
            for j in range(i + 1, cameras):
                if not (known[k, i] and known[k, j]):
                    continue
                place = left_T_left1[j] @ se3_inverse(left_T_left1[i])
                off, _ = error_of(place, motions[k, i], motions[k, j])
                covariance = error_covariance(place, covariances[k, i], covariances[k, j])
                if off @ np.linalg.solve(covariance, off) <= limit:
                    agree[k, i] += 1
                    agree[k, j] += 1
    return agree
