"""Choice of places among the keyframes, and stereo matching of features at them."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Bool, Float, Image, Int
from graphvio.config import Config
from graphvio.frontend.depth.matching import StereoMatcher
from graphvio.frontend.depth.tracks import TrackedFrame, usable_at
from graphvio.frontend.imaging.images import UsablePixels
from graphvio.frontend.imaging.lucas_kanade import MIN_GRADIENT, build_pyramid
from graphvio.geometry import se3_inverse, so3_log
from graphvio.optimization.record import SessionRecord
from graphvio.rig import Camera, StereoPair

_LEVELS = 2  # of the image pyramid, enough for stereo matching


class PlaceChooser:
    """Chooses keyframes as places, one after the other, at least a distance or angle from the previous place."""

    def __init__(self, distance_m: float, angle_deg: float) -> None:
        self._distance_m = distance_m
        self._angle_deg = angle_deg
        self._last: tuple[int, Float] | None = None  # epoch and pose of the previous place

    def takes(self, epoch: int, nav_T_body: Float) -> bool:
        """Return whether the next keyframe, with the pose (4, 4), is a place."""
        if self._last is not None and epoch == self._last[0]:
            moved = se3_inverse(self._last[1]) @ nav_T_body
            angle = np.linalg.norm(so3_log(np.ascontiguousarray(moved[:3, :3])))
            if np.linalg.norm(moved[:3, 3]) < self._distance_m and np.rad2deg(angle) < self._angle_deg:
                return False
        self._last = epoch, nav_T_body
        return True


def choose_places(record: SessionRecord, distance_m: float, angle_deg: float) -> Int:
    """Choose keyframes as places, at least a distance or angle from the previous place; returns their rows (P,)."""
    chooser = PlaceChooser(distance_m, angle_deg)
    keyframes = np.flatnonzero(record.is_keyframe).tolist()
    chosen = [row for row in keyframes if chooser.takes(int(record.epoch[row]), record.smoothed[row])]
    return np.array(chosen, dtype=np.int64)


class ImageObserver:
    """Decides which features in one camera's image are used."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self._allowed = UsablePixels(camera, config.tracking.window_px).always

    def usable(self, pixels: Float) -> Bool:
        """Return which pixels (N, 2) are inside the image and not masked."""
        inside, usable = usable_at(pixels, self._allowed, 0.0)
        return inside & usable


class PairObserver(ImageObserver):
    """Decides which features in one pair's left image are used, and finds their depth by stereo matching."""

    def __init__(self, pair: StereoPair, config: Config) -> None:
        super().__init__(pair.left, config)
        self.pair = pair
        self._matcher = StereoMatcher(pair, config, UsablePixels(pair.right, config.tracking.window_px).always)

    def observe(
        self,
        stamp_ns: int,
        images: tuple[Image, Image],
        pixels: Float,
        inverse_depths: Float | None = None,
    ) -> TrackedFrame:
        """Return a frame whose tracks are these features.

        Args:
            stamp_ns: stamp of the images.
            images: left and right image.
            pixels: features (N, 2) in the left image.
            inverse_depths: expected inverse depths (N,), 1/m; NaN or None where unknown.
        """
        left, right = (build_pyramid(np.ascontiguousarray(image), _LEVELS) for image in images)
        rays, has_ray = self.pair.left.unproject(pixels)
        n = len(pixels)
        expected = np.full(n, np.nan) if inverse_depths is None else inverse_depths
        matches = self._matcher.match(left, right, pixels, rays, expected, np.zeros((n, 2)), MIN_GRADIENT)
        return TrackedFrame(
            stamp_ns=stamp_ns,
            ids=np.arange(n),
            ages=np.zeros(n, dtype=np.int64),
            pixels=np.ascontiguousarray(pixels),
            left_rays=rays,
            right_rays=matches.right,
            right_pixels=matches.right_pixels,
            points=matches.points,
            covariances=matches.covariances,
            slopes=matches.slopes,
            has_depth=matches.good & has_ray,
            frames_without_depth=np.zeros(n, dtype=np.int64),
        )
