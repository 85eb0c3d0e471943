"""A fixed-lag window of a factor graph: optimised as a whole, its oldest states marginalised exactly.

Factors and values are kept here, outside gtsam's solvers, so that the window can always be rebuilt.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.errors import GraphvioError

_MAX_ITERATIONS = 4
_CONVERGED = 1e-4  # radians, metres...: what a further step would still change is of the order of its square
_SINGULAR = 1e-9


class WindowError(GraphvioError):
    """The window's equations have no unique solution."""


class Window:
    """Nonlinear factors and the present values of their variables."""

    def __init__(self) -> None:
        self._factors: list[tuple[frozenset[int], gtsam.NonlinearFactor]] = []
        self.values = gtsam.Values()
        self._solution: gtsam.GaussianBayesTree | None = None
        self._last: tuple[int, ...] = ()  # variables that were eliminated last: the root of the solution holds them

    def add(self, factor: gtsam.NonlinearFactor) -> None:
        """Insert a factor; its variables must have values."""
        self._factors.append((frozenset(factor.keys()), factor))
        self._solution = None

    def optimise(self) -> None:
        """Gauss-Newton from the present values.

        Raises:
            WindowError: if some variable is not constrained, or the solution is not finite; the values stay as
                they were.
        """
        values = self.values
        try:
            for _ in range(_MAX_ITERATIONS):
                step = self._solve(self._last).optimize()
                size = step.norm()
                if not np.isfinite(size):
                    raise WindowError("the window's solution is not finite")
                self.values = self.values.retract(step)
                if size < _CONVERGED:
                    break  # the solution still serves for covariances
                self._solution = None
        except RuntimeError as error:
            self.values, self._solution = values, None
            raise WindowError(f"the window cannot be optimised: {_one_line(error)}") from None
        except WindowError:
            self.values, self._solution = values, None
            raise

    def joint_covariance(self, keys: Sequence[int]) -> Float:
        """Covariance of some variables together, in the order given.

        Raises:
            WindowError: if some variable is not constrained.
        """
        unknown = [key for key in keys if not self.values.exists(key)]
        if unknown:
            raise WindowError(f"the window has no variable {gtsam.DefaultKeyFormatter(unknown[0])}")
        solution = self._solve(tuple(keys))
        for root in solution.roots():
            if list(root.conditional().keys())[-len(keys) :] == list(keys):
                # Eliminated last, the variables' marginal is the lower corner of the root. Its square root is
                # inverted, not its square: states far less certain than the poses relative to them do no harm.
                dims = self.values.dims()
                size = sum(dims[key] for key in keys)
                square_root = np.asarray(root.conditional().R())[-size:, -size:]
                if np.abs(np.diag(square_root)).min() < _SINGULAR:
                    break
                inverse = np.linalg.inv(square_root)
                return np.asarray(inverse @ inverse.T)
        raise WindowError(f"the window has no covariance of {', '.join(map(gtsam.DefaultKeyFormatter, keys))}")

    def marginalise(self, keys: Iterable[int]) -> None:
        """Replace variables and their factors by the linear factor that says the same of the others.

        Raises:
            WindowError: if one of them is not constrained.
        """
        leaving = frozenset(keys)
        if not leaving:
            return
        constrained = frozenset().union(*(involved for involved, _ in self._factors))
        if not leaving <= constrained:
            raise WindowError("a state cannot be marginalised: no factor constrains it")
        graph = gtsam.NonlinearFactorGraph()
        staying: list[tuple[frozenset[int], gtsam.NonlinearFactor]] = []
        for involved, factor in self._factors:
            if involved & leaving:
                graph.push_back(factor)
            else:
                staying.append((involved, factor))
        ordering = gtsam.Ordering(sorted(leaving))
        try:
            _, remaining = graph.linearize(self.values).eliminatePartialMultifrontal(ordering, gtsam.EliminateQR)
        except RuntimeError as error:
            raise WindowError(f"a state cannot be marginalised: {_one_line(error)}") from None
        for i in range(remaining.size()):
            marginal = remaining.at(i)
            if marginal is not None and len(marginal.keys()):
                container = gtsam.LinearContainerFactor(marginal, self.values)
                staying.append((frozenset(marginal.keys()), container))
        for key in leaving:
            self.values.erase(key)
        self._factors = staying  # the solution still tells the covariances of those that stay

    def _solve(self, last: tuple[int, ...]) -> gtsam.GaussianBayesTree:
        """The window eliminated at its present values, some variables last."""
        if self._solution is not None and self._last[-len(last) :] == last:
            return self._solution
        loose = set(self.values.keys()).difference(*(involved for involved, _ in self._factors))
        if loose:
            raise WindowError(f"no factor constrains variable {gtsam.DefaultKeyFormatter(min(loose))}")
        graph = gtsam.NonlinearFactorGraph()
        for _, factor in self._factors:
            graph.push_back(factor)
        last = tuple(key for key in last if self.values.exists(key))
        try:
            ordering = gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(
                graph, gtsam.KeyVector(list(last)), True
            )
            self._solution = graph.linearize(self.values).eliminateMultifrontal(ordering, gtsam.EliminateQR)
        except RuntimeError as error:
            raise WindowError(f"the window has no unique solution: {_one_line(error)}") from None
        self._last = last
        return self._solution


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
