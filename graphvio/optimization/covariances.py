"""Covariances of all variables of a linear system at once.

The joint covariance of a variable and those that it depends on follows from the covariance of the latter alone, so that
all are computed from the last variable to the first (K. Takahashi, J. Fagan, M.-S. Chin, 1973). Variables are grouped
in cliques. Computed one by one, each variable of the few large cliques, in which loop closures tie many states
together, would cost the elimination of its whole clique.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import lapack

from graphvio.arrays import Float

_MAX_ZEROS = 3  # variables in a clique that one of its variables does not depend on: cheaper than one more clique
_MAX_MERGED = 6  # variables of a clique in which some do not depend on all others


@dataclass(eq=False)
class _Clique:
    """Variables that are eliminated in succession, each dependent on all after it and on the separator."""

    rows: list[int]  # rows of the variables in the system, the last one first
    separator: list[int]  # keys of the later variables that they depend on
    parent: _Clique | None  # the clique that holds all of the separator, or None
    children: int  # number of cliques whose parent it is and that have no covariance yet
    columns: dict[int, slice]  # key -> columns in ``covariance``, of its variables and the separator
    covariance: Float  # joint covariance of both; empty before it is computed, and after the last child's is


def covariances(net: gtsam.GaussianBayesNet) -> Iterator[tuple[int, Float]]:
    """Yield key and covariance of each variable of an eliminated system that has one conditional per variable."""
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
    """Group rows into cliques, each after its parent; a row is given by its keys, the eliminated variable's first."""
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
    """Return the covariance of a clique's separator, cut from that of its parent, which the last child frees."""
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
    """Return the joint covariance (N, N) of variables and their separator, given their rows (``width``, N).

    ``system`` has the variables in its first ``width`` columns, followed by the separator, whose covariance is known.
    """
    inverse = lapack.dtrtri(np.asfortranarray(system[:, :width]))[0]
    step = inverse @ system[:, width:]
    joint = np.empty((system.shape[1], system.shape[1]))
    shared = step @ of_separator
    joint[:width, :width] = inverse @ inverse.T + shared @ step.T
    joint[:width, width:] = -shared
    joint[width:, :width] = -shared.T
    joint[width:, width:] = of_separator
    return joint
