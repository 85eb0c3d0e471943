"""Which stretches of time make pose pairs: those that together tell most, none of them twice.

A motion over one frame is small and noisy; over a second it is larger, but so is its error. Every instant belongs to at
most one stretch, so that no noise is counted twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.calibration.consistency import whitened
from graphvio.calibration.pose_pairs import PosePairs

LONGEST_S = 1.0
_LENGTHS_S = (0.0, 0.1, 0.2, 0.35, 0.6, LONGEST_S)  # 0: one frame
_FIRST_S = 0.35
_NS_PER_S = 1e9


class Stretches(NamedTuple):
    """Pose pairs over any stretches, and between which of T instants each lies."""

    pairs: PosePairs
    first: list[int]
    last: list[int]

    def chosen(self, rows: Sequence[int]) -> PosePairs:
        """The pose pairs of some stretches."""
        return self.pairs.chosen(np.array(rows, dtype=np.int64))


Between = Callable[[int, int], "tuple[Float, Float] | None"]
"""Motion (4, 4) and covariance (6, 6) from one stamp to another, or None."""


def all_stretches(stamps_ns: Sequence[int], between_1: Between, between_2: Between) -> Stretches:
    """Pose pairs over stretches of several lengths, from every instant on.

    Args:
        stamps_ns: T instants in order.
        between_1: of the first camera.
        between_2: of the other one.
    """
    stamps = np.array(stamps_ns, dtype=np.int64)
    rows, first, last = [], [], []
    for i, start_ns in enumerate(stamps_ns):
        ends = np.searchsorted(stamps, start_ns + np.round(np.array(_LENGTHS_S) * _NS_PER_S), "right") - 1
        for j in np.unique(np.maximum(ends, i + 1)).tolist():
            if j >= len(stamps) or stamps[j] - start_ns > 1.5 * LONGEST_S * _NS_PER_S:
                continue
            one, other = between_1(start_ns, stamps_ns[j]), between_2(start_ns, stamps_ns[j])
            if one is not None and other is not None:
                rows.append((start_ns, stamps_ns[j], *one, *other))
                first.append(i)
                last.append(j)
    columns = zip(*rows, strict=True) if rows else ((),) * 6
    start, end, motion_1, covariance_1, motion_2, covariance_2 = (np.array(column) for column in columns)
    pairs = PosePairs(
        start.astype(np.int64),
        end.astype(np.int64),
        motion_1.reshape(-1, 4, 4),
        covariance_1.reshape(-1, 6, 6),
        motion_2.reshape(-1, 4, 4),
        covariance_2.reshape(-1, 6, 6),
    )
    return Stretches(pairs, first, last)


def of_one_length(stretches: Stretches) -> list[int]:
    """Stretches of some tenths of a second, one after the other: to begin with, as nothing is known."""
    duration = (stretches.pairs.end_ns - stretches.pairs.start_ns) / _NS_PER_S
    nearest: dict[int, int] = {}
    for row, i in enumerate(stretches.first):
        if i not in nearest or abs(duration[row] - _FIRST_S) < abs(duration[nearest[i]] - _FIRST_S):
            nearest[i] = row
    chosen: list[int] = []
    free = 0
    for i in sorted(nearest):
        if i >= free:
            chosen.append(nearest[i])
            free = stretches.last[nearest[i]]
    return chosen


def most_telling(stretches: Stretches, left2_T_left1: Float, covariance: Float) -> list[int]:
    """Stretches that do not overlap and from which the unknown gains most.

    What a stretch is worth is the trace of its information times the covariance that is known so far: by how much it
    lowers the logarithm of the volume of what is possible.

    Args:
        stretches: to choose from.
        left2_T_left1: about where the solution is (4, 4).
        covariance: (6, 6) of it, by a first choice.
    """
    _, jacobians = whitened(stretches.pairs, left2_T_left1)
    worth = np.einsum("nki,ij,nkj->n", jacobians, covariance, jacobians)
    ending: dict[int, list[int]] = {}
    for row, j in enumerate(stretches.last):
        ending.setdefault(j, []).append(row)
    count = max(stretches.last, default=0) + 1
    best = np.zeros(count)  # worth of all stretches that end by then
    by: list[int | None] = [None] * count
    for j in range(1, count):
        best[j] = best[j - 1]
        for row in ending.get(j, ()):
            total = best[stretches.first[row]] + worth[row]
            if total > best[j]:
                best[j], by[j] = total, row
    chosen = []
    j = count - 1
    while j > 0:
        ended = by[j]
        if ended is None:
            j -= 1
        else:
            chosen.append(ended)
            j = stretches.first[ended]
    return chosen[::-1]
