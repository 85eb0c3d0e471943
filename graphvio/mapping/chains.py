"""Chains of places by the odometry alone, with the covariance of the motion between any two places of a chain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.factors import x
from graphvio.backend.noise import gaussian
from graphvio.geometry import se3_adjoint, se3_inverse
from graphvio.optimization.solver import Edge

EXACT: Final = 1e-12 * np.eye(6)
"""Covariance with sigmas of a micrometre and a microradian, which makes a covariance of zero invertible."""


class Chains:
    """Places in the order of time, divided into fragments: chains of motions with independent errors.

    The covariance of the motion between two places is the difference of two stored sums, so its cost is constant.

    Attributes:
        first_places: Index of each fragment's first place.
        motions: Motion (4, 4) from the previous place to each place.
        covariances: Covariance (6, 6) of each motion.
        poses: Pose (4, 4) of each place in its fragment's odom frame.
    """

    def __init__(self) -> None:
        self.first_places: list[int] = []
        self.motions: list[Float] = []
        self.covariances: list[Float] = []
        self.poses: list[Float] = []
        self._sums: list[Float] = []
        self._factors: dict[int, gtsam.NonlinearFactor] = {}  # place -> its motion from the previous one

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def fragments(self) -> list[range]:
        """Indices of the places of each fragment, as a range."""
        ends = [*self.first_places[1:], len(self)]
        return [range(start, end) for start, end in zip(self.first_places, ends, strict=True)]

    def fragment(self, place: int) -> int:
        """Return the number of a place's fragment."""
        return int(np.searchsorted(self.first_places, place, side="right")) - 1

    def begin(self, odom_T_body: Float) -> None:
        """Add a fragment, given the pose (4, 4) of its first place in its odom frame."""
        self.first_places.append(len(self))
        self._append(np.eye(4), np.zeros((6, 6)), odom_T_body, np.zeros((6, 6)))

    def add(self, previous_T_body: Float, covariance: Float) -> None:
        """Add a place to the last fragment by its motion (4, 4) from the previous place, with covariance (6, 6)."""
        covariance = np.asarray(0.5 * (covariance + covariance.T) + EXACT)
        pose = self.poses[-1] @ previous_T_body
        adjoint = se3_adjoint(pose)
        n = len(self)
        self._append(previous_T_body, covariance, pose, self._sums[-1] + adjoint @ covariance @ adjoint.T)
        self._factors[n] = Edge(n - 1, n, previous_T_body, covariance).factor()

    def motion(self, first: int, second: int) -> tuple[Float, Float]:
        """Return ``first_T_second`` (4, 4) within a fragment, and its covariance (6, 6) in body at the second place."""
        relative = se3_inverse(self.poses[first]) @ self.poses[second]
        low, high = sorted((first, second))
        adjoint = se3_adjoint(se3_inverse(self.poses[second]))
        covariance = adjoint @ (self._sums[high] - self._sums[low]) @ adjoint.T
        return relative, 0.5 * (covariance + covariance.T)

    def add_to(self, graph: gtsam.NonlinearFactorGraph, fragment: int) -> None:
        """Add a fragment's motions as factors to a graph whose variables are the places' indices."""
        for place in self.fragments[fragment][1:]:
            graph.add(self._factors[place])

    def prior(self, fragment: int) -> gtsam.NonlinearFactor:
        """Return the prior of a fragment's first place, whose pose defines the frame and is therefore certain."""
        start = self.first_places[fragment]
        return gtsam.PriorFactorPose3(x(start), gtsam.Pose3(self.poses[start]), gaussian(EXACT))

    @staticmethod
    def of(first_places: Sequence[int], first_poses: Float, motions: Float, covariances: Float) -> Chains:
        """Restore chains of F fragments from their first poses (F, 4, 4) and all N places' motions and covariances."""
        chains = Chains()
        for n, (motion, covariance) in enumerate(zip(motions, covariances, strict=True)):
            if n in first_places:
                chains.begin(first_poses[list(first_places).index(n)])
            else:
                chains.add(motion, covariance)
        return chains

    def _append(self, motion: Float, covariance: Float, pose: Float, total: Float) -> None:
        self.motions.append(motion)
        self.covariances.append(covariance)
        self.poses.append(pose)
        self._sums.append(total)
