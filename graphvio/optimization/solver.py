"""Solution of factor graphs: relative poses as edges, optimisation, residuals and covariances of the solution."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.factors import x
from graphvio.backend.gating import relative_covariance
from graphvio.backend.noise import gaussian
from graphvio.errors import OptimizationError
from graphvio.geometry import se3_inverse, se3_log
from graphvio.optimization.covariances import covariances

_MAX_ITERATIONS = 50
_CONVERGED = 1e-5  # relative decrease of the cost
_FREE = "the session's graph leaves a state free"


@contextmanager
def gtsam_errors(message: str) -> Iterator[None]:
    """Raise an `OptimizationError` in place of gtsam's errors, with gtsam's reason."""
    try:
        yield
    except RuntimeError as error:
        raise OptimizationError(f"{message} ({' '.join(str(error).split())[:200]})") from None


class KnownMotions(Protocol):
    """Motions between any two states with their covariances, such as `Marginals`."""

    def motion(self, first: int, second: int) -> tuple[Float, Float]:
        """Return ``first_T_second`` (4, 4) and its covariance (6, 6), in body at the second."""


@dataclass(frozen=True, eq=False)
class Edge:
    """A relative pose between two states, from a loop closure or a chain of other measurements."""

    first: int  # state that the pose is measured from
    second: int  # state in which it ends
    first_T_second: Float  # (4, 4) motion of body
    covariance: Float  # (6, 6), tangent ``[rotation, translation]`` in body at the second

    def factor(self) -> gtsam.NonlinearFactor:
        """Return the edge as a factor."""
        return gtsam.BetweenFactorPose3(
            x(self.first), x(self.second), gtsam.Pose3(self.first_T_second), gaussian(self.covariance)
        )

    def distance(self, known: KnownMotions) -> float:
        """Return its squared Mahalanobis distance, 6 degrees of freedom, from known motions independent of it."""
        first_T_second, covariance = known.motion(self.first, self.second)
        error = se3_log(se3_inverse(first_T_second) @ self.first_T_second)
        return float(error @ np.linalg.solve(covariance + self.covariance, error))


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of the factors of one kind."""

    distances: Float  # (N,) squared Mahalanobis distances
    dimensions: int  # total dimension of the factors' errors

    @property
    def per_dimension(self) -> float:
        """Mean squared error in standard deviations: about one if the noise is as assumed."""
        return float(self.distances.sum() / self.dimensions) if self.dimensions else 0.0


def residuals(
    graph: gtsam.NonlinearFactorGraph, kinds: Mapping[str, Sequence[int]], values: gtsam.Values
) -> dict[str, Residuals]:
    """Compute the residuals at given values by kind; ``kinds`` gives the indices of each kind's factors."""
    found = {}
    for kind, indices in kinds.items():
        factors = [graph.at(index) for index in indices]
        distances = np.array([2.0 * factor.error(values) for factor in factors])
        found[kind] = Residuals(distances, sum(factor.dim() for factor in factors))
    return found


def solve(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, on_progress: Callable[[int, float], None] = lambda *_: None
) -> gtsam.Values:
    """Minimise the cost by Levenberg-Marquardt until it converges; ``on_progress`` takes iteration and cost.

    Raises:
        OptimizationError: if there is no unique solution.
    """
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")  # Cholesky's digits do not suffice for motions known to 0.01 mm
    with gtsam_errors("the session's graph cannot be solved"):
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
        cost = optimizer.error()
        for iteration in range(1, _MAX_ITERATIONS + 1):
            optimizer.iterate()
            before, cost = cost, optimizer.error()
            on_progress(iteration, cost)
            if before - cost <= _CONVERGED * max(before, 1e-9):
                break
    if not np.isfinite(cost):
        raise OptimizationError("the session's graph has no finite solution; is a measurement not finite?")
    return optimizer.values()


class Marginals:
    """Covariances of the values that solve a graph.

    The variables are eliminated in the order of nested dissection: the elimination tree of a long chain is then flat,
    and the covariance of two states takes as long in a session of an hour as in one of a minute. Each elimination is
    made when it is first needed.

    Raises:
        OptimizationError: if a variable is not constrained.
    """

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        self._values = values
        self._graph = graph
        self._ordering = gtsam.Ordering.MetisNonlinearFactorGraph(graph)

    def poses(self, count: int) -> Float:
        """Return the covariances (N, 6, 6) of the first N poses, tangent ``[rotation, translation]`` in body."""
        found = np.zeros((count, 6, 6))
        numbers = {x(k): k for k in range(count)}
        linear = self._graph.linearize(self._values)
        with gtsam_errors(_FREE):
            for key, covariance in covariances(linear.eliminateSequential(self._ordering, gtsam.EliminateQR)):
                if key in numbers:
                    found[numbers[key]] = covariance
        return found

    @cached_property
    def _tree(self) -> gtsam.GaussianBayesTree:
        with gtsam_errors(_FREE):
            linear = self._graph.linearize(self._values)
            return linear.eliminateMultifrontal(self._ordering, gtsam.EliminateQR)

    def variable(self, key: int) -> Float:
        """Return the covariance of a variable, such as that of a pose (6, 6), ``[rotation, translation]`` in body."""
        return np.asarray(self._tree.marginalCovariance(key))

    def motion(self, first: int, second: int) -> tuple[Float, Float]:
        """Return ``first_T_second`` (4, 4) of two states and its covariance (6, 6) in body at the second."""
        order = [x(first), x(second)]
        joint = self._tree.jointMarginalCovariance(order)
        covariance = np.block([[joint.at(i, j) for j in order] for i in order])
        relative = se3_inverse(self._values.atPose3(order[0]).matrix()) @ self._values.atPose3(order[1]).matrix()
        return relative, relative_covariance(relative, covariance)
