"""A fixed-lag window of a factor graph: optimised as a whole, its oldest states marginalised exactly.

Factors and values are kept here, outside gtsam's solvers, so that the window can always be rebuilt.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.errors import GraphvioError

_MAX_ITERATIONS = 4
_CONVERGED = 1e-2  # radians, metres...: what a further step would still change is of the order of its square
_SINGULAR = 1e-9


class WindowError(GraphvioError):
    """The window's equations have no unique solution."""


@dataclass(frozen=True, eq=False)
class _Marginal:
    """What the window says of some variables together: the upper triangle R, where ``R^T R`` is their information."""

    columns: dict[int, slice]
    square_root: Float

    def covariance(self, keys: Sequence[int]) -> Float:
        """Covariance of some of the variables, in the order given. R is inverted, not its square: states far less
        certain than the poses relative to them do no harm."""
        inverse = self._inverse
        if inverse is None:
            raise WindowError(f"the window has no covariance of {_named(keys)}")
        rows = np.concatenate([inverse[self.columns[key]] for key in keys])
        return np.asarray(rows @ rows.T)

    @cached_property
    def _inverse(self) -> Float | None:
        if np.abs(np.diag(self.square_root)).min() < _SINGULAR:
            return None
        return np.asarray(np.linalg.inv(self.square_root))


class Window:
    """Nonlinear factors and the present values of their variables."""

    def __init__(self) -> None:
        self._factors: list[tuple[frozenset[int], gtsam.NonlinearFactor]] = []
        self.values = gtsam.Values()
        self._marginal: _Marginal | None = None  # of the variables that were eliminated last, and some added since
        self._unknown = 0  # how many factors, the newest, it does not know
        self._cholesky_suffices = True

    def add(self, factor: gtsam.NonlinearFactor) -> None:
        """Insert a factor; its variables must have values."""
        self._factors.append((frozenset(factor.keys()), factor))
        self._unknown += 1

    def optimise(self, followed: Sequence[int] = ()) -> None:
        """Gauss-Newton from the present values.

        Args:
            followed: variables whose covariance will be asked for, and to which new factors will be tied: those
                covariances are then found without solving the whole window again.

        Raises:
            WindowError: if some variable is not constrained, or the solution is not finite; the values stay as
                they were.
        """
        values = self.values
        try:
            for _ in range(_MAX_ITERATIONS):
                step = self._solve(followed).optimize()
                largest = np.abs(step.vector()).max()
                if not np.isfinite(largest):
                    raise WindowError("the window's solution is not finite")
                self.values = self.values.retract(step)
                if largest < _CONVERGED:
                    break
        except RuntimeError as error:
            self.values, self._marginal = values, None
            raise WindowError(f"the window cannot be optimised: {_one_line(error)}") from None
        except WindowError:
            self.values, self._marginal = values, None
            raise

    def joint_covariance(self, keys: Sequence[int]) -> Float:
        """Covariance of some variables together, in the order given.

        Raises:
            WindowError: if some variable is not constrained.
        """
        unknown = [key for key in keys if not self.values.exists(key)]
        if unknown:
            raise WindowError(f"the window has no variable {_named(unknown[:1])}")
        if self._unknown:
            self._marginal, self._unknown = self._extended_marginal(), 0
        if self._marginal is None or not self._marginal.columns.keys() >= set(keys):
            self._solve(keys)
        if self._marginal is None:
            raise WindowError(f"the window has no covariance of {_named(keys)}")
        return self._marginal.covariance(keys)

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
        if self._unknown or (self._marginal is not None and self._marginal.columns.keys() & leaving):
            self._marginal = None  # else it still tells the covariances of those that stay

    def _solve(self, last: Sequence[int]) -> gtsam.GaussianBayesTree:
        """The window eliminated at its present values, some variables last; their marginal is kept."""
        loose = set(self.values.keys()).difference(*(involved for involved, _ in self._factors))
        if loose:
            raise WindowError(f"no factor constrains variable {_named([min(loose)])}")
        graph = gtsam.NonlinearFactorGraph()
        for _, factor in self._factors:
            graph.push_back(factor)
        try:
            ordering = gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(
                graph, gtsam.KeyVector(list(last)), True
            )
            solution = self._eliminated(graph.linearize(self.values), ordering)
        except RuntimeError as error:
            raise WindowError(f"the window has no unique solution: {_one_line(error)}") from None
        self._marginal, self._unknown = self._root_marginal(solution, last), 0
        return solution

    def _eliminated(self, graph: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.GaussianBayesTree:
        """Cholesky takes half of the time. It refuses where its digits do not suffice, as with biases that hardly walk;
        QR does it then, and from then on."""
        if self._cholesky_suffices:
            try:
                return graph.eliminateMultifrontal(ordering)
            except RuntimeError:
                self._cholesky_suffices = False
        return graph.eliminateMultifrontal(ordering, gtsam.EliminateQR)

    def _root_marginal(self, solution: gtsam.GaussianBayesTree, last: Sequence[int]) -> _Marginal | None:
        """The marginal of the variables that were eliminated last, or None if some are not in a root.

        As a rule all states are tied to each other, and they are the lower corner of the one root; just after a start
        there may be several.
        """
        conditionals = [root.conditional() for root in solution.roots()]
        ends = [list(takewhile(frozenset(last).__contains__, reversed(list(each.keys())))) for each in conditionals]
        if sum(map(len, ends)) != len(last):
            return None
        columns, size = self._columns([key for end in ends for key in reversed(end)])
        square_root, at = np.zeros((size, size)), 0
        for conditional, end in zip(conditionals, ends, strict=True):
            width = sum(columns[key].stop - columns[key].start for key in end)
            corner = np.array(conditional.R())[-width:, -width:] if width else np.zeros((0, 0))
            square_root[at : at + width, at : at + width] = corner
            at += width
        return _Marginal(columns, square_root)

    def _extended_marginal(self) -> _Marginal | None:
        """The marginal with the newest factors and their variables, or None if that cannot be told from it."""
        if self._marginal is None:
            return None
        followed = self._marginal.columns.keys()
        known, unknown = self._factors[: -self._unknown], self._factors[-self._unknown :]
        settled = frozenset().union(*(keys for keys, _ in known))
        touched = frozenset().union(*(keys for keys, _ in unknown))
        if touched & settled - followed:
            return None
        columns, size = self._columns([*followed, *sorted(touched - followed)])
        old = self._marginal.square_root
        rows = [np.pad(old, ((0, 0), (0, size - len(old))))]
        for _, factor in unknown:
            linear = factor.linearize(self.values)
            jacobian, at = linear.jacobian()[0], 0
            block = np.zeros((len(jacobian), size))
            for key in list(linear.keys()):
                width = columns[key].stop - columns[key].start
                block[:, columns[key]] = jacobian[:, at : at + width]
                at += width
            rows.append(block)
        root = np.asarray(np.linalg.qr(np.concatenate(rows), mode="r"))
        return _Marginal(columns, root) if len(root) == size else None

    def _columns(self, keys: Iterable[int]) -> tuple[dict[int, slice], int]:
        """Where variables stand in a matrix that has them side by side, and how wide it is."""
        dims, columns, size = self.values.dims(), {}, 0
        for key in keys:
            columns[key] = slice(size, size + dims[key])
            size += dims[key]
        return columns, size


def _named(keys: Iterable[int]) -> str:
    return ", ".join(map(gtsam.DefaultKeyFormatter, keys))


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
