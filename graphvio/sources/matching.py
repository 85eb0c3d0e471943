"""Matching of images by their stamps: left and right images to pairs, and pairs to framesets.

Images of different instants are never joined: pairs that are triggered at other times or rates make framesets of their
own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphvio.arrays import Int

TOLERANCE_NS = 2_000_000
"""Pairs whose stamps differ by no more than this are of one instant, unless `open_source` is given another value."""

_PERIOD_SHARE = 3  # left and right may be a third of a period apart: a neighbour is then always farther away

Rows = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class PairIndex:
    """Left and right images of one pair that belong together."""

    stamps_ns: Int  # (N,) stamps of the left images, increasing
    rows: Rows  # (N, 2) rows of the left and the right image in their cameras' indexes
    left_alone: Int  # (L,) stamps of left images without a right one
    right_alone: Int  # (R,) stamps of right images without a left one
    # (A,) stamps of left images that have several right images within the tolerance, or whose right image has several
    # left ones
    ambiguous: Int
    tolerance_ns: int  # tolerance within which left and right were matched


@dataclass(frozen=True, eq=False)
class FramesetIndex:
    """Framesets of a recording."""

    stamps_ns: Int  # (F,) stamps, increasing, camera clock
    rows: Rows  # (F, P, 2) rows of the left and right image of each pair, -1 where the pair has none


def tolerance_of(left_ns: Int) -> int:
    """Return the tolerance between left and right images that suits the rate of the left stamps (N,), nanoseconds.

    If stamps are those of arrival, they differ by some milliseconds although both images were triggered together.
    """
    return int(np.median(np.diff(left_ns))) // _PERIOD_SHARE if len(left_ns) > 1 else TOLERANCE_NS


def match_sides(left_ns: Int, right_ns: Int, tolerance_ns: int | None = None) -> PairIndex:
    """Match left and right images of a pair by their stamps (N,) and (M,), which increase.

    With a tolerance of None, that of `tolerance_of` is used.
    """
    if tolerance_ns is None:
        tolerance_ns = tolerance_of(left_ns)
    nothing = np.zeros(0, dtype=np.int64)
    if np.array_equal(left_ns, right_ns):
        rows = np.repeat(np.arange(len(left_ns), dtype=np.int32)[:, None], 2, axis=1)
        return PairIndex(left_ns, rows, nothing, nothing, nothing, tolerance_ns)
    matched: list[tuple[int, int]] = []
    i = j = 0
    lefts, rights = left_ns.tolist(), right_ns.tolist()
    while i < len(lefts) and j < len(rights):
        ahead = rights[j] - lefts[i]
        if abs(ahead) <= tolerance_ns:
            if j + 1 < len(rights) and abs(rights[j + 1] - lefts[i]) < abs(ahead):
                j += 1
            elif i + 1 < len(lefts) and abs(rights[j] - lefts[i + 1]) < abs(ahead):
                i += 1
            else:
                matched.append((i, j))
                i += 1
                j += 1
        elif ahead > 0:
            i += 1
        else:
            j += 1
    rows = np.array(matched, dtype=np.int32).reshape(-1, 2)
    stamps, partners = left_ns[rows[:, 0]], right_ns[rows[:, 1]]
    several = (_near(right_ns, stamps, tolerance_ns) > 1) | (_near(left_ns, partners, tolerance_ns) > 1)
    left_alone, right_alone = np.delete(left_ns, rows[:, 0]), np.delete(right_ns, rows[:, 1])
    return PairIndex(stamps, rows, left_alone, right_alone, stamps[several], tolerance_ns)


def _near(stamps_ns: Int, at_ns: Int, tolerance_ns: int) -> Int:
    """Return how many of the increasing ``stamps_ns`` (N,) are within the tolerance of each of ``at_ns`` (M,)."""
    first = np.searchsorted(stamps_ns, at_ns - tolerance_ns, side="left")
    return np.searchsorted(stamps_ns, at_ns + tolerance_ns, side="right") - first


def of_single(stamps_ns: Int) -> PairIndex:
    """Index the images (N,) of a camera without a partner, as if each were also its own right image."""
    return match_sides(stamps_ns, stamps_ns)


def group_pairs(pairs: Sequence[PairIndex], tolerance_ns: int = TOLERANCE_NS) -> FramesetIndex:
    """Join the images of at least one pair into framesets, each of the same instant.

    A frameset has the stamp of the first of its pairs; or of the earliest pair, if the next frameset would otherwise be
    within the tolerance of it.
    """
    count = len(pairs)
    first = pairs[0].stamps_ns
    if all(np.array_equal(pair.stamps_ns, first) for pair in pairs[1:]):
        return FramesetIndex(first, np.stack([pair.rows for pair in pairs], axis=1))
    entries = sorted(
        (stamp, number, row) for number, pair in enumerate(pairs) for row, stamp in enumerate(pair.stamps_ns.tolist())
    )
    groups: list[dict[int, tuple[int, int]]] = []  # pair -> (stamp, row)
    begin_ns = 0
    for stamp, number, row in entries:
        if not groups or stamp - begin_ns > tolerance_ns or number in groups[-1]:
            groups.append({})
            begin_ns = stamp
        groups[-1][number] = (stamp, row)
    earliest = np.array([min(group.values())[0] for group in groups], dtype=np.int64)
    stamps = np.array([group[min(group)][0] for group in groups], dtype=np.int64)
    crowded = np.flatnonzero(earliest[1:] - stamps[:-1] <= tolerance_ns)
    stamps[crowded] = earliest[crowded]
    rows = np.full((len(groups), count, 2), -1, dtype=np.int32)
    for at, group in enumerate(groups):
        for number, (_, row) in group.items():
            rows[at, number] = pairs[number].rows[row]
    return FramesetIndex(stamps, rows)
