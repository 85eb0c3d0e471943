"""Patches of a keyframe, on which tracks are registered in later images, and the slant of their surfaces."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Bool, Float, Image, Int
from graphvio.frontend.depth.matching import TwoCameras
from graphvio.frontend.depth.motion_slants import MotionSlants, hand_on_slants
from graphvio.frontend.depth.prediction import (
    around,
    inverse_depths_around,
    patch_deviation_px,
    predict_pixels,
    predict_warps,
)
from graphvio.frontend.depth.tracks import TrackedFrame, common_rows
from graphvio.frontend.imaging.lucas_kanade import register
from graphvio.frontend.imaging.sampling import PixelWords, pixel_words
from graphvio.rig import CameraGroup, SingleCamera

_MAX_REGISTRATION_PX = 2.0
_SAME_PATCH = 0.8  # smallest correlation of a patch with the place where it is found
_MAX_OFF_PX = 1.0  # largest distance of a patch from where a motion predicts it
_MIN_APART_PX = 4.0  # smallest distance of two different places


class KeyframePatches:
    """Patches of one keyframe, which are found again in later images.

    Following a point from frame to frame adds up the errors of each step. The keyframe's patch, deformed by the
    predicted motion and the slant of its surface, gives the point's place without that drift.

    Args:
        group: the pair to which the left images belong, or the single camera.
        window_px: side of the patches; an even one counts as the next.
    """

    def __init__(self, group: CameraGroup, window_px: int) -> None:
        self._group = group
        self._half = window_px // 2
        self._step_px = patch_deviation_px(self._half)
        self._frame = TrackedFrame.empty()
        self._image: PixelWords | None = None
        self._rays: Float = np.zeros((5, 0, 2))  # around each of the tracks
        self._inverse_depths: Float = np.zeros((5, 0))
        self._slants: MotionSlants | None = None
        if isinstance(group, SingleCamera):
            self._slants = MotionSlants(self._half, self._step_px)

    def take(self, frame: TrackedFrame, image: Image, motion: Float | None = None) -> None:
        """Store the patches of a frame's tracks.

        Args:
            frame: tracks of the new keyframe.
            image: (height, width) its left image.
            motion: (4, 4) motion of points since the previous keyframe, by which the slants of a single camera's
                patches are transferred, or None.
        """
        kept = image.copy()  # a driver may fill its buffer again
        self._image = pixel_words(kept)
        self._place(frame, motion)
        if self._slants is not None:
            self._slants.begin(kept)

    def recalibrate(self, group: CameraGroup) -> None:
        """Use another calibration of the cameras."""
        self._group = group
        self._place(self._frame.recalibrated(group), np.eye(4))

    def _place(self, frame: TrackedFrame, motion: Float | None) -> None:
        """Compute rays and inverse depths around a frame's tracks, by the motion since the last keyframe, if known."""
        ids, rays, inverse_depths = self._frame.ids, self._rays, self._inverse_depths
        self._frame = frame
        pixels = around(frame.pixels, self._step_px)
        self._rays = self._group.left.unproject(pixels.reshape(-1, 2))[0].reshape(pixels.shape)
        if isinstance(self._group, SingleCamera):
            self._inverse_depths = np.tile(np.maximum(frame.points[:, 2], 0.0), (5, 1))
            before, now = common_rows(ids if motion is not None else ids[:0], frame.ids)
            if motion is not None:
                self._inverse_depths[:, now] = hand_on_slants(
                    rays[:, before], inverse_depths[:, before], motion, self._rays[:, now], self._inverse_depths[0, now]
                )
            if self._slants is not None:
                self._slants.hand_on(before, now, len(frame.ids))
            return
        right = self._group.right
        self._inverse_depths = inverse_depths_around(
            self._rays,
            np.maximum(frame.points[:, 2], 0.0),
            frame.slopes,
            self._step_px,
            self._group.right_T_left,
            right.model_number,
            right.intrinsics,
            right.distortion,
        )

    def slant(self, found: TrackedFrame, cameras: TwoCameras, is_slope_known: bool) -> None:
        """Set the depth and the slant of a single camera's patches, as measured by matches in another camera.

        Args:
            found: tracks of the keyframe, with their matches in the other camera.
            cameras: this camera as the left one, and the other.
            is_slope_known: whether the matches' slopes were measured; else patches keep the slants that they have.
        """
        rows = np.minimum(np.searchsorted(self._frame.ids, found.ids), max(len(self._frame.ids) - 1, 0))
        kept = self._frame.ids[rows] == found.ids if len(self._frame.ids) else np.zeros(len(rows), dtype=bool)
        if not kept.any():
            return
        rows, depths, right = rows[kept], np.maximum(found.points[kept, 2], 0.0), cameras.right
        if not is_slope_known:
            before = self._inverse_depths[:, rows]
            with np.errstate(divide="ignore", invalid="ignore"):
                self._inverse_depths[:, rows] = depths * np.where(before[0] > 0.0, before / before[0], 1.0)
            return
        self._inverse_depths[:, rows] = inverse_depths_around(
            np.take(self._rays, rows, axis=1),
            depths,
            found.slopes[kept],
            self._step_px,
            cameras.right_T_left,
            right.model_number,
            right.intrinsics,
            right.distortion,
        )
        if self._slants is not None:
            self._slants.note_measured(rows)

    def find(
        self, ids: Int, guess: Float, image: Image, left_T_left_keyframe: Float, min_gradient: float
    ) -> tuple[Float, Bool]:
        """Find the patches of tracks in another image.

        Args:
            ids: (N,) the tracks.
            guess: (N, 2) pixels, nearly right.
            image: (height, width), left.
            left_T_left_keyframe: (4, 4) predicted motion of points since the keyframe.
            min_gradient: smallest rms gradient of a patch along its weaker direction, grey levels per pixel.

        Returns:
            Pixels (N, 2), equal to the guess where there is no patch or it is not found; and which were found (N,).
        """
        pixels, found, rows = self._registered(ids, guess, image, left_T_left_keyframe, min_gradient)
        if self._slants is not None and found.any():
            self._slants.measure(
                self._group.left, self._frame, rows[found], pixels[found], image, left_T_left_keyframe, self._rays,
                self._inverse_depths,
            )  # fmt: skip
        return pixels, found

    def are_also_at(
        self, keyframe_ns: int, ids: Int, pixels: Float, image: Image, left_T_left_keyframe: Float, min_gradient: float
    ) -> Bool:
        """Return which tracks (N,) were followed to one place, but are also found at another that a motion predicts.

        Args:
            keyframe_ns: stamp of the keyframe since which the motion is; without its patches, no track is selected.
            ids: (N,) the tracks.
            pixels: (N, 2) to which they were followed.
            image: (height, width), left.
            left_T_left_keyframe: (4, 4) motion of points since the keyframe.
            min_gradient: smallest rms gradient of a patch along its weaker direction, grey levels per pixel.
        """
        frame, camera = self._frame, self._group.left
        if frame.stamp_ns != keyframe_ns or not len(frame.ids):
            return np.zeros(len(ids), dtype=bool)
        rows = np.minimum(np.searchsorted(frame.ids, ids), len(frame.ids) - 1)
        expected, _, is_in_view = predict_pixels(
            frame.left_rays[rows], self._inverse_depths[0, rows], left_T_left_keyframe, camera.model_number,
            camera.intrinsics, camera.distortion,
        )  # fmt: skip
        found_px, found, _ = self._registered(ids, expected, image, left_T_left_keyframe, min_gradient)
        is_there: Bool = np.linalg.norm(found_px - expected, axis=1) < _MAX_OFF_PX
        is_elsewhere: Bool = np.linalg.norm(found_px - pixels, axis=1) > _MIN_APART_PX
        return found & is_in_view & is_there & is_elsewhere

    def _registered(
        self, ids: Int, guess: Float, image: Image, left_T_left_keyframe: Float, min_gradient: float
    ) -> tuple[Float, Bool, Int]:
        """Return pixels and which tracks were found, as `find` does, and the tracks' rows (N,) in the keyframe."""
        frame = self._frame
        if self._image is None or not len(frame.ids) or not len(ids):
            return guess.copy(), np.zeros(len(ids), dtype=bool), np.zeros(len(ids), dtype=np.int64)
        rows = np.minimum(np.searchsorted(frame.ids, ids), len(frame.ids) - 1)
        wanted = (frame.ids[rows] == ids) & frame.has_depth[rows]
        camera = self._group.left
        warps, bends, usable = predict_warps(
            np.take(self._rays, rows, axis=1),  # indexing would have another layout, and for one row yet another
            np.take(self._inverse_depths, rows, axis=1),
            self._step_px,
            left_T_left_keyframe,
            camera.model_number,
            camera.intrinsics,
            camera.distortion,
        )
        pixels, found, _, correlations = register(
            self._image,
            image,
            frame.pixels[rows],
            warps,
            bends,
            guess,
            wanted & usable,
            self._half,
            _MAX_REGISTRATION_PX,
            min_gradient,
            False,
        )
        found &= correlations > _SAME_PATCH
        pixels[~found] = guess[~found]
        return pixels, found, rows
