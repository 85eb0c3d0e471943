"""Keyframes of a window for bundle adjustment, and the choice of tracks from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.cameras import unproject_pixels
from graphvio.self_calibration.bundle import Tracks
from graphvio.self_calibration.parameters import RigCalibration

_MAX_ERROR2 = 25.0  # squared whitened error of a view of a landmark that stands still
_MAX_OFF = 0.3  # share of a landmark's views that may be farther off
_RAY_SIGMA = 1e-3  # noise of normalised coordinates
_MAX_INVERSE_DEPTH_SIGMA = 0.1  # 1/m, of a single camera's landmarks to begin with
_MIN_DEPTH_RATIO = 0.1  # of a point's depths in two views, below which one camera has turned away from it


class View(NamedTuple):
    """What one pair or single camera saw at one instant: N tracks.

    Attributes:
        ids: (N,) identities, increasing.
        left_px: (N, 2) pixels in the left image.
        right_px: (N, 2) pixels in the right image; meaningful where ``has_right``.
        has_right: (N,) whether a match was found there; never by a single camera.
        inverse_depths: (N,) inverse depths in the left camera's frame, 1/m; meaningful where ``has_right``.
    """

    ids: Int
    left_px: Float
    right_px: Float
    has_right: Bool
    inverse_depths: Float


class Keyframe(NamedTuple):
    """One instant of the window.

    Attributes:
        stamp_ns: stamp of the frameset.
        odom_T_body: (4, 4) pose as it was estimated then.
        views: index of the pair or single camera -> what it saw.
    """

    stamp_ns: int
    odom_T_body: Float
    views: Mapping[int, View]


def choose_tracks(
    keyframes: Sequence[Keyframe], poses: Float, calibration: RigCalibration, max_tracks: int, sigma_px: float
) -> tuple[Tracks, Float]:
    """Choose the longest tracks of known depth of each pair and single camera, and find where their landmarks are.

    Args:
        keyframes: K keyframes, in time order.
        poses: (K, 4, 4) ``odom_T_body``.
        calibration: calibration of the pairs and single cameras. Depths of a pair's tracks come from its stereo
            matches; those of a single camera's come from the poses.
        max_tracks: largest number of tracks of each pair or camera.
        sigma_px: noise of a corner's position.

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
        has_depth = columns[3][order]
        if calibration.is_single[j]:
            rays = _rays(calibration, j, columns[1][order])
            columns[4][order], has_depth = inverse_depths_of_tracks(
                ids[order], rays, poses[columns[0][order]] @ calibration.body_T_left[j]
            )
        rows = _longest(ids[order], has_depth, max_tracks)
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
    matched = np.flatnonzero(has_right | calibration.is_single[pair_of_rows])
    first = matched[np.searchsorted(matched, firsts)]
    landmarks = np.empty((len(firsts), 3))
    for j in np.unique(pair):
        of_pair = pair == j
        landmarks[of_pair, :2] = _rays(calibration, j, left_px[first[of_pair]])
    landmarks[:, 2] = np.maximum(inverse_depths[first], 0.0)
    odom_T_landmark = poses[keyframe[first]] @ calibration.body_T_left[pair]
    noise = np.full(len(keyframe), sigma_px)
    return Tracks(pair, odom_T_landmark, bounds, keyframe, left_px, right_px, has_right, noise), landmarks


def inverse_depths_of_tracks(ids: Int, rays: Float, odom_T_cam: Float) -> tuple[Float, Bool]:
    """Triangulate a camera's tracks from where it was, by linear least squares.

    Args:
        ids: (N,) identities of the observations' tracks, sorted, those of a track in time order.
        rays: (N, 2) normalised coordinates.
        odom_T_cam: (N, 4, 4) pose of the camera at each observation.

    Returns:
        Inverse depths (N,) in the camera that saw the track first, 1/m, the same for all its observations, and whether
        each is known (N,).
    """
    if not len(ids):
        return np.zeros(0), np.zeros(0, dtype=bool)
    firsts = np.r_[0, np.flatnonzero(np.diff(ids)) + 1]
    lengths = np.diff(firsts, append=len(ids))
    first = np.repeat(firsts, lengths)
    rotation = np.swapaxes(odom_T_cam[:, :3, :3], 1, 2)
    homogeneous = np.column_stack([rays, np.ones(len(rays))])
    ahead = np.einsum("nij,njk,nk->ni", rotation, odom_T_cam[first, :3, :3], homogeneous[first])
    shift = np.einsum("nij,nj->ni", rotation, odom_T_cam[first, :3, 3] - odom_T_cam[:, :3, 3])
    # The point is at (ahead + w shift), up to scale, in the camera that saw it at (x, y): what is across that ray is 0.
    depth = np.maximum(ahead[:, 2], _MIN_DEPTH_RATIO)[:, None]
    by_depth = (shift[:, :2] - rays * shift[:, 2:]) / depth
    off = (ahead[:, :2] - rays * ahead[:, 2:]) / depth
    information = np.add.reduceat((by_depth**2).sum(axis=1), firsts)
    along = np.add.reduceat((by_depth * off).sum(axis=1), firsts)
    is_known = information > (_RAY_SIGMA / _MAX_INVERSE_DEPTH_SIGMA) ** 2
    inverse_depths = np.where(is_known, -along / np.where(is_known, information, 1.0), 0.0)
    return np.repeat(inverse_depths, lengths), np.repeat(is_known & (inverse_depths >= 0.0), lengths)


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


def _rays(calibration: RigCalibration, j: int, left_px: Float) -> Float:
    """Return normalised coordinates (N, 2) of pixels in the left image of a pair, or in a single camera's."""
    rays, _ = unproject_pixels(
        int(calibration.models[j, 0]), calibration.intrinsics[j, 0], calibration.distortion[j, 0],
        np.ascontiguousarray(left_px),
    )  # fmt: skip
    return np.asarray(rays)


def _longest(ids: Int, has_depth: Bool, max_tracks: int) -> Int:
    """Select the rows of the tracks seen most often, with depth at least once, of rows (N,) sorted by identity."""
    if not len(ids):
        return np.empty(0, dtype=np.int64)
    firsts = np.concatenate([[0], np.flatnonzero(np.diff(ids)) + 1])
    lengths = np.diff(firsts, append=len(ids))
    matched = np.flatnonzero(np.logical_or.reduceat(has_depth, firsts))
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
    np.zeros(0),
)
