"""Corners of one stereo pair through time: tracked, registered, renewed, matched left to right and triangulated."""

from __future__ import annotations

import cv2
import numpy as np

from graphvio.arrays import Bool, Float, Image, Int
from graphvio.config import Config
from graphvio.errors import RigError
from graphvio.frontend.corners import find_corners
from graphvio.frontend.lucas_kanade import Pyramid, build_pyramid, register, track
from graphvio.frontend.matching import StereoMatcher
from graphvio.frontend.stopwatch import Stopwatch
from graphvio.frontend.tracks import PairFrame
from graphvio.rig import Camera, StereoPair

_MAX_TRACKS_PER_CELL = 2
_MAX_FLAT_FRAMES = 3  # then another corner of the cell gets its chance
_MAX_REGISTRATION_PX = 2.0


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
        self._anchor_rays: list[Float] = []  # of each of its pixels and of the ones to the right and below

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
        pyramid = build_pyramid(left, self._config.tracking.levels)
        watch.lap("pyramid")
        rejected: dict[str, int] = {}
        kept, pixels, inverse_depths = self._follow(pyramid, left_T_left_prev, rejected)
        watch.lap("flow")
        if left_T_left_anchor is not None:
            pixels = self._register(left, kept.ids, pixels, left_T_left_anchor)
        watch.lap("register")
        new = self._renew(left, pixels, np.isfinite(inverse_depths))
        watch.lap("corners")
        pixels = np.concatenate([pixels, new])
        rays, has_ray = self._pair.left.unproject(pixels)
        inverse_depths = np.concatenate([inverse_depths, np.full(len(new), np.nan)])
        matches = self._matcher.match(pyramid, right, pixels, rays, inverse_depths)
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
        self._anchor_rays = [self._pair.left.unproject(self._last.pixels + step)[0] for step in beside]

    def drop(self, ids: Int) -> None:
        """Forget tracks, so that fresh corners may take their place."""
        if len(ids):
            self._last = self._last.keep(~np.isin(self._last.ids, ids))

    def _follow(
        self, pyramid: Pyramid, left_T_left_prev: Float | None, rejected: dict[str, int]
    ) -> tuple[PairFrame, Float, Float]:
        """The tracks that are still there, as they were, with their pixels and predicted inverse depths (or NaN)."""
        last = self._last.keep(self._last.flat_for <= _MAX_FLAT_FRAMES)
        if not len(last.ids):
            return last, np.zeros((0, 2)), np.zeros(0)
        guess, inverse_depths = last.pixels, np.where(last.has_depth, last.points[:, 2], np.nan)
        if left_T_left_prev is not None:
            guess, inverse_depths = self._predict(last, left_T_left_prev)
        settings = self._config.tracking
        pixels, found = track(
            self._last_pyramid,
            pyramid,
            last.pixels,
            guess,
            window_px=settings.window_px,
            levels=settings.levels,
            max_return_px=settings.max_forward_backward_px,
        )
        rejected["flow"] = int((~found).sum())
        found &= self._pair.left.contains(pixels, self._config.corners.border_px)
        whole = np.where(found[:, None], pixels, 0).round().astype(np.int64)
        found &= self._allowed[whole[:, 1], whole[:, 0]]
        found &= _thinned(pixels, found, self._config.corners.cell_px)
        return last.keep(found), pixels[found], inverse_depths[found]

    def _predict(self, last: PairFrame, left_T_left_prev: Float) -> tuple[Float, Float]:
        """Pixels (N, 2) and inverse depths (N,) of the tracks after a motion."""
        w = np.where(last.has_depth, np.maximum(last.points[:, 2], 0.0), 0.0)
        moved = _moved(left_T_left_prev, last.left, w)
        pixels, valid = self._pair.left.project(moved)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse_depths = np.where(last.has_depth & valid, w / moved[:, 2], np.nan)
        return np.where(valid[:, None], pixels, last.pixels), inverse_depths

    def _register(self, image: Image, ids: Int, pixels: Float, left_T_left_anchor: Float) -> Float:
        """Pixels (N, 2) of the tracks, put right by the patches that they had at the anchor.

        Following a point from frame to frame adds up the errors of each step. The anchor's patch, deformed as the
        predicted motion would have it, shows where the point really is.
        """
        if self._anchor_image is None:
            return pixels
        _, at_anchor, now = np.intersect1d(self._anchor.ids, ids, assume_unique=True, return_indices=True)
        rows = self._anchor.has_depth[at_anchor]
        at_anchor, now = at_anchor[rows], now[rows]
        anchor = self._anchor
        w = np.maximum(anchor.points[at_anchor, 2], 0.0)
        camera = self._pair.left
        ahead = [_moved(left_T_left_anchor, rays[at_anchor], w) for rays in self._anchor_rays]
        (at, ok), (right, ok_right), (below, ok_below) = (camera.project(points) for points in ahead)
        target_by_source = np.stack([right - at, below - at], axis=-1)
        usable = ok & ok_right & ok_below & (np.linalg.det(target_by_source) > 0.1)
        at_anchor, now = at_anchor[usable], now[usable]
        registered = pixels.copy()
        registered[now], _ = register(
            self._anchor_image,
            image,
            anchor.pixels[at_anchor],
            np.linalg.inv(target_by_source[usable]),
            pixels[now],
            window_px=self._config.tracking.window_px,
            max_shift_px=_MAX_REGISTRATION_PX,
        )
        return registered

    def _renew(self, image: Image, pixels: Float, has_depth: Bool) -> Float:
        """New corners (M, 2) where no track gives geometry."""
        settings = self._config.corners
        return find_corners(
            image,
            self._allowed,
            pixels,
            has_depth,
            settings.cell_px,
            settings.border_px,
            settings.min_response,
        )


def _moved(motion: Float, rays: Float, inverse_depths: Float) -> Float:
    """Points (N, 3) on rays (N, 2), seen after a motion (4, 4), up to scale: in units of the depth before it."""
    ahead = np.column_stack([rays, np.ones(len(rays))])
    return np.asarray(ahead @ motion[:3, :3].T + inverse_depths[:, None] * motion[:3, 3])


def _thinned(pixels: Float, found: Bool, cell_px: int) -> Bool:
    """Of the found tracks that have gathered in one cell, only the oldest (lowest id comes first) stay."""
    cells = (pixels // cell_px).astype(np.int64)
    keep = np.zeros(len(pixels), dtype=bool)
    taken: dict[tuple[int, int], int] = {}
    for i in np.flatnonzero(found):
        cell = (int(cells[i, 0]), int(cells[i, 1]))
        taken[cell] = taken.get(cell, 0) + 1
        keep[i] = taken[cell] <= _MAX_TRACKS_PER_CELL
    return keep


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
