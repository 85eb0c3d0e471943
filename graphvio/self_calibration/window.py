"""The window of keyframes that a bundle adjustment takes, and the tracks that it chooses from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.cameras import unproject_pixels
from graphvio.self_calibration.bundle import Tracks
from graphvio.self_calibration.parameters import RigCalibration

_MAX_ERROR2 = 25.0  # squared whitened error of a view of what stands still
_MAX_OFF = 0.3  # share of a landmark's views that may be farther off


class View(NamedTuple):
    """What one pair saw at one instant: N tracks.

    Attributes:
        ids: (N,) identities, increasing.
        left_px: (N, 2) in the left image.
        right_px: (N, 2) in the right image; meaningful where ``has_right``.
        has_right: (N,) whether a match was found there.
        inverse_depths: (N,) in the left camera's frame, 1/m; meaningful where ``has_right``.
    """

    ids: Int
    left_px: Float
    right_px: Float
    has_right: Bool
    inverse_depths: Float


class Keyframe(NamedTuple):
    """One instant of the window.

    Attributes:
        stamp_ns: of the frameset.
        odom_T_body: (4, 4) as it was estimated then.
        views: pair index -> what it saw.
    """

    stamp_ns: int
    odom_T_body: Float
    views: Mapping[int, View]


def choose_tracks(
    keyframes: Sequence[Keyframe], poses: Float, calibration: RigCalibration, max_tracks: int
) -> tuple[Tracks, Float]:
    """Choose tracks that were matched left to right, the longest of each pair, and where their landmarks are.

    Args:
        keyframes: K of them, in time order.
        poses: (K, 4, 4) ``odom_T_body``.
        calibration: of P pairs.
        max_tracks: of each pair.

    Returns:
        The tracks, and the landmarks (L, 3) in their frames.
    """
    parts: list[tuple[Any, ...]] = []
    for j in range(len(calibration.models)):
        seen = [(k, keyframe.views[j]) for k, keyframe in enumerate(keyframes) if j in keyframe.views]
        if not seen:
            continue
        ids = np.concatenate([view.ids for _, view in seen])
        columns = [
            np.concatenate([np.full(len(view.ids), k) for k, view in seen]),
            *(np.concatenate([view[field] for _, view in seen]) for field in range(1, 5)),
        ]
        order = np.lexsort((columns[0], ids))
        rows = _longest(ids[order], columns[3][order], max_tracks)
        chosen: Int = order[rows]
        if len(chosen):
            parts.append((j, ids[chosen], *(column[chosen] for column in columns)))
    if not parts:
        return _NOTHING, np.zeros((0, 3))
    pair_of_rows = np.concatenate([np.full(len(part[1]), part[0]) for part in parts])
    ids, keyframe, left_px, right_px, has_right, inverse_depths = (
        np.concatenate([part[field] for part in parts]) for field in range(1, 7)
    )
    firsts = np.flatnonzero(np.r_[True, (np.diff(ids) != 0) | (np.diff(pair_of_rows) != 0)])
    bounds = np.r_[firsts, len(ids)]
    pair = pair_of_rows[firsts]
    matched = np.flatnonzero(has_right)
    first = matched[np.searchsorted(matched, firsts)]
    landmarks = np.empty((len(firsts), 3))
    for j in np.unique(pair):
        of_pair = pair == j
        landmarks[of_pair, :2], _ = unproject_pixels(
            int(calibration.models[j, 0]), calibration.intrinsics[j, 0], calibration.distortion[j, 0],
            np.ascontiguousarray(left_px[first[of_pair]]),
        )  # fmt: skip
    landmarks[:, 2] = np.maximum(inverse_depths[first], 0.0)
    odom_T_landmark = poses[keyframe[first]] @ calibration.body_T_left[pair]
    return Tracks(pair, odom_T_landmark, bounds, keyframe, left_px, right_px, has_right), landmarks


def stationary(tracks: Tracks, errors2: Float) -> Bool:
    """Find the landmarks (L,) that stand still, from squared whitened errors (N, 2): few of their views are far off."""
    if not len(tracks.pair):
        return np.ones(0, dtype=bool)
    is_off = np.nanmax(errors2, axis=1) > _MAX_ERROR2
    n_off = np.add.reduceat(is_off, tracks.rows[:-1], dtype=np.int64)
    return np.asarray(n_off <= _MAX_OFF * np.diff(tracks.rows))


def median_displacement_px(then: View, now: View) -> float:
    """Return the median displacement of the tracks common to two views; infinite where there are none."""
    _, at_then, at_now = np.intersect1d(then.ids, now.ids, assume_unique=True, return_indices=True)
    if not len(at_then):
        return float("inf")
    return float(np.median(np.linalg.norm(now.left_px[at_now] - then.left_px[at_then], axis=1)))


def _longest(ids: Int, has_right: Bool, max_tracks: int) -> Int:
    """Select the rows of the tracks seen most often, and matched at least once, of rows (N,) sorted by identity."""
    if not len(ids):
        return np.empty(0, dtype=np.int64)
    firsts = np.concatenate([[0], np.flatnonzero(np.diff(ids)) + 1])
    lengths = np.diff(firsts, append=len(ids))
    matched = np.flatnonzero(np.logical_or.reduceat(has_right, firsts))
    longest = np.sort(matched[np.argsort(-lengths[matched], kind="stable")[:max_tracks]])
    is_of_one = np.zeros(len(firsts), dtype=bool)
    is_of_one[longest] = True
    return np.flatnonzero(np.repeat(is_of_one, lengths))


_NOTHING = Tracks(
    np.zeros(0, dtype=np.int64),
    np.zeros((0, 4, 4)),
    np.zeros(1, dtype=np.int64),
    np.zeros(0, dtype=np.int64),
    np.zeros((0, 2)),
    np.zeros((0, 2)),
    np.zeros(0, dtype=bool),
)
