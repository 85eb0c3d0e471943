"""Covariances of all variables of a linear system at once.

The covariance of a variable, with those that it depends on, follows from the covariance of the latter alone, so that
all are found from the last variable to the first (K. Takahashi, J. Fagan, M.-S. Chin, 1973). Variables are taken
together in cliques. Asked for one by one, each variable of the few large cliques, in which loop closures tie many
states together, would cost the elimination of its whole clique.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import lapack

from graphvio.arrays import Float

_MAX_ZEROS = 3  # variables in a clique that one of its variables does not depend on: cheaper than one more clique
_MAX_MERGED = 6  # variables of a clique that has such


@dataclass(eq=False)
class _Clique:
    """Variables of successive elimination, each tied to all after it and to the separator."""

    rows: list[int]  # of the variables in the system, the last one first
    separator: list[int]  # keys of the variables after them that they depend on
    parent: _Clique | None  # the clique that holds all of the separator, or None
    children: int  # number of cliques whose parent it is and that have no covariance yet
    columns: dict[int, slice]  # of its variables and the separator in ``covariance``
    covariance: Float  # of both; empty before it is computed, and after the last child's is


def covariances(net: gtsam.GaussianBayesNet) -> Iterator[tuple[int, Float]]:
    """Yield key and covariance of each variable of a system after its elimination, one variable a row."""
    conditionals = dict(enumerate(net.at(row) for row in range(net.size())))
    del net  # each row is freed when it has been used
    keys = [list(each.keys()) for each in conditionals.values()]
    dims = {each[0]: len(conditionals[row].R()) for row, each in enumerate(keys)}
    for clique in _cliques(keys):
        rows = clique.rows[::-1]
        frontal = [keys[row][0] for row in rows]
        size = 0
        for key in (*frontal, *clique.separator):
            clique.columns[key] = slice(size, size + dims[key])
            size += dims[key]
        width = sum(dims[key] for key in frontal)
        system = np.zeros((width, size))
        for row in rows:
            key, *others = keys[row]
            own = system[clique.columns[key]]
            conditional = conditionals.pop(row)
            own[:, clique.columns[key]] = conditional.R()
            coupling, at = conditional.S(), 0
            for other in others:
                own[:, clique.columns[other]] = coupling[:, at : at + dims[other]]
                at += dims[other]
        clique.covariance = _covariance(system, width, _of_separator(clique))
        for key in frontal:
            yield key, clique.covariance[clique.columns[key], clique.columns[key]].copy()
        if not clique.children:
            clique.covariance = np.zeros((0, 0))


def _cliques(keys: list[list[int]]) -> list[_Clique]:
    """Return the cliques, each after its parent, of rows given by the keys of their variables, the eliminated first."""
    row_of = {each[0]: row for row, each in enumerate(keys)}
    of: dict[int, _Clique] = {}
    found: list[_Clique] = []
    for row in range(len(keys) - 1, -1, -1):
        key, *separator = keys[row]
        after = min(separator, key=row_of.__getitem__, default=None)
        parent = None if after is None else of[after]
        if after is not None and parent is not None and parent.rows[-1] == row_of[after]:
            zeros = len(keys[row_of[after]]) - len(separator)
            if zeros == 0 or (zeros <= _MAX_ZEROS and len(parent.rows) < _MAX_MERGED):
                parent.rows.append(row)
                of[key] = parent
                continue
        if parent is not None:
            parent.children += 1
        of[key] = _Clique([row], separator, parent, 0, {}, np.zeros((0, 0)))
        found.append(of[key])
    return found


def _of_separator(clique: _Clique) -> Float:
    """Return the covariance of a clique's separator from its parent, whose own is freed after the last child."""
    parent = clique.parent
    if parent is None:
        return np.zeros((0, 0))
    at = np.concatenate([np.arange(parent.columns[key].start, parent.columns[key].stop) for key in clique.separator])
    taken: Float = parent.covariance[at[:, None], at]
    parent.children -= 1
    if not parent.children:
        parent.covariance = np.zeros((0, 0))
    return taken


def _covariance(system: Float, width: int, of_separator: Float) -> Float:
    """Return the joint covariance (N, N) of ``width`` variables with ``system`` (width, N) and of their separator."""
    inverse = lapack.dtrtri(np.asfortranarray(system[:, :width]))[0]
    step = inverse @ system[:, width:]
    joint = np.empty((system.shape[1], system.shape[1]))
    shared = step @ of_separator
    joint[:width, :width] = inverse @ inverse.T + shared @ step.T
    joint[:width, width:] = -shared
    joint[width:, :width] = -shared.T
    joint[width:, width:] = of_separator
    return joint
