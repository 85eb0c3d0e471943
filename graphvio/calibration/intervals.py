"""Which segments of time make pose pairs: those that together tell most, none of them twice.

A motion over one frame is small and noisy; over a second it is larger, but so is its error. Every instant belongs to at
most one segment, so that no noise is counted twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.calibration.consistency import whitened
from graphvio.calibration.pose_pairs import PosePairs

LENGTHS_S = (0.0, 0.1, 0.2, 0.35, 0.6, 1.0)
"""Lengths of the segments that are tried; 0 is one frame."""

_FIRST_S = 0.35
_NS_PER_S = 1e9


@dataclass(frozen=True, eq=False)
class Segments:
    """Motions of J cameras over N segments of time, which may overlap.

    Attributes:
        start_ns: (N,) int64.
        end_ns: (N,) int64.
        first: (N,) which of the instants each begins at.
        last: (N,) which of them it ends at.
        motions: (N, J, 4, 4) pose of each camera at the end in its frame at the start.
        covariances: (N, J, 6, 6), tangent in the frame at the end.
        known: (N, J) where a camera tells its motion.
    """

    start_ns: Int
    end_ns: Int
    first: Int
    last: Int
    motions: Float
    covariances: Float
    known: Bool

    def __len__(self) -> int:
        return len(self.start_ns)

    @property
    def cameras(self) -> int:
        """J."""
        return int(self.known.shape[1])

    def chosen(self, rows: Bool | Int | Sequence[int]) -> Segments:
        """Some of them."""
        which = np.asarray(rows, dtype=None if isinstance(rows, np.ndarray) else np.int64)
        return Segments(
            self.start_ns[which],
            self.end_ns[which],
            self.first[which],
            self.last[which],
            self.motions[which],
            self.covariances[which],
            self.known[which],
        )

    def of_both(self, one: int, other: int) -> Segments:
        """Those over which two cameras tell their motions, and these two only, in this order."""
        both = self.chosen(self.known[:, one] & self.known[:, other])
        columns = [one, other]
        return Segments(
            both.start_ns,
            both.end_ns,
            both.first,
            both.last,
            both.motions[:, columns],
            both.covariances[:, columns],
            both.known[:, columns],
        )

    @property
    def pairs(self) -> PosePairs:
        """Pose pairs of the first two cameras, which must know all their motions."""
        told = [np.ascontiguousarray(each[:, j]) for j in (0, 1) for each in (self.motions, self.covariances)]
        return PosePairs(self.start_ns, self.end_ns, *told)


Between = Callable[[int, int], "tuple[Float, Float] | None"]
"""Motion (4, 4) and covariance (6, 6) from one stamp to another, or None."""


def all_segments(stamps_ns: Sequence[int], betweens: Sequence[Between]) -> Segments:
    """Segments of several lengths from every instant on, over which the first camera and another one tell.

    Args:
        stamps_ns: T instants in order.
        betweens: of each camera.
    """
    stamps = np.array(stamps_ns, dtype=np.int64)
    places, told = [], []
    for i, j in zip(*(ends.tolist() for ends in ends_of(stamps)), strict=True):
        motions = [between(stamps_ns[i], stamps_ns[j]) for between in betweens]
        if motions[0] is not None and sum(motion is not None for motion in motions) > 1:
            places.append((i, j))
            told.append(motions)
    nothing = np.full((4, 4), np.nan), np.full((6, 6), np.nan)
    count, cameras = len(told), len(betweens)
    first, last = np.array(places, dtype=np.int64).reshape(-1, 2).T
    return Segments(
        stamps[first],
        stamps[last],
        first,
        last,
        np.array([[(each or nothing)[0] for each in row] for row in told]).reshape(count, cameras, 4, 4),
        np.array([[(each or nothing)[1] for each in row] for row in told]).reshape(count, cameras, 6, 6),
        np.array([[each is not None for each in row] for row in told], dtype=np.bool_).reshape(count, cameras),
    )


def ends_of(stamps_ns: Int) -> tuple[Int, Int]:
    """Between which of T instants segments of all lengths lie, from every instant on: first (N,) and last (N,)."""
    count = len(stamps_ns)
    lengths_ns = np.round(np.array(LENGTHS_S) * _NS_PER_S).astype(np.int64)
    ends = np.searchsorted(stamps_ns, stamps_ns[:, None] + lengths_ns, "right") - 1
    ends = np.maximum(ends, np.arange(1, count + 1)[:, None])  # (T, lengths), ascending
    new = np.diff(ends, axis=1, prepend=-1) > 0
    within = new & (ends < count)
    within &= stamps_ns[np.minimum(ends, count - 1)] - stamps_ns[:, None] <= 1.5 * lengths_ns[-1]
    first = np.repeat(np.arange(count)[:, None], len(lengths_ns), axis=1)
    return first[within], ends[within]


def of_one_length(segments: Segments) -> list[int]:
    """Segments of some tenths of a second, one after the other: to begin with, as nothing is known."""
    duration = (segments.end_ns - segments.start_ns) / _NS_PER_S
    nearest: dict[int, int] = {}
    for row, i in enumerate(segments.first.tolist()):
        if i not in nearest or abs(duration[row] - _FIRST_S) < abs(duration[nearest[i]] - _FIRST_S):
            nearest[i] = row
    chosen: list[int] = []
    free = 0
    for i in sorted(nearest):
        if i >= free:
            chosen.append(nearest[i])
            free = int(segments.last[nearest[i]])
    return chosen


def worth(pairs: PosePairs, left2_T_left1: Float, covariance: Float) -> Float:
    """What each of N pose pairs is worth (N,): by how much it lowers the logarithm of the volume of what is possible,
    to first order.

    Args:
        pairs: to judge.
        left2_T_left1: about where the solution is (4, 4).
        covariance: (6, 6) of it, by a first choice.
    """
    _, jacobians = whitened(pairs, left2_T_left1)
    return np.asarray(np.einsum("nki,ij,nkj->n", jacobians, covariance, jacobians))


def most_telling(segments: Segments, worths: Float) -> list[int]:
    """Segments that do not overlap and together are worth most, by dynamic programming over the instants.

    Args:
        segments: N to choose from.
        worths: (N,) of each.
    """
    ending: dict[int, list[int]] = {}
    for row, j in enumerate(segments.last.tolist()):
        ending.setdefault(j, []).append(row)
    first = segments.first.tolist()
    count = int(segments.last.max(initial=0)) + 1
    best = np.zeros(count)  # worth of all segments that end by then
    by: list[int | None] = [None] * count
    for j in range(1, count):
        best[j] = best[j - 1]
        for row in ending.get(j, ()):
            total = best[first[row]] + worths[row]
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
            j = first[ended]
    return chosen[::-1]
