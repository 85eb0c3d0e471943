"""How well poses of a solution are known, and motions between any two of them."""

from __future__ import annotations

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.factors import x
from graphvio.backend.gating import relative_covariance
from graphvio.errors import OptimizationError
from graphvio.geometry import se3_inverse, se3_log
from graphvio.optimization.tie import Tie


class Marginals:
    """Covariances of a graph's poses.

    The variables are eliminated by nested dissection: the tree of a long chain is flat then, and what is asked of two
    states of an hour takes as long as of two of a minute.

    Args:
        graph: of factors.
        values: its solution.

    Raises:
        OptimizationError: if some variable is not constrained.
    """

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        self._values = values
        ordering = gtsam.Ordering.MetisNonlinearFactorGraph(graph)
        try:
            self._tree = graph.linearize(values).eliminateMultifrontal(ordering)
        except RuntimeError as error:
            why = " ".join(str(error).split())[:200]
            raise OptimizationError(f"the session's graph leaves a state free ({why})") from None

    def pose(self, k: int) -> Float:
        """Covariance (6, 6) of state k's pose, tangent ``[rotation, translation]`` in body."""
        return np.asarray(self._tree.marginalCovariance(x(k)))

    def variable(self, key: int) -> Float:
        """Covariance of any variable."""
        return np.asarray(self._tree.marginalCovariance(key))

    def motion(self, first: int, second: int) -> tuple[Float, Float]:
        """``first_T_second`` (4, 4) and its covariance (6, 6), in body at the second."""
        order = [x(first), x(second)]
        joint = self._tree.jointMarginalCovariance(order)
        covariance = np.block([[joint.at(i, j) for j in order] for i in order])
        relative = se3_inverse(self._values.atPose3(order[0]).matrix()) @ self._values.atPose3(order[1]).matrix()
        return relative, relative_covariance(relative, covariance)

    def distance(self, tie: Tie) -> float:
        """Squared Mahalanobis distance of a closure that is no factor of the graph, 6 degrees of freedom."""
        relative, covariance = self.motion(tie.first, tie.second)
        error = se3_log(se3_inverse(relative) @ tie.first_T_second)
        return float(error @ np.linalg.solve(covariance + tie.covariance, error))
