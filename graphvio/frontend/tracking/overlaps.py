"""Matching of single cameras' tracks in other cameras with overlapping views, which gives their depth in metres."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.config import Config
from graphvio.frontend.depth.matching import StereoMatcher, TwoCameras
from graphvio.frontend.depth.prediction import predict_pixels
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.depth.warped_matching import WarpedMatcher
from graphvio.frontend.tracking.handover import FoundThere, Leaving
from graphvio.frontend.tracking.tracker import GroupTracker, TrackedImage
from graphvio.measurements.motion import CrossCameraMatches
from graphvio.rig import MAX_AXES_ANGLE_DEG, MIN_BASELINE_M, Camera, Rig, axes_angle_deg, overlap

MIN_OVERLAP = 0.1
"""Smallest share of a camera's image that another camera has to see, too, for its tracks to be searched for there."""


_MAX_HANDOVER_OVERLAP = 0.4  # with any other camera, up to which a camera's tracks are handed over
_MAX_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class _TwoCameras:
    """Two cameras with overlapping views: side by side like a stereo pair, or pointing in different directions."""

    left: Camera
    right: Camera

    @cached_property
    def right_T_left(self) -> Float:
        return np.ascontiguousarray(self.right.cam_T_body @ self.left.body_T_cam)


@dataclass(eq=False)
class _Partner:
    """A camera in which tracks of another one are matched, and the last matches."""

    camera: int
    cameras: TwoCameras  # of which the left one has the tracks
    matcher: StereoMatcher
    found: TrackedFrame = field(default_factory=TrackedFrame.empty)


class Overlaps:
    """Finds the tracks of each single camera in the other cameras that see the same part of the scene.

    A track that was matched before is searched for near the place that its depth and the predicted motion give; others
    are searched for along their epipolar lines. Patches are warped where the cameras point in different directions.
    Rolling shutters are left out: their lines are exposed at different instants.

    Args:
        rig: the rig, of single cameras.
        config: configuration of all stages.
    """

    def __init__(self, rig: Rig, config: Config) -> None:
        self._sigma_px = config.motion.pixel_sigma_px
        self._of_file = cameras = [single.left for single in rig.singles]
        self._partners = [
            [_partner(own, k, other, config) for k, other in enumerate(cameras) if _is_shared(own, other)]
            for own in cameras
        ]
        shared = [max((overlap(own, other) for other in cameras if other is not own), default=0.0) for own in cameras]
        self._hands_over = [each < _MAX_HANDOVER_OVERLAP for each in shared]

    def recalibrate(self, rig: Rig, epipolar_margin_px: float) -> None:
        """Use another calibration of the same cameras from now on, whose epipolar lines may be off by a margin."""
        cameras = [single.left for single in rig.singles]
        for own, partners in zip(cameras, self._partners, strict=True):
            for partner in partners:
                partner.cameras = _TwoCameras(own, cameras[partner.camera])
                partner.matcher.recalibrate(partner.cameras, epipolar_margin_px)

    def find(
        self,
        camera: int,
        views: Mapping[int, TrackedImage],
        cam_T_before: Callable[[int], Float | None],
        searches: bool,
        wanted: Bool | None = None,
    ) -> None:
        """Find the tracks of one camera in the others; matches that were found earlier for this instant are kept.

        Args:
            camera: index of the camera.
            views: images and tracks of all cameras that have an image at this instant.
            cam_T_before: returns the predicted motion (4, 4) of points in the camera since a stamp, None where unknown.
            searches: whether tracks without an earlier match are searched for.
            wanted: (N,) which tracks to find, None for all.
        """
        own = views[camera]
        for partner in self._partners[camera]:
            if partner.camera in views:
                self._find(partner, own, views[partner.camera], cam_T_before, searches, wanted)

    def matches_of(self, camera: int, frame: TrackedFrame) -> tuple[CrossCameraMatches, ...]:
        """Return the matches of a camera's newest frame in other cameras, as rays by the lenses of the rig file."""
        found = []
        for partner in self._partners[camera]:
            if partner.found.stamp_ns == frame.stamp_ns:
                there = partner.found
                rows = np.searchsorted(frame.ids, there.ids)
                rays, _ = self._of_file[partner.camera].unproject(there.right_pixels)
                found.append(CrossCameraMatches(partner.camera, rows, rays))
        return tuple(found)

    def found_in(self, camera: int, stamp_ns: int, leaving: Mapping[int, Leaving]) -> list[FoundThere]:
        """Return where a camera's image shows tracks that are about to leave other cameras' views.

        Matches are left out if their depth contradicts the depth by the motion of the track's own camera. So are tracks
        of cameras that share much of their view with another one, which has own tracks there: the error of the match
        would then outweigh the gain by a longer track.

        Args:
            camera: index of the camera.
            stamp_ns: stamp of its image.
            leaving: camera index -> its leaving tracks.
        """
        found = []
        for own, partners in enumerate(self._partners):
            for partner in partners:
                there, other = partner.found, partner.cameras.right
                if partner.camera != camera or not self._hands_over[own] or own not in leaving:
                    continue
                if there.stamp_ns != stamp_ns or not len(there.ids):
                    continue
                _, inverse_depths, in_front = predict_pixels(
                    there.left_rays, np.maximum(there.points[:, 2], 0.0), partner.cameras.right_T_left,
                    other.model_number, other.intrinsics, other.distortion,
                )  # fmt: skip
                kept = in_front & _agrees(there, leaving[own], self._sigma_px)
                found.append(FoundThere(own, there.ids[kept], there.right_pixels[kept], inverse_depths[kept]))
        return found

    def slant(self, camera: int, tracker: GroupTracker) -> None:
        """Set depths, and slants where known, of a tracker's keyframe patches by the last matches in other cameras."""
        for is_slope_known in (False, True):
            for partner in self._partners[camera]:
                if isinstance(partner.matcher, WarpedMatcher) is not is_slope_known:
                    tracker.slant_keyframe_patches(partner.found, partner.cameras, is_slope_known)

    def _find(
        self,
        partner: _Partner,
        own: TrackedImage,
        other: TrackedImage,
        cam_T_before: Callable[[int], Float | None],
        searches: bool,
        wanted: Bool | None,
    ) -> None:
        frame, before = own.frame, partner.found
        inverse_depths, slopes = _expected(partner, frame, cam_T_before(before.stamp_ns) if len(before.ids) else None)
        chosen = np.ones(len(frame.ids), dtype=bool) if searches else np.isfinite(inverse_depths)
        if wanted is not None:
            chosen &= wanted
        rows = np.flatnonzero(chosen)
        partner.matcher.allow(other.allowed)
        matches = partner.matcher.match(
            own.pyramid, other.pyramid, frame.pixels[rows], frame.left_rays[rows], inverse_depths[rows], slopes[rows],
            own.min_gradient,
        )  # fmt: skip
        good = matches.good
        rows = rows[good]
        chosen[:] = False
        chosen[rows] = True
        found = frame.keep(chosen)
        new = TrackedFrame(
            found.stamp_ns, found.ids, found.ages, found.pixels, found.left_rays, matches.right[good],
            matches.right_pixels[good], matches.points[good], matches.covariances[good], matches.slopes[good],
            np.ones(len(rows), dtype=bool), found.frames_without_depth,
        )  # fmt: skip
        partner.found = before.extended(new) if before.stamp_ns == frame.stamp_ns and len(before.ids) else new


def _is_shared(own: Camera, other: Camera) -> bool:
    """Return whether tracks of a camera can be found in another one."""
    if own is other or own.line_time_us or other.line_time_us or overlap(own, other) < MIN_OVERLAP:
        return False
    return bool(np.linalg.norm((other.cam_T_body @ own.body_T_cam)[:3, 3]) >= MIN_BASELINE_M)


def _partner(own: Camera, number: int, other: Camera, config: Config) -> _Partner:
    cameras, (width, height) = _TwoCameras(own, other), other.size_px
    if axes_angle_deg(own, other) > MAX_AXES_ANGLE_DEG:
        return _Partner(number, cameras, WarpedMatcher(cameras, config))
    return _Partner(number, cameras, StereoMatcher(cameras, config, np.ones((height, width), dtype=bool)))


def _agrees(there: TrackedFrame, leaving: Leaving, sigma_px: float) -> Bool:
    """Select the matches (N,) of leaving tracks whose depth agrees, to 3 sigma, with that by their camera's motion."""
    if not len(leaving.ids):
        return np.zeros(len(there.ids), dtype=bool)
    rows = np.minimum(np.searchsorted(leaving.ids, there.ids), len(leaving.ids) - 1)
    sigmas = np.hypot(leaving.sigmas[rows], sigma_px * np.sqrt(there.covariances[:, 2, 2]))
    off = np.abs(there.points[:, 2] - leaving.inverse_depths[rows])
    return np.asarray((leaving.ids[rows] == there.ids) & (off < _MAX_SIGMAS * sigmas))


def _expected(partner: _Partner, frame: TrackedFrame, motion: Float | None) -> tuple[Float, Float]:
    """Return the tracks' inverse depths (N,), NaN where unknown, and slopes (N, 2), predicted from the last matches."""
    inverse_depths, slopes, before = np.full(len(frame.ids), np.nan), np.zeros((len(frame.ids), 2)), partner.found
    if not len(before.ids):
        return inverse_depths, slopes
    moved, in_front = np.maximum(before.points[:, 2], 0.0), np.ones(len(before.ids), dtype=bool)
    if motion is not None:
        camera = partner.cameras.left
        _, moved, in_front = predict_pixels(
            before.left_rays, moved, motion, camera.model_number, camera.intrinsics, camera.distortion
        )
    rows = np.minimum(np.searchsorted(before.ids, frame.ids), len(before.ids) - 1)
    known = (before.ids[rows] == frame.ids) & in_front[rows]
    inverse_depths[known], slopes[known] = moved[rows[known]], before.slopes[rows[known]]
    return inverse_depths, slopes
