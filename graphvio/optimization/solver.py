"""Solving a graph of factors: residuals, the covariances of a solution, and relative poses as edges."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.factors import x
from graphvio.backend.gating import relative_covariance
from graphvio.backend.noise import gaussian
from graphvio.errors import OptimizationError
from graphvio.geometry import se3_inverse, se3_log

_MOST_ITERATIONS = 50
_CONVERGED = 1e-5  # relative decrease of the cost


@dataclass(frozen=True, eq=False)
class Edge:
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


@dataclass(frozen=True, eq=False)
class Residuals:
    """The factors of one kind.

    Attributes:
        distances: (N,) squared Mahalanobis distances.
        dimensions: of their errors, all together.
    """

    distances: Float
    dimensions: int

    @property
    def per_dimension(self) -> float:
        """Mean squared error in standard deviations: about one where the noise is what it is said to be."""
        return float(self.distances.sum() / self.dimensions) if self.dimensions else 0.0


def residuals(
    graph: gtsam.NonlinearFactorGraph, kinds: Mapping[str, Sequence[int]], values: gtsam.Values
) -> dict[str, Residuals]:
    """What each kind of factor says of some values."""
    made = {}
    for kind, places in kinds.items():
        factors = [graph.at(place) for place in places]
        distances = np.array([2.0 * factor.error(values) for factor in factors])
        made[kind] = Residuals(distances, sum(factor.dim() for factor in factors))
    return made


def solve(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, on_progress: Callable[[int, float], None] | None = None
) -> gtsam.Values:
    """Levenberg-Marquardt until the cost hardly falls any more.

    Args:
        graph: of factors.
        values: to start from.
        on_progress: called with the number of the iteration and the cost.

    Raises:
        OptimizationError: if there is no unique solution.
    """
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    try:
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
        cost = optimizer.error()
        for iteration in range(1, _MOST_ITERATIONS + 1):
            optimizer.iterate()
            before, cost = cost, optimizer.error()
            if on_progress is not None:
                on_progress(iteration, cost)
            if before - cost <= _CONVERGED * max(before, 1e-9):
                break
    except RuntimeError as error:
        why = " ".join(str(error).split())[:200]
        raise OptimizationError(f"the session's graph cannot be solved ({why})") from None
    found = optimizer.values()
    if not np.isfinite(cost):
        raise OptimizationError("the session's graph has no finite solution; is a measurement not finite?")
    return found


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

    def distance(self, edge: Edge) -> float:
        """Squared Mahalanobis distance of a closure that is no factor of the graph, 6 degrees of freedom."""
        relative, covariance = self.motion(edge.first, edge.second)
        error = se3_log(se3_inverse(relative) @ edge.first_T_second)
        return float(error @ np.linalg.solve(covariance + edge.covariance, error))
