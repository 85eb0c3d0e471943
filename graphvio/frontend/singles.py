"""The front-end of a rig of single cameras: it tracks and chooses keyframes; the back-end measures the motion."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from graphvio.arrays import Bool, Int
from graphvio.config import Config
from graphvio.frontend.depth.tracks import TrackedFrame, common_rows
from graphvio.frontend.imaging.images import ImageMask
from graphvio.frontend.thresholds import THRESHOLDS
from graphvio.frontend.tracking.handover import Handover, Leaving
from graphvio.frontend.tracking.overlaps import Overlaps
from graphvio.frontend.tracking.rolling_shutter import turned_rays
from graphvio.frontend.tracking_frontend import MotionPredictor, TrackedFrameset, TrackingFrontend
from graphvio.measurements.motion import CameraTracks, PairReport, Quality, VisualResult
from graphvio.rig import Rig
from graphvio.timing import timed

_MIN_PARALLAX = 0.01  # median displacement of rays since a keyframe: with less, the rig has not moved
_MAX_PARALLAX = 0.06  # with more, a keyframe is due
_KEYFRAMES_AHEAD = 2.0  # tracks that leave a camera's view within so many keyframes are handed over
_MIN_INTERVAL_NS = 140_000_000  # between keyframes while there is no motion to predict tracks by


class SinglesFrontend(TrackingFrontend):
    """Tracks every camera, and decides when a keyframe begins."""

    def __init__(self, rig: Rig, config: Config, image_mask: ImageMask | None = None) -> None:
        super().__init__(rig, config, image_mask)
        self._of_file = [single.left for single in rig.singles]  # the cameras by whose lenses rays are computed
        self._overlaps = Overlaps(rig, config)
        self._handover = Handover(len(rig.singles))

    def recalibrate(self, rig: Rig, epipolar_margin_px: float) -> None:
        """Track and match with another calibration of the same cameras from the next frameset on.

        The rays in the results are still computed by the lenses of the rig file: from them the back-end estimates the
        calibration.

        Args:
            rig: the rig, with the new calibration.
            epipolar_margin_px: by how much its epipolar lines may be off, pixels; added to the largest epipolar error
                of a match.
        """
        self._recalibrate(rig, epipolar_margin_px, {})
        self._overlaps.recalibrate(rig, epipolar_margin_px)

    def _measure(self, seen: TrackedFrameset, motion_since: MotionPredictor) -> VisualResult:
        """Return the tracks of all cameras and their matches in other cameras, and begin a keyframe if one is due.

        The motion is measured by the back-end.
        """
        is_stationary = self._standstill.update(seen.frames, {j: frame.ids for j, frame in seen.frames.items()})
        reports = {j: _report(frame) for j, frame in seen.frames.items()}
        is_keyframe = not self._all_frozen and self._is_keyframe(
            seen.stamp_ns, seen.frames, motion_since, is_stationary
        )
        if is_keyframe:
            self._advance_history(seen, motion_since)
        camera_tracks = self._match_across_cameras(seen, motion_since, is_keyframe)
        if is_keyframe:
            seen, camera_tracks = self._begin_keyframe(seen, motion_since)
        tracked = sum(int((frame.ages > 0).sum()) for frame in seen.frames.values())
        is_good = tracked >= self._config.motion.min_inliers
        return VisualResult(
            None,
            Quality.GOOD if is_good or not seen.reference else Quality.FAILED,
            "" if is_good else f"only {tracked} points in view",
            reports,
            is_stationary=is_stationary,
            frozen=seen.frozen.pairs,
            stage_ms=self.stage_ms,
            camera_tracks={} if self._all_frozen else camera_tracks,
        )

    def _advance_history(self, seen: TrackedFrameset, motion_since: MotionPredictor) -> None:
        """Store the predicted motion since the last keyframe, from which depths at the new keyframe are computed."""
        reference = next(iter(seen.reference.values()), None)
        cur_T_reference = None if reference is None else motion_since(reference.stamp_ns)
        if reference is not None and cur_T_reference is not None:
            for j in seen.frames:
                self._histories[j].advance(reference.stamp_ns, seen.stamp_ns, cur_T_reference, np.zeros((6, 6)))

    def _begin_keyframe(
        self, seen: TrackedFrameset, motion_since: MotionPredictor
    ) -> tuple[TrackedFrameset, dict[int, CameraTracks]]:
        """Make the frameset a keyframe: add handed-over tracks and new corners, and match these in other cameras.

        Returns:
            The frameset with all its tracks, and camera index -> its tracks.
        """
        before = seen.frames
        seen = seen._replace(frames=self._refer_to(self._handed_over(before)))
        new = {j: ~np.isin(frame.ids, before[j].ids) for j, frame in seen.frames.items()}
        camera_tracks = self._match_across_cameras(seen, motion_since, True, new)
        for j in seen.frames:
            self._overlaps.slant(j, self._trackers[j])
        return seen, camera_tracks

    @timed("elsewhere")
    def _match_across_cameras(
        self, seen: TrackedFrameset, motion_since: MotionPredictor, searches: bool,
        wanted: Mapping[int, Bool] | None = None,
    ) -> dict[int, CameraTracks]:  # fmt: skip
        """Find each camera's tracks in the other cameras that see the same part of the scene.

        Between keyframes, tracks that were handed over are left out while the original camera still follows the point:
        the original track is matched instead.

        Args:
            seen: tracks of the frameset.
            motion_since: predicts the motion since an earlier stamp.
            searches: whether tracks without an earlier match are searched for, as at keyframes.
            wanted: camera index -> (N,) which of its tracks to match; None for all.
        """
        frames = seen.frames
        images = {j: self._trackers[j].tracked_image for j in frames}
        of_others = {j: np.zeros(len(frames[j].ids), dtype=bool) for j in frames}
        if not searches:
            of_others = {j: self._handover.is_followed(j, frames) for j in frames}

        def find(j: int) -> CameraTracks:
            chosen = ~of_others[j] if wanted is None else wanted[j]
            self._overlaps.find(j, images, lambda then_ns: self._moved(j, motion_since(then_ns)), searches, chosen)
            matches, handed_over = self._overlaps.matches_of(j, frames[j]), self._handover.handed_over(j, frames[j])
            camera = self._of_file[j]
            if camera.line_time_us and seen.readout is not None and seen.readout.is_by_imu:
                rays, readout = turned_rays(camera, frames[j].pixels, seen.readout)
                return CameraTracks(frames[j].ids, rays, matches, handed_over, readout)
            rays, _ = camera.unproject(frames[j].pixels_at_stamp)
            return CameraTracks(frames[j].ids, rays, matches, handed_over)

        return self._in_parallel(find, frames)

    @timed("handover")
    def _handed_over(self, frames: dict[int, TrackedFrame]) -> dict[int, TrackedFrame]:
        """Let cameras follow the points of tracks that are about to leave another camera's view."""
        leaving = {j: self._leaving(j, frame) for j, frame in frames.items()}
        adopted = dict(frames)
        for j, frame in sorted(frames.items()):
            found = self._overlaps.found_in(j, frame.stamp_ns, leaving)
            adopted[j] = self._handover.adopt(j, self._trackers[j], frames, found)
        return adopted

    def _leaving(self, camera: int, frame: TrackedFrame) -> Leaving:
        """Return the tracks that will soon leave a camera's view if they move on as since the last keyframe."""
        reference = self._references.of(camera) or TrackedFrame.empty()
        then, now = common_rows(reference.ids, frame.ids)
        ahead = frame.pixels[now] + _KEYFRAMES_AHEAD * (frame.pixels[now] - reference.pixels[then])
        margin, size = self._config.corners.border_px, np.array(self._rig.groups[camera].left.size_px)
        leaves = ((ahead < margin) | (ahead > size - 1 - margin)).any(axis=1)
        then, now = then[leaves], now[leaves]
        sigmas = self._config.motion.pixel_sigma_px * np.sqrt(reference.covariances[then, 2, 2])
        return Leaving(frame.ids[now], frame.points[now, 2], sigmas)

    def _is_keyframe(
        self, stamp_ns: int, frames: dict[int, TrackedFrame], motion_since: MotionPredictor, is_stationary: bool
    ) -> bool:
        """Decide whether the frameset becomes a keyframe.

        Later tracks are registered on a keyframe's images, and its state stays in the back-end's window.
        """
        references = {j: reference for j in frames if (reference := self._references.of(j)) is not None}
        if len(references) < len(frames):
            return True
        if is_stationary:
            return False
        common = {j: common_rows(references[j].ids, frame.ids) for j, frame in frames.items()}
        if self._lost_sight(references, common):
            return True
        if not any(len(then) for then, _ in common.values()):  # the reference was taken in the dark: no tracks to lose
            return any(len(frame.ids) for frame in frames.values())
        parallax, since_ns, is_predicted = self._parallax(frames, references, common, motion_since)
        if not is_predicted:
            return parallax > _MIN_PARALLAX and stamp_ns - since_ns >= _MIN_INTERVAL_NS
        return parallax > _MAX_PARALLAX

    def _lost_sight(self, references: Mapping[int, TrackedFrame], common: Mapping[int, tuple[Int, Int]]) -> bool:
        """Return whether too few tracks of the references are still followed, in any camera or in all together."""
        min_overlap = self._config.motion.keyframe_overlap
        min_share = min_overlap * THRESHOLDS.reference.min_pair_share
        overlaps = {j: len(then) for j, (then, _) in common.items()}
        if any(overlaps[j] < min_share * len(reference.ids) for j, reference in references.items()):
            return True
        return sum(overlaps.values()) < min_overlap * sum(len(reference.ids) for reference in references.values())

    def _parallax(
        self,
        frames: Mapping[int, TrackedFrame],
        references: Mapping[int, TrackedFrame],
        common: Mapping[int, tuple[Int, Int]],
        motion_since: MotionPredictor,
    ) -> tuple[float, int, bool]:
        """Compute by how much rays have moved since the references, apart from the predicted rotation.

        Returns:
            The median displacement in normalised coordinates, the stamp of the reference since which the rotation is
            predicted, and whether it is predicted at all.
        """
        displacements = []
        since_ns, cur_T_reference = 0, None
        for j, frame in frames.items():
            reference, (then, now) = references[j], common[j]
            if cur_T_reference is None:
                since_ns = reference.stamp_ns
                cur_T_reference = motion_since(since_ns)
            rays = np.column_stack([reference.left_rays[then], np.ones(len(then))])
            if cur_T_reference is not None:
                body_R_cam = self._extrinsics.arrays.body_T_left[j][:3, :3]
                rays = rays @ (body_R_cam.T @ cur_T_reference[:3, :3] @ body_R_cam).T
            ahead = rays[:, 2] > 0.1
            moved = frame.left_rays[now][ahead] - rays[ahead, :2] / rays[ahead, 2:]
            displacements.append(np.hypot(moved[:, 0], moved[:, 1]))
        return float(np.median(np.concatenate(displacements))), since_ns, cur_T_reference is not None


def _report(frame: TrackedFrame) -> PairReport:
    """Return a report of a camera's tracks, in which all count as inliers: the back-end finds the outliers."""
    n = len(frame.ids)
    return PairReport(n, n, frame.pixels, np.ones(n, dtype=bool), frame.ages, frame.rejected)
