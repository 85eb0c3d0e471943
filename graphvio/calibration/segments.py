"""Segments of a recording over which motions of cameras form pose pairs, and the selection of those that are used.

A motion over one frame is small and noisy; over a second it is larger, but so is its error. Every instant belongs to at
most one of the chosen segments, so that no noise is counted twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.calibration.consistency import whitened
from graphvio.calibration.pose_pairs import PosePairs

LENGTHS_S = (0.0, 0.1, 0.2, 0.35, 0.6, 1.0)
"""Lengths of the segments that are tried; 0 is one frame."""

_INITIAL_LENGTH_S = 0.35
_NS_PER_S = 1e9

Between = Callable[[int, int], "tuple[Float, Float] | None"]
"""Motion (4, 4) and covariance (6, 6) from one stamp to another, or None."""


@dataclass(frozen=True, eq=False)
class Segments:
    """Motions of J cameras over N segments, which may overlap."""

    start_ns: Int  # (N,) int64
    end_ns: Int  # (N,) int64
    first: Int  # (N,) index of the instant at which each begins
    last: Int  # (N,) index of the instant at which it ends
    motions: Float  # (N, J, 4, 4) pose of each camera at the end in its frame at the start
    covariances: Float  # (N, J, 6, 6), tangent in the frame at the end
    known: Bool  # (N, J) whether the motion was measured

    def __len__(self) -> int:
        return len(self.start_ns)

    @property
    def cameras(self) -> int:
        """Number J of cameras."""
        return int(self.known.shape[1])

    def select(self, rows: Bool | Int) -> Segments:
        """Return some of the segments, by mask or indices."""
        return Segments(*(getattr(self, field.name)[rows] for field in fields(self)))

    def of_both(self, one: int, other: int) -> Segments:
        """Return the segments over which the motions of two cameras are known, for these two in this order."""
        both = self.select(self.known[:, one] & self.known[:, other])
        columns = [one, other]
        return replace(
            both,
            motions=both.motions[:, columns],
            covariances=both.covariances[:, columns],
            known=both.known[:, columns],
        )

    @property
    def pairs(self) -> PosePairs:
        """Pose pairs of the first two cameras, all of whose motions must be known."""
        values = [np.ascontiguousarray(each[:, j]) for j in (0, 1) for each in (self.motions, self.covariances)]
        return PosePairs(self.start_ns, self.end_ns, *values)


def all_segments(stamps_ns: Sequence[int], betweens: Sequence[Between]) -> Segments:
    """List segments of several lengths from T instants, where the first and at least one other motion are known."""
    stamps = np.array(stamps_ns, dtype=np.int64)
    ends, measured = [], []
    for i, j in zip(*(each.tolist() for each in segment_ends(stamps)), strict=True):
        motions = [between(stamps_ns[i], stamps_ns[j]) for between in betweens]
        if motions[0] is not None and sum(motion is not None for motion in motions) > 1:
            ends.append((i, j))
            measured.append(motions)
    nothing = np.full((4, 4), np.nan), np.full((6, 6), np.nan)
    count, cameras = len(measured), len(betweens)
    first, last = np.array(ends, dtype=np.int64).reshape(-1, 2).T
    return Segments(
        stamps[first],
        stamps[last],
        first,
        last,
        np.array([[(each or nothing)[0] for each in row] for row in measured]).reshape(count, cameras, 4, 4),
        np.array([[(each or nothing)[1] for each in row] for row in measured]).reshape(count, cameras, 6, 6),
        np.array([[each is not None for each in row] for row in measured], dtype=np.bool_).reshape(count, cameras),
    )


def segment_ends(stamps_ns: Int) -> tuple[Int, Int]:
    """Return the indices first (N,) and last (N,) of segments of all lengths from each of T instants."""
    count = len(stamps_ns)
    lengths_ns = np.round(np.array(LENGTHS_S) * _NS_PER_S).astype(np.int64)
    ends = np.searchsorted(stamps_ns, stamps_ns[:, None] + lengths_ns, "right") - 1
    ends = np.maximum(ends, np.arange(1, count + 1)[:, None])  # (T, lengths), ascending
    new = np.diff(ends, axis=1, prepend=-1) > 0
    within = new & (ends < count)
    within &= stamps_ns[np.minimum(ends, count - 1)] - stamps_ns[:, None] <= 1.5 * lengths_ns[-1]
    first = np.repeat(np.arange(count)[:, None], len(lengths_ns), axis=1)
    return first[within], ends[within]


def of_one_length(segments: Segments) -> Int:
    """Return indices of segments of about a third of a second, one after the other, for a first solution."""
    duration = (segments.end_ns - segments.start_ns) / _NS_PER_S
    nearest: dict[int, int] = {}
    for row, i in enumerate(segments.first.tolist()):
        if i not in nearest or abs(duration[row] - _INITIAL_LENGTH_S) < abs(duration[nearest[i]] - _INITIAL_LENGTH_S):
            nearest[i] = row
    chosen: list[int] = []
    free = 0
    for i in sorted(nearest):
        if i >= free:
            chosen.append(nearest[i])
            free = int(segments.last[nearest[i]])
    return np.array(chosen, dtype=np.int64)


def information_gains(pairs: PosePairs, left2_T_left1: Float, covariance: Float) -> Float:
    """Compute the decrease (N,) of the logarithm of the solution's uncertainty volume by each of N pose pairs.

    It is computed to first order, about an approximate solution (4, 4) with its covariance (6, 6).
    """
    _, jacobians = whitened(pairs, left2_T_left1)
    return np.asarray(np.einsum("nki,ij,nkj->n", jacobians, covariance, jacobians))


def most_informative(segments: Segments, gains: Float) -> Int:
    """Return indices, in order of time, of the non-overlapping segments with the largest sum of gains (N,)."""
    ending: dict[int, list[int]] = {}
    for row, j in enumerate(segments.last.tolist()):
        ending.setdefault(j, []).append(row)
    first = segments.first.tolist()
    count = int(segments.last.max(initial=0)) + 1
    best = np.zeros(count)  # largest sum of gains of segments that end by then
    by: list[int | None] = [None] * count
    for j in range(1, count):
        best[j] = best[j - 1]
        for row in ending.get(j, ()):
            total = best[first[row]] + gains[row]
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
    return np.array(chosen[::-1], dtype=np.int64)
