"""Corners of one stereo pair or single camera through time: tracked, matched, triangulated and replenished."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Bool, Float, Image, Int
from graphvio.config import Config
from graphvio.frontend.depth.matching import StereoMatcher, TwoCameras
from graphvio.frontend.depth.motion_stereo import PRIOR_INVERSE_DEPTH, FirstSights, MotionHistory
from graphvio.frontend.depth.prediction import predict_pixels
from graphvio.frontend.depth.tracks import TrackedFrame, common_rows, passes, usable_at
from graphvio.frontend.imaging.corners import find_corners, occupied_cells, thinned
from graphvio.frontend.imaging.image_noise import NoiseFilter
from graphvio.frontend.imaging.images import ImageMask, UsablePixels
from graphvio.frontend.imaging.lucas_kanade import MIN_GRADIENT, Pyramid, build_pyramid, track
from graphvio.frontend.tracking.keyframe_patches import KeyframePatches
from graphvio.frontend.tracking.lost_tracks import image_shift, motion_of_found
from graphvio.frontend.tracking.rolling_shutter import ReadoutMotion, as_at_stamp, pixels_at_lines, rays_by_depth
from graphvio.rig import CameraGroup, StereoPair
from graphvio.timing import Stopwatch

_MIN_FOUND = 0.7  # share of the tracks, below which the others are searched for where the found ones predict them
_MAX_ROUNDS = 3
_MAX_TRACKS_PER_CELL = 2
_MAX_FRAMES_WITHOUT_DEPTH = 3  # then the track is dropped for another corner of its cell
_LEVELS_AFTER_PREDICTION = 2  # these suffice where the motion is predicted; tracks that fail are tried again with all


@dataclass(frozen=True, eq=False)
class TrackedImage:
    """The newest image of a camera, and what is tracked in it.

    Attributes:
        frame: the tracks.
        pyramid: pyramid of the image, of two levels at least.
        allowed: (height, width) where the image may be used.
        min_gradient: smallest rms gradient of a patch along its weaker direction, grey levels per pixel.
    """

    frame: TrackedFrame
    pyramid: Pyramid
    allowed: Bool
    min_gradient: float


class GroupTracker:
    """Tracker of the corners of one stereo pair, or of a single camera, from frame to frame.

    Args:
        group: the stereo pair or single camera.
        config: configuration of all stages.
        history: motions since the latest keyframes, from which the depths of a single camera's points are computed.
        image_mask: function that makes a mask for each image, or None.
    """

    def __init__(
        self,
        group: CameraGroup,
        config: Config,
        history: MotionHistory | None = None,
        image_mask: ImageMask | None = None,
    ) -> None:
        self._group = group
        self._config = config
        self._cell_px = config.corners.cell_px(group.left.size_px[0])
        self._usable = [UsablePixels(camera, config.tracking.window_px, image_mask) for camera in group.cameras]
        self._allowed = self._usable[0].always  # later without the newest image's masks
        self._matcher = None
        if isinstance(group, StereoPair):
            self._matcher = StereoMatcher(group, config, self._usable[1].always)
        self._history, self._first_sights = history or MotionHistory(), FirstSights()
        self._body_T_left = group.left.body_T_cam
        self._next_id = 0
        self._last = replace(TrackedFrame.empty(), is_single=self._matcher is None)
        self._left_pyramid: Pyramid = ()
        self._right_pyramid: Pyramid = ()
        self._patches = KeyframePatches(group, config.tracking.window_px)
        self._noise = NoiseFilter()
        self._readout: ReadoutMotion | None = None
        self._left_T_left_keyframe: Float | None = None

    def observe(
        self,
        stamp_ns: int,
        left: Image,
        right: Image | None,
        left_T_left_prev: Float | None,
        left_T_left_keyframe: Float | None,
        masks: tuple[Image | None, ...] = (None, None),
        readout: ReadoutMotion | None = None,
    ) -> TrackedFrame:
        """Follow the tracks, match them left to right and triangulate; replenish them where few are left.

        Args:
            stamp_ns: stamp of these images.
            left: left image (height, width), contiguous, of the rig's image size; or the image of a single camera.
            right: right image likewise, None for a single camera.
            left_T_left_prev: (4, 4) predicted motion of points since the previous images, or None if unknown.
            left_T_left_keyframe: (4, 4) the same since the keyframe of `keep_keyframe_patches`, or None.
            masks: a mask (height, width) for each image, whose zeros are not used, or None.
            readout: motion of body while rolling shutters read the images out, or None if unknown.
        """
        watch = Stopwatch()
        self._left_T_left_keyframe = left_T_left_keyframe
        before, levels = self._left_pyramid, max(self._config.tracking.levels, 2)
        left, right = self._noise.filtered(left, right)
        self._left_pyramid = build_pyramid(left, levels)
        self._right_pyramid = () if right is None else build_pyramid(right, 2)
        self._allowed = self._usable[0].of(left, masks[0])
        if self._matcher is not None and right is not None:
            self._matcher.allow(self._usable[1].of(right, masks[1]))
        self._readout = readout if any(camera.line_time_us for camera in self._group.cameras) else None
        watch.lap("pyramid")
        last, guess, inverse_depths, is_in_view = self._predict(left_T_left_prev)
        pixels, found = self._follow(before, last, guess, is_in_view, left_T_left_prev, left_T_left_keyframe, watch)
        rejected: dict[str, int] = {}
        stays = self._still_wanted(pixels, found, rejected)
        last = last.keep(stays)
        self._last = self._matched(
            stamp_ns,
            last.ids,
            last.ages + 1,
            pixels[stays],
            inverse_depths[stays],
            last.slopes,
            last.frames_without_depth,
            rejected,
        )
        watch.lap("stereo")
        self._last = replace(self._last, stage_ms=watch.stage_ms)
        return self.replenish() if self._share_of_cells(self._last) < self._config.corners.scarce_share else self._last

    def replenish(self) -> TrackedFrame:
        """Add new corners to the newest frame where no track constrains translation.

        At a keyframe of a single camera, compute the points of its tracks from the motion history.
        """
        watch = Stopwatch()
        pixels = self._new_corners(self._last)
        watch.lap("corners")
        new = self._start_tracks(pixels, np.full(len(pixels), np.nan))
        watch.lap("stereo")
        self._last = self._last.extended(replace(new, stage_ms=watch.stage_ms))
        if self._matcher is None and self._history.newest_ns == self._last.stamp_ns:
            self._last = self._located(self._last)
        return self._last

    def _located(self, frame: TrackedFrame) -> TrackedFrame:
        """Return a keyframe of a single camera with the points of its tracks by the motion since their first sights."""
        rays, slopes, sigma_px = frame.left_rays, None, self._config.motion.pixel_sigma_px
        if self._readout is not None:
            rays, slopes = rays_by_depth(self._group.left, frame.pixels, self._readout)
        points, covariances = self._first_sights.locate(
            frame.ids, rays, self._history, self._body_T_left, self._group.left.focal_px, sigma_px, slopes
        )
        frame = replace(frame, points=points, covariances=covariances)
        return frame if self._readout is None else as_at_stamp(frame, self._group, self._readout)

    def adopt(self, pixels: Float, inverse_depths: Float) -> tuple[TrackedFrame, Int]:
        """Begin tracks at given points of a single camera's newest image, where it has no track near.

        Args:
            pixels: (N, 2) of the points.
            inverse_depths: (N,) of the points, 1/m.

        Returns:
            All tracks, and the indices (M,) of the points that the last M of them follow.
        """
        frame, cell_px = self._last, self._cell_px
        inside, usable = usable_at(pixels, self._allowed, self._config.corners.border_px)
        free = thinned(pixels, inside & usable, cell_px, 1)
        if len(frame.ids):
            apart = pixels[:, None] - frame.pixels
            free &= ((apart**2).sum(axis=2) >= (0.5 * cell_px) ** 2).all(axis=1)
        both = np.concatenate([frame.pixels, pixels])
        crowded = ~thinned(both, np.ones(len(both), dtype=bool), cell_px, _MAX_TRACKS_PER_CELL)
        which = np.flatnonzero(free & ~crowded[len(frame.ids) :])
        first_id = self._next_id
        new = self._start_tracks(pixels[which], inverse_depths[which])
        self._last = frame.extended(new)
        return self._last, which[new.ids - first_id]

    def are_also_at(self, keyframe_ns: int, ids: Int, left_T_left_keyframe: Float) -> Bool:
        """Return which tracks (N,) of the newest frame are also seen where a motion since the keyframe predicts them.

        Args:
            keyframe_ns: stamp of the keyframe.
            ids: (N,) the tracks, increasing.
            left_T_left_keyframe: (4, 4) motion of points.
        """
        now, rows = common_rows(self._last.ids, ids)
        found = np.zeros(len(ids), dtype=bool)
        found[rows] = self._patches.are_also_at(
            keyframe_ns, ids[rows], self._last.pixels[now], self._left_pyramid[0], left_T_left_keyframe,
            self._min_gradient,
        )  # fmt: skip
        return found

    @property
    def tracked_image(self) -> TrackedImage:
        """The newest left image, and what is tracked in it."""
        return TrackedImage(self._last, self._left_pyramid, self._allowed, self._min_gradient)

    @property
    def are_lines_off(self) -> bool:
        """Whether corners are matched on lines beside the epipolar lines of the calibration."""
        return self._matcher is not None and self._matcher.are_lines_off

    def move(self, body_T_left: Float) -> None:
        """Use another pose (4, 4) of a single camera in body from now on."""
        self._body_T_left = np.ascontiguousarray(body_T_left)

    def recalibrate(self, group: CameraGroup, epipolar_margin_px: float) -> None:
        """Use another calibration of the cameras from now on, whose epipolar lines may be off by a margin."""
        if self._matcher is None:
            self._first_sights.recalibrate(self._group.left, group.left)
        elif isinstance(group, StereoPair):
            self._matcher.recalibrate(group, epipolar_margin_px)
        self._group = group
        self._patches.recalibrate(group)
        self._last = self._last.recalibrated(group)

    def limit_corners(self, share: float) -> None:
        """Enlarge the image's cells, so that there is only a share of the configured number of them and of corners."""
        self._cell_px = round(self._config.corners.cell_px(self._group.left.size_px[0]) / np.sqrt(share))

    def keep_keyframe_patches(self) -> None:
        """Register the tracks on the newest frame's patches from now on."""
        if self._left_pyramid:
            self._patches.take(self._last, self._left_pyramid[0], self._left_T_left_keyframe)

    def slant_keyframe_patches(self, found: TrackedFrame, cameras: TwoCameras, is_slope_known: bool) -> None:
        """Set depth and slant of the patches by matches in another camera, see `KeyframePatches.slant`."""
        self._patches.slant(found, cameras, is_slope_known)

    def drop(self, ids: Int) -> None:
        """Drop tracks, so that new corners may take their place."""
        if len(ids):
            stays = np.ones(len(self._last.ids), dtype=bool)
            stays[common_rows(self._last.ids, ids)[0]] = False
            self._last = self._last.keep(stays)

    def _predict(self, left_T_left_prev: Float | None) -> tuple[TrackedFrame, Float, Float, Bool]:
        """Select the tracks to follow, and predict where they are in the newest image.

        Returns:
            The tracks, their predicted pixels (N, 2) and inverse depths (N,), NaN if unknown, and whether each is
            predicted to be in the image (N,).
        """
        last, camera = self._last.keep(self._last.frames_without_depth <= _MAX_FRAMES_WITHOUT_DEPTH), self._group.left
        if left_T_left_prev is None:
            inverse_depths = np.where(last.has_depth, last.points[:, 2], np.nan)
            return last, last.pixels, inverse_depths, np.ones(len(last.ids), dtype=bool)
        w = _inverse_depths(last)
        pixels, inverse_depths, valid = predict_pixels(
            last.left_rays, w, left_T_left_prev, camera.model_number, camera.intrinsics, camera.distortion
        )
        if self._readout is not None:
            pixels, inverse_depths = pixels_at_lines(camera, pixels, inverse_depths, self._readout)
        valid &= camera.contains(pixels)
        inverse_depths[~(last.has_depth & valid)] = np.nan
        return last, np.where(valid[:, None], pixels, last.pixels), inverse_depths, valid

    def _follow(
        self,
        before: Pyramid,
        last: TrackedFrame,
        guess: Float,
        is_in_view: Bool,
        left_T_left_prev: Float | None,
        left_T_left_keyframe: Float | None,
        watch: Stopwatch,
    ) -> tuple[Float, Bool]:
        """Find the tracks' pixels now (N, 2), and which of them were found (N,).

        Most are found directly by their patches in the keyframe, near their predicted place; the others are tracked
        from the previous frame.
        """
        pixels, found = guess.copy(), np.zeros(len(guess), dtype=bool)
        if left_T_left_keyframe is not None and left_T_left_prev is not None:
            pixels, found = self._patches.find(
                last.ids, guess, self._left_pyramid[0], left_T_left_keyframe, self._min_gradient
            )
        watch.lap("register")
        # Tracks that leave the image are not searched for: next to its edge something similar would be found instead.
        others = np.flatnonzero(~found & is_in_view)
        if len(others):
            is_near = left_T_left_prev is not None
            pixels[others], found[others] = self._tracked(before, last.pixels[others], guess[others], is_near)
        if found.sum() < _MIN_FOUND * len(found):
            pixels, found = self._follow_again(before, last, pixels, found)
        watch.lap("flow")
        if left_T_left_keyframe is not None:
            # Followed from frame to frame they would drift off their points: they are registered like the others.
            others = others[found[others]]
            pixels[others], _ = self._patches.find(
                last.ids[others], pixels[others], self._left_pyramid[0], left_T_left_keyframe, self._min_gradient
            )
        watch.lap("register")
        return pixels, found

    def _follow_again(self, before: Pyramid, last: TrackedFrame, pixels: Float, found: Bool) -> tuple[Float, Bool]:
        """Search for lost tracks where the motion of the found ones, or else the shift of the image, predicts them."""
        camera = self._group.left
        w = _inverse_depths(last)
        for _ in range(_MAX_ROUNDS):
            rays, has_ray = camera.unproject(pixels)
            moved = motion_of_found(last.left_rays, w, rays, found & has_ray, camera.focal_px)
            if moved is not None:
                guess, _, valid = predict_pixels(
                    last.left_rays, w, moved, camera.model_number, camera.intrinsics, camera.distortion
                )
            else:
                shift_px = image_shift(before[-1], self._left_pyramid[-1]) * 2 ** (len(before) - 1)
                guess, valid = last.pixels + shift_px, np.ones(len(found), dtype=bool)
            again = np.flatnonzero(~found & valid & camera.contains(guess))
            pixels[again], found[again] = self._tracked(before, last.pixels[again], guess[again], moved is not None)
            if not found[again].any():
                break
        return pixels, found

    def _tracked(self, before: Pyramid, then: Float, guess: Float, is_near: bool) -> tuple[Float, Bool]:
        """Track pixels (N, 2) of the previous image from a guess; if it is near, with few pyramid levels first."""
        settings = self._config.tracking
        return track(
            before,
            self._left_pyramid,
            then,
            guess,
            window_px=settings.window_px,
            levels=settings.levels,
            max_return_px=settings.max_forward_backward_px,
            min_gradient=self._min_gradient,
            first_levels=_LEVELS_AFTER_PREDICTION if is_near else None,
        )

    def _still_wanted(self, pixels: Float, found: Bool, rejected: dict[str, int]) -> Bool:
        """Select the tracks (N,) that stay: found, where the image may be used, and not crowded together."""
        corners = self._config.corners
        found = passes(np.ones(len(found), dtype=bool), found, "flow", rejected)
        inside, usable = usable_at(pixels, self._allowed, corners.border_px)
        found = passes(found, inside, "edge", rejected)
        found = passes(found, usable, "masked_left", rejected)
        alone = thinned(pixels, found, self._cell_px, _MAX_TRACKS_PER_CELL)  # the oldest of a cell come first
        return passes(found, alone, "crowded", rejected)

    def _start_tracks(self, pixels: Float, inverse_depths: Float) -> TrackedFrame:
        """Return new tracks at pixels (N, 2) of the newest image, except those outside the domain of the lens."""
        n = len(pixels)
        ids, ages = self._next_id + np.arange(n), np.zeros(n, dtype=np.int64)
        self._next_id += n
        frames_without_depth = np.zeros_like(ages)
        return self._matched(
            self._last.stamp_ns, ids, ages, pixels, inverse_depths, np.zeros((n, 2)), frames_without_depth, {}
        )

    def _matched(
        self, stamp_ns: int, ids: Int, ages: Int, pixels: Float, inverse_depths: Float, slopes: Float,
        frames_without_depth: Int, rejected: dict[str, int],
    ) -> TrackedFrame:  # fmt: skip
        """Match tracks of the newest left image to the right one, and triangulate them.

        Tracks of a single camera get the inverse depths that are given, or a prior.
        """
        rays, has_ray = self._group.left.unproject(pixels)
        if self._matcher is None:
            frame = _unmatched(stamp_ns, ids, ages, pixels, rays, inverse_depths, rejected).keep(has_ray)
            return frame if self._readout is None else as_at_stamp(frame, self._group, self._readout)
        matches = self._matcher.match(
            self._left_pyramid, self._right_pyramid, pixels, rays, inverse_depths, slopes, self._min_gradient
        )
        has_depth = matches.good & has_ray
        frame = TrackedFrame(
            stamp_ns=stamp_ns,
            ids=ids,
            ages=ages,
            pixels=pixels,
            left_rays=rays,
            right_rays=matches.right,
            right_pixels=matches.right_pixels,
            points=matches.points,
            covariances=matches.covariances,
            slopes=matches.slopes,
            has_depth=has_depth,
            frames_without_depth=np.where(has_depth, 0, frames_without_depth + 1),
            rejected=rejected | matches.rejected,
        ).keep(has_ray)
        return frame if self._readout is None else as_at_stamp(frame, self._group, self._readout)

    def read_out(self, readout: ReadoutMotion) -> TrackedFrame:
        """Compensate the rolling shutters of the newest frame again, by another motion of body."""
        if self._group.left.line_time_us:
            self._readout, self._last = readout, as_at_stamp(self._last, self._group, readout)
        return self._last

    def read_out_keyframe(self, keyframe: TrackedFrame, readout: ReadoutMotion) -> None:
        """Compensate the first sights of a single camera's tracks at a keyframe again, by another motion of body."""
        if self._matcher is None and self._group.left.line_time_us:
            rays, slopes = rays_by_depth(self._group.left, keyframe.pixels, readout)
            self._first_sights.see_again(keyframe.stamp_ns, keyframe.ids, rays, slopes)

    @property
    def _min_gradient(self) -> float:
        """Smallest rms gradient along a patch's weaker direction; that of pure noise is 0.7 of its own sigma."""
        return min(MIN_GRADIENT, self._noise.left_sigma)

    def _share_of_cells(self, frame: TrackedFrame, new: Float | None = None) -> float:
        """Compute the share of the image's cells that hold a track with depth, or a new corner (M, 2)."""
        cell_px, (width, height) = self._cell_px, self._group.left.size_px
        pixels = frame.pixels[frame.has_depth]
        both = pixels if new is None else np.concatenate([pixels, new])
        return float(occupied_cells(both, cell_px, -(-height // cell_px), -(-width // cell_px)).mean())

    def _new_corners(self, frame: TrackedFrame) -> Float:
        """Find corners (M, 2) where no track constrains translation, and also weak ones if corners are scarce."""
        settings, image = self._config.corners, self._left_pyramid[0]
        tracked, occupying = frame.pixels, frame.constrains_translation(self._config.motion.pixel_sigma_px)
        if frame.is_single:
            occupying = np.ones(len(tracked), dtype=bool)  # a point that does not seem near may turn out to be
        cell_px, border_px = self._cell_px, settings.border_px
        new = find_corners(image, self._allowed, tracked, occupying, cell_px, border_px, settings.min_response)
        admitted = settings.noise_factor * self._noise.left_sigma
        if admitted >= settings.min_response or self._share_of_cells(frame, new) >= settings.scarce_share:
            return new
        tracked, occupying = np.concatenate([tracked, new]), np.concatenate([occupying, np.ones(len(new), dtype=bool)])
        weak = find_corners(image, self._allowed, tracked, occupying, cell_px, border_px, admitted)
        return np.concatenate([new, weak])


def _inverse_depths(frame: TrackedFrame) -> Float:
    """Return the inverse depths (N,) of a frame's tracks, 0 where they are unknown or behind the camera."""
    return np.where(frame.has_depth, np.maximum(frame.points[:, 2], 0.0), 0.0)


def _unmatched(
    stamp_ns: int, ids: Int, ages: Int, pixels: Float, rays: Float, inverse_depths: Float, rejected: dict[str, int]
) -> TrackedFrame:
    """Return the tracks of a single camera, with the expected inverse depths (N,), or a prior where these are NaN."""
    n = len(ids)
    filled = np.where(np.isfinite(inverse_depths), inverse_depths, PRIOR_INVERSE_DEPTH)
    nothing, unmoved = np.zeros((n, 2)), np.zeros(n, dtype=np.int64)
    return TrackedFrame(
        stamp_ns=stamp_ns,
        ids=ids,
        ages=ages,
        pixels=pixels,
        left_rays=rays,
        right_rays=nothing,
        right_pixels=nothing,
        points=np.column_stack([rays, filled]),
        covariances=np.tile(np.eye(3), (n, 1, 1)),
        slopes=nothing,
        has_depth=np.ones(n, dtype=bool),
        frames_without_depth=unmoved,
        is_single=True,
        rejected=rejected,
    )
