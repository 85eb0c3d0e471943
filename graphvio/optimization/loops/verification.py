"""Verification of a loop-closure candidate: matches, two-view geometry, resection, registration of patches."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphvio.arrays import AnyArray, Float, Int
from graphvio.config import Config
from graphvio.frontend.depth.stereo import triangulate
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.measurements.sensors import FrameSet
from graphvio.optimization.loops.database import FeatureDatabase, image_name
from graphvio.optimization.loops.features import PairFeatures
from graphvio.optimization.loops.matching import alike, estimated_geometry
from graphvio.optimization.loops.motion_depth import Features, Located, PlaceMotion, undetermined
from graphvio.optimization.loops.motion_depth import located as located_by_motion
from graphvio.optimization.loops.places import PairObserver
from graphvio.optimization.loops.resection import Resection, register_patches, resect_features
from graphvio.rig import CameraGroup, Rig, SingleCamera

_MIN_MATCHES = 20
_MAX_CROSSINGS = 2  # number of image pairs that are matched for each candidate


@dataclass(frozen=True, eq=False)
class StoredView:
    """A place whose features are in a database, which is read under a lock; j is an index in the rig's groups."""

    rig: Rig
    session: str
    stamp_ns: int
    database: FeatureDatabase
    lock: threading.Lock
    frameset_at: Callable[[int], FrameSet]

    def name(self, j: int) -> str:
        """Return the name in the database of the left image, or of a single camera's image."""
        return image_name(self.session, self.rig.groups[j].left.name, self.stamp_ns)

    def sees(self, j: int) -> bool:
        """Return whether the database has this image."""
        return self.name(j) in self.database.names

    def features(self, j: int) -> tuple[Float, AnyArray]:
        """Return pixels (K, 2) and descriptors (K, 128), uint8, of the left image, or of a single camera's image."""
        name = self.name(j)
        with self.lock:
            return self.database.pixels(name), self.database.descriptors(name)

    def frame(self, j: int) -> TrackedFrame:
        """Return the same features as a frame with their depth; those of a single camera have none."""
        group, left = self.rig.groups[j], self.name(j)
        if isinstance(group, SingleCamera):
            return undetermined(group.left, self.stamp_ns, self.features(j)[0])
        right = image_name(self.session, group.right.name, self.stamp_ns)
        with self.lock:
            pixels, in_right = self.database.pixels(left), self.database.pixels(right)
            rows = self.database.matches(left, right)
        return frame_of(group, self.stamp_ns, pixels, in_right, rows)

    def frameset(self) -> FrameSet:
        """Return those of the place's images that still exist."""
        return self.frameset_at(self.stamp_ns)


@dataclass(frozen=True, eq=False)
class FreshView:
    """A place whose images and features are in memory, with the methods of `StoredView`."""

    rig: Rig
    images: FrameSet
    seen: Mapping[int, PairFeatures]  # index in the rig's groups -> features

    def sees(self, j: int) -> bool:
        """See `StoredView`."""
        return j in self.seen

    def features(self, j: int) -> tuple[Float, AnyArray]:
        """See `StoredView`."""
        return self.seen[j].left, self.seen[j].descriptors

    def frame(self, j: int) -> TrackedFrame:
        """See `StoredView`."""
        seen = self.seen[j]
        return frame_of(self.rig.groups[j], self.images.stamp_ns, seen.left, seen.right, seen.rows)

    def frameset(self) -> FrameSet:
        """See `StoredView`."""
        return self.images


PlaceView = StoredView | FreshView
Neighbours = Callable[[], Sequence[tuple[PlaceView, PlaceMotion]]]
"""A function that returns the neighbours of a place, seen by the same rig, and the motions from the place to them."""


def crossings(pairs: Int, vectors: AnyArray, other_pairs: Int, other_vectors: AnyArray) -> list[tuple[int, int]]:
    """Return the pairs (a, b) whose images of two places are most similar, by their VLAD vectors (P, D) and (Q, D)."""
    similar = vectors @ other_vectors.T
    ranked = sorted((-float(similar[i, k]), i, k) for i in range(len(pairs)) for k in range(len(other_pairs)))[
        :_MAX_CROSSINGS
    ]
    return [(int(pairs[i]), int(other_pairs[k])) for _, i, k in ranked]


def verified(
    earlier: PlaceView, later: PlaceView, tried: Sequence[tuple[int, int]], observers: Sequence[PairObserver] | None,
    config: Config, seed: Sequence[int], neighbours: Neighbours,
    on_matched: Callable[[int, int, Int, Any], None] | None = None,
) -> Resection | None:  # fmt: skip
    """Estimate the motion between two places that may be the same; None if they have too little in common.

    Args:
        earlier: the place whose points are used.
        later: the place that may see them.
        tried: pairs of images to match, see `crossings`.
        observers: observers of the rig's pairs, to register patches; None if the rigs differ.
        config: the configuration of the search and the motion estimate.
        seed: the seed of RANSAC.
        neighbours: returns the neighbours of the earlier place, with which single cameras' features are triangulated.
        on_matched: called with a, b, their matches (M, 2), and the two-view geometry that verifies them.
    """
    matches = {}
    for a, b in tried:
        rows, geometry = _matched(earlier, later, a, b)
        if len(rows) < _MIN_MATCHES:
            break  # the remaining ones are less similar
        inliers = np.asarray(geometry.inlier_matches, dtype=np.int64).reshape(-1, 2)
        if len(inliers) < _MIN_MATCHES:
            break
        if on_matched is not None:
            on_matched(a, b, rows, geometry)
        matches[a, b] = inliers
    if not matches:
        return None
    located = {a: _with_depth(earlier, a, neighbours) for a, _ in matches}
    reference = {a: each.frame for a, each in located.items()}
    shifts = {a: each.shifts for a, each in located.items() if len(each.shifts)}
    current = {b: later.frame(b) for _, b in matches}
    found = resect_features(later.rig, reference, current, matches, config, seed, shifts)
    if found is None or found.inliers < config.optimization.loop_min_inliers:
        return None
    if observers is not None:
        framesets = (earlier.frameset(), later.frameset())
        found = register_patches(observers, found, reference, framesets, config, seed)
    return found


def _matched(earlier: PlaceView, later: PlaceView, a: int, b: int) -> tuple[Int, Any]:
    """Return matches (M, 2) by descriptors, and COLMAP's two-view geometry, or None if there are too few matches."""
    (first, first_descriptors), (second, second_descriptors) = earlier.features(a), later.features(b)
    rows = alike(first_descriptors, second_descriptors)
    if len(rows) < _MIN_MATCHES:
        return rows, None
    cameras = (earlier.rig.groups[a].left, later.rig.groups[b].left)
    return rows, estimated_geometry(cameras, (first, second), rows)


def _with_depth(view: PlaceView, j: int, neighbours: Neighbours) -> Located:
    """Return a place's features with their depth, which is triangulated by motion for a single camera."""
    frame, group = view.frame(j), view.rig.groups[j]
    if not isinstance(group, SingleCamera):
        return Located(frame, np.zeros((0, len(frame.ids))))
    others = [(Features(*other.features(j)) if other.sees(j) else None, motion) for other, motion in neighbours()]
    return located_by_motion(group.left, frame.stamp_ns, Features(*view.features(j)), others)


def frame_of(group: CameraGroup, stamp_ns: int, pixels: Float, in_right: Float, rows: Int) -> TrackedFrame:
    """Return a frame of features (K, 2) of a left image, with depth where rows (M, 2) match the right one's."""
    if isinstance(group, SingleCamera):
        return undetermined(group.left, stamp_ns, pixels)
    n = len(pixels)
    left, has_ray = group.left.unproject(pixels)
    right, right_pixels = np.zeros((n, 2)), np.zeros((n, 2))
    right_pixels[rows[:, 0]] = in_right[rows[:, 1]]
    right[rows[:, 0]], seen = group.right.unproject(in_right[rows[:, 1]])
    has_depth = np.zeros(n, dtype=bool)
    has_depth[rows[:, 0]] = seen
    points, covariances, _ = triangulate(left, right, group.right_T_left, group.left.focal_px, group.right.focal_px)
    none = np.zeros(n, dtype=np.int64)
    return TrackedFrame(
        stamp_ns, np.arange(n), none, pixels, left, right, right_pixels, points, covariances, np.zeros((n, 2)),
        has_depth & has_ray, none,
    )  # fmt: skip
