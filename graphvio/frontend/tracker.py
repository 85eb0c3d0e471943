"""Corners of one stereo pair through time: tracked, registered, renewed, matched left to right and triangulated."""

from __future__ import annotations

import cv2
import numpy as np

from graphvio.arrays import Bool, Float, Image, Int
from graphvio.config import Config
from graphvio.errors import RigError
from graphvio.frontend.corners import find_corners, occupied_cells, thinned
from graphvio.frontend.grain import noise_sigma
from graphvio.frontend.lucas_kanade import MIN_GRADIENT, Pyramid, build_pyramid, register, track
from graphvio.frontend.matching import StereoMatcher
from graphvio.frontend.prediction import predict_pixels, predict_warps
from graphvio.frontend.stopwatch import Stopwatch
from graphvio.frontend.tracks import PairFrame, passes
from graphvio.rig import Camera, StereoPair

_MAX_TRACKS_PER_CELL = 2
_MAX_FLAT_FRAMES = 3  # then another corner of the cell gets its chance
_MAX_REGISTRATION_PX = 2.0
_SAME_PATCH = 0.8  # correlation with the anchor's patch
_LEVELS_AFTER_PREDICTION = 2  # are enough where the motion is known; tracks that fail are tried again with all


class PairTracker:
    """Follows the corners of one stereo pair from frame to frame."""

    def __init__(self, pair: StereoPair, config: Config) -> None:
        self._pair = pair
        self._config = config
        self._allowed = _allowed(pair.left)
        self._matcher = StereoMatcher(pair, config, _allowed(pair.right))
        self._next_id = 0
        self._last = PairFrame.empty()
        self._last_pyramid: Pyramid = ()
        self._anchor = PairFrame.empty()
        self._anchor_image: Image | None = None
        self._anchor_rays = np.zeros((3, 0, 2))  # of each of its pixels and of the ones to the right and below
        self._noise_sigma = 0.0

    def observe(
        self,
        stamp_ns: int,
        left: Image,
        right: Image,
        left_T_left_prev: Float | None,
        left_T_left_anchor: Float | None,
    ) -> PairFrame:
        """Track, register, renew and triangulate.

        Args:
            stamp_ns: of these images.
            left: (height, width).
            right: (height, width).
            left_T_left_prev: (4, 4) predicted motion of points since the images before, or None if unknown.
            left_T_left_anchor: (4, 4) the same since the anchor, or None.

        Raises:
            RigError: if an image is not what the rig says.
        """
        left, right = _checked(left, self._pair.left), _checked(right, self._pair.right)
        watch = Stopwatch()
        pyramid = build_pyramid(left, max(self._config.tracking.levels, 2))
        self._noise_sigma = noise_sigma(left)
        # A patch of nothing but noise has 0.7 of its standard deviation.
        min_gradient = min(MIN_GRADIENT, self._noise_sigma)
        watch.lap("pyramid")
        rejected: dict[str, int] = {}
        last, guess, inverse_depths = self._predict(left_T_left_prev)
        pixels, found = self._follow(pyramid, last, guess, left_T_left_prev, left_T_left_anchor, min_gradient, watch)
        stays = self._still_wanted(pixels, found, rejected)
        kept, pixels, inverse_depths = last.keep(stays), pixels[stays], inverse_depths[stays]
        new = self._renew(left, pixels, np.isfinite(inverse_depths))
        watch.lap("corners")
        pixels = np.concatenate([pixels, new])
        rays, has_ray = self._pair.left.unproject(pixels)
        inverse_depths = np.concatenate([inverse_depths, np.full(len(new), np.nan)])
        slopes = np.concatenate([kept.slopes, np.zeros((len(new), 2))])
        matches = self._matcher.match(
            pyramid, build_pyramid(right, 2), pixels, rays, inverse_depths, slopes, min_gradient
        )
        watch.lap("stereo")
        none = np.zeros(len(new), dtype=np.int64)
        has_depth = matches.good & has_ray
        self._last = PairFrame(
            stamp_ns=stamp_ns,
            ids=np.concatenate([kept.ids, self._next_id + np.arange(len(new))]),
            ages=np.concatenate([kept.ages + 1, none]),
            pixels=pixels,
            left=rays,
            right=matches.right,
            points=matches.points,
            covariances=matches.covariances,
            slopes=matches.slopes,
            has_depth=has_depth,
            flat_for=np.where(has_depth, 0, np.concatenate([kept.flat_for, none]) + 1),
            rejected=rejected | matches.rejected,
            stage_ms=watch.stage_ms,
        ).keep(has_ray)
        self._next_id += len(new)
        self._last_pyramid = pyramid
        return self._last

    def anchor(self) -> None:
        """Hold the tracks against the newest frame's own patches from here on."""
        self._anchor = self._last
        self._anchor_image = self._last_pyramid[0] if self._last_pyramid else None
        beside = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        self._anchor_rays = np.stack([self._pair.left.unproject(self._last.pixels + step)[0] for step in beside])

    def drop(self, ids: Int) -> None:
        """Forget tracks, so that fresh corners may take their place."""
        if len(ids):
            self._last = self._last.keep(~np.isin(self._last.ids, ids))

    def _predict(self, left_T_left_prev: Float | None) -> tuple[PairFrame, Float, Float]:
        """The tracks worth following, and their pixels (N, 2) and inverse depths (N,), or NaN, after a motion."""
        last, camera = self._last.keep(self._last.flat_for <= _MAX_FLAT_FRAMES), self._pair.left
        if left_T_left_prev is None:
            return last, last.pixels, np.where(last.has_depth, last.points[:, 2], np.nan)
        w = np.where(last.has_depth, np.maximum(last.points[:, 2], 0.0), 0.0)
        pixels, inverse_depths, valid = predict_pixels(
            last.left, w, left_T_left_prev, camera.model_number, camera.intrinsics, camera.distortion
        )
        valid &= camera.contains(pixels)
        inverse_depths[~(last.has_depth & valid)] = np.nan
        return last, np.where(valid[:, None], pixels, last.pixels), inverse_depths

    def _follow(
        self,
        pyramid: Pyramid,
        last: PairFrame,
        guess: Float,
        left_T_left_prev: Float | None,
        left_T_left_anchor: Float | None,
        min_gradient: float,
        watch: Stopwatch,
    ) -> tuple[Float, Bool]:
        """Where the tracks are now (N, 2), and which of them were found (N,).

        Following a point from frame to frame adds up the errors of each step. The anchor's patch, deformed as the
        predicted motion would have it, shows where the point really is: most tracks are found on it at once, near
        their predicted place. The others go by way of the frame before.
        """
        pixels, found = guess, np.zeros(len(guess), dtype=bool)
        if left_T_left_anchor is not None and left_T_left_prev is not None:
            pixels, found = self._register(pyramid[0], last.ids, guess, left_T_left_anchor, min_gradient)
        watch.lap("register")
        rest, settings = np.flatnonzero(~found), self._config.tracking
        if len(rest):
            pixels[rest], found[rest] = track(
                self._last_pyramid,
                pyramid,
                last.pixels[rest],
                guess[rest],
                window_px=settings.window_px,
                levels=settings.levels,
                max_return_px=settings.max_forward_backward_px,
                min_gradient=min_gradient,
                first_levels=None if left_T_left_prev is None else _LEVELS_AFTER_PREDICTION,
            )
        watch.lap("flow")
        if left_T_left_anchor is not None:
            rest = rest[found[rest]]
            pixels[rest], _ = self._register(pyramid[0], last.ids[rest], pixels[rest], left_T_left_anchor, min_gradient)
        watch.lap("register")
        return pixels, found

    def _register(
        self, image: Image, ids: Int, guess: Float, left_T_left_anchor: Float, min_gradient: float
    ) -> tuple[Float, Bool]:
        """Pixels (N, 2) where the patches that the tracks had at the anchor are now, and whether they are (N,)."""
        anchor = self._anchor
        if self._anchor_image is None or not len(anchor.ids) or not len(ids):
            return guess.copy(), np.zeros(len(ids), dtype=bool)
        rows = np.minimum(np.searchsorted(anchor.ids, ids), len(anchor.ids) - 1)
        wanted = (anchor.ids[rows] == ids) & anchor.has_depth[rows]
        camera = self._pair.left
        warps, usable = predict_warps(
            self._anchor_rays[:, rows],
            np.maximum(anchor.points[rows, 2], 0.0),
            left_T_left_anchor,
            camera.model_number,
            camera.intrinsics,
            camera.distortion,
        )
        pixels, found, _, correlations = register(
            self._anchor_image,
            image,
            anchor.pixels[rows],
            warps,
            guess,
            wanted & usable,
            self._config.tracking.window_px // 2,
            _MAX_REGISTRATION_PX,
            min_gradient,
        )
        found &= correlations > _SAME_PATCH
        pixels[~found] = guess[~found]
        return pixels, found

    def _still_wanted(self, pixels: Float, found: Bool, rejected: dict[str, int]) -> Bool:
        """Which tracks (N,) stay: found, where the image may be used, and not crowded together."""
        corners = self._config.corners
        found = passes(np.ones(len(found), dtype=bool), found, "flow", rejected)
        found = passes(found, self._pair.left.contains(pixels, corners.border_px), "edge", rejected)
        columns, rows = np.where(found[:, None], pixels, 0.0).round().astype(np.int64).T
        found = passes(found, self._allowed[rows, columns], "masked_left", rejected)
        alone = thinned(pixels, found, corners.cell_px, _MAX_TRACKS_PER_CELL)  # the oldest of a cell come first
        return passes(found, alone, "crowded", rejected)

    def _renew(self, image: Image, pixels: Float, has_depth: Bool) -> Float:
        """New corners (M, 2) where no track gives geometry, weak ones too where there are few."""
        settings = self._config.corners
        cell_px, border_px = settings.cell_px, settings.border_px
        new = find_corners(image, self._allowed, pixels, has_depth, cell_px, border_px, settings.min_response)
        admitted = settings.noise_factor * self._noise_sigma
        rows, columns = -(-image.shape[0] // cell_px), -(-image.shape[1] // cell_px)
        both = np.concatenate([pixels[has_depth], new])
        share = occupied_cells(both, cell_px, rows, columns).mean()
        if share >= settings.scarce_share or admitted >= settings.min_response:
            return new
        both = np.concatenate([pixels, new])
        settled = np.concatenate([has_depth, np.ones(len(new), dtype=bool)])
        weak = find_corners(image, self._allowed, both, settled, cell_px, border_px, admitted)
        return np.concatenate([new, weak])


def _checked(image: Image, camera: Camera) -> Image:
    """The image, contiguous; the kernels trust its type and size."""
    width, height = camera.size_px
    if image.dtype != np.uint8 or image.shape != (height, width):
        raise RigError(
            f"camera {camera.name}: image has shape {image.shape} and type {image.dtype}; the rig says grey, "
            f"({height}, {width}), uint8"
        )
    return np.ascontiguousarray(image)


def _allowed(camera: Camera) -> Bool:
    """Where (height, width) a camera's image may be used: its mask, or everywhere."""
    width, height = camera.size_px
    if camera.mask is None:
        return np.ones((height, width), dtype=bool)
    mask = cv2.imread(str(camera.mask), cv2.IMREAD_GRAYSCALE)
    if mask is None or mask.shape != (height, width):
        raise RigError(f"camera {camera.name}: mask {camera.mask} is no image of {width}x{height} pixels")
    return np.asarray(mask > 0)
