"""Observations of one stereo pair or single camera at one instant: its tracks, as arrays with one row per track."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.frontend.depth.stereo import triangulate
from graphvio.kernels import kernel
from graphvio.rig import CameraGroup, SingleCamera

_NEAR_SIGMAS = 10.0  # inverse depth over its standard deviation, of a depth known to a tenth


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """Observations of one pair, or of one single camera, at one instant: N tracks.

    Attributes:
        stamp_ns: stamp of the frameset.
        ids: (N,) identities of the tracks, increasing.
        ages: (N,) number of frames before this one in which the track was seen.
        pixels: (N, 2) in the left image.
        left_rays: (N, 2) normalised coordinates in the left image.
        right_rays: (N, 2) the same in the right image; meaningful where ``has_depth``.
        right_pixels: (N, 2) in the right image; meaningful where ``has_depth``.
        points: (N, 3) ``[x, y, 1/Z]`` in the left camera's frame, see `graphvio.frontend.depth.stereo`.
        covariances: (N, 3, 3) of ``points``, for a pixel noise of 1 px.
        slopes: (N, 2) derivative of the disparity with respect to the left pixel (u, v) over the patch, caused by the
            slant of the surface, see `graphvio.frontend.depth.slanted`; meaningful where ``has_depth``.
        has_depth: (N,) whether the stereo match passed all its tests.
        frames_without_depth: (N,) number of frames since the last valid stereo match, 0 where this one has it.
        is_single: whether the camera has no partner: every track has a depth, though it may be next to unknown.
        rejected: test of tracking or stereo matching -> number of tracks that failed it.
        stage_ms: processing time by stage, milliseconds.
        shutter_px: (N, 2, 2) offsets from the pixels in the left and in the right image to where a global shutter would
            have seen the points at the stamp; normalised coordinates and points are those at the offset pixels. Zero if
            not given.
        shutter_slopes: (N, 2) derivatives of a single camera's ``left_rays`` with respect to the inverse depth, by
            the compensation of its rolling shutter. Zero if not given.
    """

    stamp_ns: int
    ids: Int
    ages: Int
    pixels: Float
    left_rays: Float
    right_rays: Float
    right_pixels: Float
    points: Float
    covariances: Float
    slopes: Float
    has_depth: Bool
    frames_without_depth: Int
    is_single: bool = False
    rejected: Mapping[str, int] = field(default_factory=dict)
    stage_ms: Mapping[str, float] = field(default_factory=dict)
    shutter_px: Float = field(default_factory=lambda: np.zeros((0, 2, 2)))
    shutter_slopes: Float = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        if len(self.shutter_px) != len(self.ids):
            object.__setattr__(self, "shutter_px", np.zeros((len(self.ids), 2, 2)))
        if len(self.shutter_slopes) != len(self.ids):
            object.__setattr__(self, "shutter_slopes", np.zeros((len(self.ids), 2)))

    @property
    def pixels_at_stamp(self) -> Float:
        """(N, 2) in the left image, where a global shutter would have seen the points at the stamp."""
        return self.pixels + self.shutter_px[:, 0]

    @property
    def right_pixels_at_stamp(self) -> Float:
        """(N, 2) the same in the right image."""
        return self.right_pixels + self.shutter_px[:, 1]

    @property
    def has_right(self) -> Bool:
        """(N,) whether a track is seen in a right image."""
        return np.zeros(len(self.ids), dtype=bool) if self.is_single else self.has_depth

    def constrains_translation(self, sigma_px: float) -> Bool:
        """Select the tracks (N,) that are near enough to constrain translation, for a pixel noise in pixels."""
        sigma_w = sigma_px * np.sqrt(self.covariances[:, 2, 2])
        return np.asarray(self.has_depth & (self.points[:, 2] > _NEAR_SIGMAS * sigma_w))

    def keep(self, rows: Bool) -> TrackedFrame:
        """Return the frame with only some of its tracks (N,)."""
        if rows.all():
            return self
        kept = np.flatnonzero(rows)
        columns: dict[str, Any] = {name: np.take(getattr(self, name), kept, axis=0) for name in _COLUMNS}
        return replace(self, **columns)

    def extended(self, other: TrackedFrame) -> TrackedFrame:
        """Append the tracks of another frame of this instant, whose ids are greater; counts and times add up."""
        both = self, other
        columns: dict[str, Any] = {name: np.concatenate([getattr(each, name) for each in both]) for name in _COLUMNS}
        return replace(
            self,
            **columns,
            rejected=_added(self.rejected, other.rejected),
            stage_ms=_added(self.stage_ms, other.stage_ms),
        )

    def recalibrated(self, group: CameraGroup) -> TrackedFrame:
        """Return the frame for another calibration of its cameras: the same pixels, triangulated again."""
        rays, has_ray = group.left.unproject(self.pixels_at_stamp)
        if isinstance(group, SingleCamera):
            points = np.column_stack([rays, self.points[:, 2]])
            return replace(self, left_rays=rays, points=points, has_depth=self.has_depth & has_ray)
        right, in_right = group.right.unproject(self.right_pixels_at_stamp)
        points, covariances, _ = triangulate(rays, right, group.right_T_left, group.left.focal_px, group.right.focal_px)
        has_depth = self.has_depth & has_ray & in_right
        return replace(
            self, left_rays=rays, right_rays=right, points=points, covariances=covariances, has_depth=has_depth
        )

    @staticmethod
    def empty(stamp_ns: int = 0) -> TrackedFrame:
        """Return a frame without tracks."""
        none, whole = np.zeros(0), np.zeros(0, dtype=np.int64)
        return TrackedFrame(
            stamp_ns,
            ids=whole,
            ages=whole,
            pixels=np.zeros((0, 2)),
            left_rays=np.zeros((0, 2)),
            right_rays=np.zeros((0, 2)),
            right_pixels=np.zeros((0, 2)),
            points=np.zeros((0, 3)),
            covariances=np.zeros((0, 3, 3)),
            slopes=np.zeros((0, 2)),
            has_depth=none.astype(bool),
            frames_without_depth=whole,
        )


_COLUMNS = tuple(
    f.name for f in fields(TrackedFrame) if f.name not in ("stamp_ns", "is_single", "rejected", "stage_ms")
)


def _added(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    return {name: one.get(name, 0) + other.get(name, 0) for name in (*one, *(other.keys() - one.keys()))}


@kernel
def common_rows(first: Int, second: Int) -> tuple[Int, Int]:
    """Find the K identities common to two increasing arrays (N,) and (M,); return their rows (K,) in each."""
    at_first = np.empty(min(len(first), len(second)), dtype=np.int64)
    at_second = np.empty_like(at_first)
    i = j = k = 0
    while i < len(first) and j < len(second):
        if first[i] == second[j]:
            at_first[k], at_second[k] = i, j
            i, j, k = i + 1, j + 1, k + 1
        elif first[i] < second[j]:
            i += 1
        else:
            j += 1
    return at_first[:k], at_second[:k]


@kernel
def usable_at(pixels: Float, allowed: Bool, border_px: float) -> tuple[Bool, Bool]:
    """Check which pixels (N, 2) are inside the image with a border (N,), and which of these may be used (N,).

    Args:
        pixels: (N, 2); NaN counts as outside.
        allowed: (height, width) where the image may be used.
        border_px: smallest distance from the image's edge.
    """
    height, width = allowed.shape
    inside, usable = np.zeros(len(pixels), dtype=np.bool_), np.zeros(len(pixels), dtype=np.bool_)
    for i in range(len(pixels)):
        x, y = pixels[i, 0], pixels[i, 1]
        inside[i] = border_px <= x <= width - 1 - border_px and border_px <= y <= height - 1 - border_px
        if inside[i]:
            usable[i] = allowed[int(np.rint(y)), int(np.rint(x))]
    return inside, usable


def passes(candidates: Bool, test: Bool, name: str, rejected: dict[str, int]) -> Bool:
    """Select the candidates (N,) that pass a test (N,), and count the others under the test's name."""
    passed = candidates & test
    rejected[name] = int(np.count_nonzero(candidates) - np.count_nonzero(passed))
    return np.asarray(passed)
