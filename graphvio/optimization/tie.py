"""A relative pose between two states of the graph."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from graphvio.arrays import Float
from graphvio.backend.factors import x
from graphvio.backend.noise import gaussian


@dataclass(frozen=True, eq=False)
class Tie:
    """A relative pose between two states, from a loop closure, or of a chain of other measurements.

    Attributes:
        first: the state that it is measured from.
        second: the one in which it ends.
        first_T_second: (4, 4) of body.
        covariance: (6, 6), tangent ``[rotation, translation]`` in body at the second.
    """

    first: int
    second: int
    first_T_second: Float
    covariance: Float

    def factor(self) -> gtsam.NonlinearFactor:
        """As the graph has it."""
        return gtsam.BetweenFactorPose3(
            x(self.first), x(self.second), gtsam.Pose3(self.first_T_second), gaussian(self.covariance)
        )
