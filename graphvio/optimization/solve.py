"""Solving the full graph, and what each kind of factor says of the solution."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.errors import OptimizationError

_MOST_ITERATIONS = 50
_CONVERGED = 1e-5  # relative decrease of the cost


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
