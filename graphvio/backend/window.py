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
_CONVERGED = 1e-5


class WindowError(GraphvioError):
    """The window's equations have no unique solution."""


class Window:
    """Nonlinear factors and the present values of their variables."""

    def __init__(self) -> None:
        self._factors: list[tuple[frozenset[int], gtsam.NonlinearFactor]] = []
        self.values = gtsam.Values()
        self._solution: gtsam.GaussianBayesTree | None = None

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
                step = self._solve().optimize()
                size = step.norm()
                if not np.isfinite(size):
                    raise WindowError("the window's solution is not finite")
                self.values = self.values.retract(step)
                self._solution = None
                if size < _CONVERGED:
                    break
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
        try:
            if len(keys) == 1:
                return np.asarray(self._solve().marginalCovariance(keys[0]))
            joint = self._solve().jointMarginalCovariance(gtsam.KeyVector(list(keys)))
        except RuntimeError as error:
            raise WindowError(f"the window has no covariance: {_one_line(error)}") from None
        blocks = [[joint.at(a, b) for b in keys] for a in keys]
        return np.block(blocks)

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
        self._factors = staying
        self._solution = None

    def _solve(self) -> gtsam.GaussianBayesTree:
        if self._solution is None:
            loose = set(self.values.keys()).difference(*(involved for involved, _ in self._factors))
            if loose:
                raise WindowError(f"no factor constrains variable {gtsam.DefaultKeyFormatter(min(loose))}")
            graph = gtsam.NonlinearFactorGraph()
            for _, factor in self._factors:
                graph.push_back(factor)
            try:
                self._solution = graph.linearize(self.values).eliminateMultifrontal(
                    gtsam.Ordering.OrderingType.COLAMD, gtsam.EliminateQR
                )
            except RuntimeError as error:
                raise WindowError(f"the window has no unique solution: {_one_line(error)}") from None
        return self._solution


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
