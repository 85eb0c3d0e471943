"""A fixed-lag window of a factor graph, optimised as a whole, whose oldest states are marginalised exactly.

Factors and values are kept here, outside gtsam's solvers, so that the window can always be rebuilt.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.marginal import Marginal, marginal_of_last
from graphvio.errors import GraphvioError

_MAX_ITERATIONS = 4
_STEP_SHARES = (1.0, 0.5, 0.25, 0.125)
_CONVERGED = 1e-2  # radians, metres...: the next step would be of the order of its square


class WindowError(GraphvioError):
    """The window's equations have no unique solution."""


SOLVER_ERRORS = (WindowError, RuntimeError, np.linalg.LinAlgError)
"""Errors raised by a window, gtsam and numpy where equations have no solution."""


class GraphWindow:
    """Nonlinear factors and the present values of their variables.

    Args:
        min_iterations: Lower limit for the iterations of each optimisation; robust kernels need two, as the first
            iteration weighs new factors by their initial error.
    """

    def __init__(self, min_iterations: int = 1) -> None:
        self._min_iterations = min_iterations
        self.values = gtsam.Values()
        self._graph = gtsam.NonlinearFactorGraph()
        self._involved: dict[int, frozenset[int]] = {}  # slot of the graph -> variables of the factor in it
        self._free: list[int] = []  # slots
        self._marginal: Marginal | None = None  # marginal of the variables eliminated last, and of some added since
        self._unknown: list[int] = []  # slots of the factors that `_marginal` does not include
        self._known_keys: frozenset[int] = frozenset()  # variables of all other factors
        self._cholesky_suffices = True
        self._dims: dict[int, int] = {}  # dimensions of variables; asking gtsam for them is slow

    def add(self, factor: gtsam.NonlinearFactor) -> None:
        """Insert a factor; its variables must have values."""
        self._unknown.append(self._insert(factor))

    def optimize(self, retained: Sequence[int] = ()) -> None:
        """Optimise by Gauss-Newton from the present values.

        Args:
            retained: Variables whose covariance will be needed, and which new factors will involve: their covariance is
                then found without solving the whole window again.

        Raises:
            WindowError: if some variable is not constrained, or the solution is not finite; the values stay as
                they were.
        """
        values = self.values
        try:
            for iteration in range(1, _MAX_ITERATIONS + 1):
                step = self._solve(retained).optimize()
                largest = np.abs(step.vector()).max()
                if not np.isfinite(largest):
                    raise WindowError("the window's solution is not finite")
                is_last = largest < _CONVERGED and iteration >= self._min_iterations
                moved = self.values.retract(step) if is_last else self._improved(step)
                if moved is not None:
                    self.values = moved
                if self._marginal is not None:
                    self._marginal = self._marginal.at_solution()
                if is_last or moved is None:
                    break
        except RuntimeError as error:
            self.values, self._marginal = values, None
            raise WindowError(f"the window cannot be optimised: {_one_line(error)}") from None
        except WindowError:
            self.values, self._marginal = values, None
            raise

    def advance(self, retained: Sequence[int]) -> bool:
        """Update only the variables that the last solution retained, and those inserted since then.

        This is a filter step whose prior is the window's exact marginal; all other variables keep their values.

        Args:
            retained: As for `optimize`, some of these variables, for the next call.

        Returns:
            Whether the update was made. It is not, and nothing changes, where the marginal lacks variables that the new
            factors involve, or where the step is too long for a linear one.
        """
        if self._min_iterations > 1:
            return False
        marginal = self._extended_marginal(retained)
        step = None if marginal is None else marginal.step()
        if marginal is None or step is None or not np.abs(step).max() < _CONVERGED:
            return False
        delta = gtsam.VectorValues()
        for key, at in marginal.columns.items():
            delta.insert(key, step[at])
        self.values = self.values.retract(delta)
        self._take(marginal.of_last(retained).at_solution())
        return True

    def joint_covariance(self, keys: Sequence[int]) -> Float:
        """Return the joint covariance of some variables, in the order given.

        Raises:
            WindowError: if some variable is not constrained.
        """
        unknown = [key for key in keys if not self.values.exists(key)]
        if unknown:
            raise WindowError(f"the window has no variable {_named(unknown[:1])}")
        if self._unknown:
            self._take(self._extended_marginal())
        if self._marginal is None or not self._marginal.columns.keys() >= set(keys):
            self._solve(keys)
        covariance = None if self._marginal is None else self._marginal.covariance(keys)
        if covariance is None:
            raise WindowError(f"the window has no covariance of {_named(keys)}")
        return covariance

    def marginalise(self, keys: Iterable[int]) -> None:
        """Marginalise variables: replace them and their factors by a linear factor on the other variables.

        Raises:
            WindowError: if one of them is not constrained.
        """
        leaving = frozenset(keys)
        if not leaving:
            return
        slots = [slot for slot, involved in self._involved.items() if involved & leaving]
        if not leaving <= frozenset().union(*(self._involved[slot] for slot in slots)):
            raise WindowError("a state cannot be marginalised: no factor constrains it")
        graph = gtsam.NonlinearFactorGraph()
        for slot in slots:
            graph.push_back(self._graph.at(slot))
        ordering = gtsam.Ordering(sorted(leaving))
        try:
            _, remaining = graph.linearize(self.values).eliminatePartialMultifrontal(ordering, gtsam.EliminateQR)
        except RuntimeError as error:
            raise WindowError(f"a state cannot be marginalised: {_one_line(error)}") from None
        if self._unknown or (self._marginal is not None and self._marginal.columns.keys() & leaving):
            self._take(None)  # else it still has the covariances of the variables that stay
        for slot in slots:
            self._graph.remove(slot)
            del self._involved[slot]
            self._free.append(slot)
        for i in range(remaining.size()):
            marginal = remaining.at(i)
            if marginal is not None and len(marginal.keys()):
                self._insert(gtsam.LinearContainerFactor(marginal, self.values))
        for key in leaving:
            self.values.erase(key)
        self._known_keys -= leaving

    def _improved(self, step: gtsam.VectorValues) -> gtsam.Values | None:
        """Return the values after a long step, or after a part of it that does not increase the error, or None.

        Where a direction is hardly constrained, such as the heading after time without images and IMU, a step along it
        may leave the range in which the equations are linear.
        """
        before = self._graph.error(self.values)
        for share in _STEP_SHARES:
            values = self.values.retract(step.scale(share))
            if self._graph.error(values) <= before:
                return values
        return None

    def _insert(self, factor: gtsam.NonlinearFactor) -> int:
        """Put a factor into a free slot of the graph, and return the slot."""
        if self._free:
            slot = self._free.pop()
            self._graph.replace(slot, factor)
        else:
            slot = self._graph.size()
            self._graph.push_back(factor)
        self._involved[slot] = frozenset(factor.keys())
        return slot

    def _solve(self, last: Sequence[int]) -> gtsam.GaussianBayesTree:
        """Eliminate the window at its present values, with the variables ``last`` last, and keep their marginal."""
        if len(self._graph.keyVector()) < self.values.size():
            loose = set(self.values.keys()).difference(*self._involved.values())
            raise WindowError(f"no factor constrains variable {_named([min(loose)])}")
        try:
            ordering = gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(
                self._graph, gtsam.KeyVector(list(last)), True
            )
            solution = self._eliminated(self._graph.linearize(self.values), ordering)
        except RuntimeError as error:
            raise WindowError(f"the window has no unique solution: {_one_line(error)}") from None
        self._take(marginal_of_last(solution, last, self._known_dims(last)))
        return solution

    def _eliminated(self, graph: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.GaussianBayesTree:
        """Eliminate by Cholesky factorisation, or by QR once the precision of Cholesky has not sufficed.

        Cholesky takes half of the time, but fails where the random walk of the biases is very small.
        """
        if self._cholesky_suffices:
            try:
                return graph.eliminateMultifrontal(ordering)
            except RuntimeError:
                self._cholesky_suffices = False
        return graph.eliminateMultifrontal(ordering, gtsam.EliminateQR)

    def _extended_marginal(self, last: Sequence[int] = ()) -> Marginal | None:
        """Return the marginal with the newest factors and their variables, ordered so that ``last`` are the last ones.

        None if these factors involve variables that the marginal does not include.
        """
        if self._marginal is None:
            return None
        retained = self._marginal.columns.keys()
        touched = frozenset().union(*(self._involved[slot] for slot in self._unknown))
        if touched & self._known_keys - retained or not retained | touched >= set(last):
            return None
        linear = [self._graph.at(slot).linearize(self.values) for slot in self._unknown]
        return self._marginal.extended(linear, last, self._known_dims(retained | touched))

    def _take(self, marginal: Marginal | None) -> None:
        """Store a marginal that includes all factors, or None."""
        self._known_keys |= frozenset().union(*(self._involved[slot] for slot in self._unknown))
        self._marginal, self._unknown = marginal, []

    def _known_dims(self, keys: Iterable[int]) -> dict[int, int]:
        """Return the dimensions of variables, at least of these."""
        if not all(map(self._dims.__contains__, keys)):
            self._dims = self.values.dims()
        return self._dims


def _named(keys: Iterable[int]) -> str:
    return ", ".join(map(gtsam.DefaultKeyFormatter, keys))


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
