"""The marginal distribution of some variables of a solved window."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import takewhile

import gtsam
import numpy as np
from scipy.linalg import lapack

from graphvio.arrays import Float

_SINGULAR = 1e-9


@dataclass(frozen=True, eq=False)
class Marginal:
    """The joint Gaussian distribution of some variables, whose step x from their present values has ``R x = d``.

    Attributes:
        columns: Key of a variable -> its columns of R.
        square_root: R (N, N), upper triangle; ``R^T R`` is the information.
        right_side: d (N,), zero where the present values are the solution.
    """

    columns: dict[int, slice]
    square_root: Float
    right_side: Float

    def covariance(self, keys: Sequence[int]) -> Float | None:
        """Return the covariance of some of the variables, in the order given, or None if it is unbounded.

        R is inverted instead of the information, for its better condition.
        """
        inverse = self._inverse
        if inverse is None:
            return None
        rows = np.concatenate([inverse[self.columns[key]] for key in keys])
        return np.asarray(rows @ rows.T)

    def step(self) -> Float | None:
        """Return x (N,), or None if R is singular."""
        solution, failed = lapack.dtrtrs(self.square_root, self.right_side)
        return None if failed else np.asarray(solution)

    def at_solution(self) -> Marginal:
        """Return the distribution after the step has been taken."""
        return Marginal(self.columns, self.square_root, np.zeros(len(self.right_side)))

    def of_last(self, keys: Sequence[int]) -> Marginal:
        """Return the marginal distribution of the last variables."""
        start = self.columns[keys[0]].start
        columns = {key: slice(self.columns[key].start - start, self.columns[key].stop - start) for key in keys}
        return Marginal(columns, self.square_root[start:, start:], self.right_side[start:])

    def extended(
        self, factors: Sequence[gtsam.GaussianFactor], last: Sequence[int], dims: Mapping[int, int]
    ) -> Marginal | None:
        """Return the joint distribution after factors and their variables have been added.

        Args:
            factors: The factors, linearised at the present values.
            last: Keys of the variables that are ordered last.
            dims: Key -> dimension, of all variables.

        Returns:
            The distribution, or None where some variable is not constrained.
        """
        new = frozenset(key for factor in factors for key in list(factor.keys())) - self.columns.keys()
        keys = [key for key in (*self.columns, *sorted(new)) if key not in last]
        columns, size = _columns([*keys, *last], dims)
        jacobians = [factor.jacobian() for factor in factors]
        rows = np.zeros((len(self.right_side) + sum(len(right) for _, right in jacobians), size + 1))
        if len(rows) < size:
            return None
        block, remaining = np.split(rows, [len(self.right_side)])
        block[:, size] = self.right_side
        for key, at in self.columns.items():
            block[:, columns[key]] = self.square_root[:, at]
        for factor, (jacobian, right) in zip(factors, jacobians, strict=True):
            block, remaining = np.split(remaining, [len(right)])
            block[:, size] = right
            start = 0
            for key in list(factor.keys()):
                block[:, columns[key]] = jacobian[:, start : start + dims[key]]
                start += dims[key]
        triangle = lapack.dgeqrf(rows)[0]
        return Marginal(columns, triangle[:size, :size] * _upper(size), triangle[:size, size])

    @cached_property
    def _inverse(self) -> Float | None:
        if np.abs(self.square_root.diagonal()).min() < _SINGULAR:
            return None
        return np.asarray(lapack.dtrtri(self.square_root)[0])


def marginal_of_last(
    solution: gtsam.GaussianBayesTree, last: Sequence[int], dims: Mapping[int, int]
) -> Marginal | None:
    """Return the marginal of the variables that were eliminated last, or None if some are not in a root clique.

    As a rule all states are connected, and these variables are the lower corner of the only root; just after a start
    there may be several roots.

    Args:
        solution: Bayes tree of the linearised window.
        last: Keys of the variables.
        dims: Key -> dimension, of all variables.
    """
    conditionals = [root.conditional() for root in solution.roots()]
    ends = [list(takewhile(frozenset(last).__contains__, reversed(list(each.keys())))) for each in conditionals]
    if sum(map(len, ends)) != len(last):
        return None
    columns, size = _columns([key for end in ends for key in reversed(end)], dims)
    square_root, right_side, at = np.zeros((size, size)), np.zeros(size), 0
    for conditional, end in zip(conditionals, ends, strict=True):
        width = sum(dims[key] for key in end)
        if width:
            square_root[at : at + width, at : at + width] = np.array(conditional.R())[-width:, -width:]
            right_side[at : at + width] = conditional.d()[-width:]
            at += width
    return Marginal(columns, square_root, right_side)


@cache
def _upper(size: int) -> Float:
    """Return ones on and above the diagonal (size, size), made once; `numpy.triu` would make them in each call."""
    return np.triu(np.ones((size, size)))


def _columns(keys: Iterable[int], dims: Mapping[int, int]) -> tuple[dict[int, slice], int]:
    """Return the columns of variables that stand side by side in a matrix, and the number of columns."""
    columns, size = {}, 0
    for key in keys:
        columns[key] = slice(size, size + dims[key])
        size += dims[key]
    return columns, size
