"""Corners of one stereo pair through time: tracked, renewed, matched left to right and triangulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from graphvio.arrays import Bool, Float, Image, Int
from graphvio.config import Config
from graphvio.errors import RigError
from graphvio.frontend.corners import find_corners
from graphvio.frontend.lucas_kanade import Pyramid, build_pyramid, track
from graphvio.frontend.stereo import epipolar_search, triangulate
from graphvio.rig import Camera, StereoPair

_MAX_TRACKS_PER_CELL = 2
_MAX_FLAT_FRAMES = 3  # then another corner of the cell gets its chance
_REFINEMENT_LEVELS = 2
_MAX_REFINEMENT_PX = 3.0
_SEARCH_MARGIN_PX = 6.0


@dataclass(frozen=True, eq=False)
class PairFrame:
    """What one pair saw at one instant: N tracks.

    Attributes:
        stamp_ns: of the frameset.
        ids: (N,) identities, increasing.
        pixels: (N, 2) in the left image.
        left: (N, 2) normalised coordinates in the left image.
        right: (N, 2) the same in the right image; meaningful where ``has_depth``.
        points: (N, 3) ``[x, y, 1/Z]`` in the left camera's frame, see `graphvio.frontend.stereo`.
        covariances: (N, 3, 3) of ``points``, for a pixel noise of 1 px.
        has_depth: (N,) whether the stereo match passed all its tests.
        flat_for: (N,) number of frames, up to this one, without depth.
        rejected: what each test of tracking and stereo matching threw out.
    """

    stamp_ns: int
    ids: Int
    pixels: Float
    left: Float
    right: Float
    points: Float
    covariances: Float
    has_depth: Bool
    flat_for: Int
    rejected: Mapping[str, int]

    def keep(self, rows: Bool) -> PairFrame:
        """The same with only some of its tracks."""
        columns = ("ids", "pixels", "left", "right", "points", "covariances", "has_depth", "flat_for")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})


class PairTracker:
    """Follows the corners of one stereo pair from frame to frame."""

    def __init__(self, pair: StereoPair, config: Config) -> None:
        self._pair = pair
        self._config = config
        self._allowed = _allowed(pair.left)
        self._next_id = 0
        self._last: PairFrame | None = None
        self._last_pyramid: Pyramid = ()

    def observe(self, stamp_ns: int, left: Image, right: Image, left_T_left_prev: Float | None) -> PairFrame:
        """Track, renew and triangulate.

        Args:
            stamp_ns: of these images.
            left: (height, width).
            right: (height, width).
            left_T_left_prev: (4, 4) predicted motion of points since the images before, or None if unknown.

        Raises:
            RigError: if an image is not what the rig says.
        """
        left, right = _checked(left, self._pair.left), _checked(right, self._pair.right)
        rejected: dict[str, int] = {}
        pyramid = build_pyramid(left, self._config.tracking.levels)
        kept, pixels, inverse_depth = self._follow(pyramid, left_T_left_prev, rejected)
        new = self._renew(left, pixels, np.isfinite(inverse_depth))
        ids = np.concatenate([kept.ids, self._next_id + np.arange(len(new))])
        flat_for = np.concatenate([kept.flat_for, np.zeros(len(new), dtype=np.int64)])
        self._next_id += len(new)
        pixels = np.concatenate([pixels, new])
        inverse_depth = np.concatenate([inverse_depth, np.full(len(new), np.nan)])
        rays, has_ray = self._pair.left.unproject(pixels)
        normalised_right, matched = self._match(pyramid, right, pixels, rays, inverse_depth, rejected)
        points, covariances, errors = triangulate(
            rays,
            normalised_right,
            self._pair.right_T_left,
            self._pair.left.focal_px,
            self._pair.right.focal_px,
        )
        matched &= has_ray
        on_line = errors <= self._config.stereo.max_epipolar_px
        near = points[:, 2] > 1.0 / self._config.stereo.min_depth_m
        behind = points[:, 2] < -3.0 * np.sqrt(covariances[:, 2, 2]) * self._config.motion.pixel_sigma_px
        rejected["epipolar"] = int((matched & ~on_line).sum())
        rejected["depth_range"] = int((matched & on_line & (near | behind)).sum())
        has_depth = matched & on_line & ~near & ~behind
        frame = PairFrame(
            stamp_ns=stamp_ns,
            ids=ids,
            pixels=pixels,
            left=rays,
            right=normalised_right,
            points=points,
            covariances=covariances,
            has_depth=has_depth,
            flat_for=np.where(has_depth, 0, flat_for + 1),
            rejected=rejected,
        ).keep(has_ray)
        self._last, self._last_pyramid = frame, pyramid
        return frame

    def drop(self, ids: Int) -> None:
        """Forget tracks, so that fresh corners may take their place."""
        if self._last is not None and len(ids):
            self._last = self._last.keep(~np.isin(self._last.ids, ids))

    def _follow(
        self, pyramid: Pyramid, left_T_left_prev: Float | None, rejected: dict[str, int]
    ) -> tuple[PairFrame, Float, Float]:
        """The tracks that are still there, as they were, with their pixels and predicted inverse depths (or NaN)."""
        last = self._last
        if last is None:
            return _NOTHING, np.zeros((0, 2)), np.zeros(0)
        last = last.keep(last.flat_for <= _MAX_FLAT_FRAMES)
        guess, inverse_depth = last.pixels, np.where(last.has_depth, last.points[:, 2], np.nan)
        if left_T_left_prev is not None:
            guess, inverse_depth = self._predict(last, left_T_left_prev)
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
        inside = self._pair.left.contains(pixels, self._config.corners.border_px)
        found &= inside
        whole = np.where(found[:, None], pixels, 0).round().astype(np.int64)
        found &= self._allowed[whole[:, 1], whole[:, 0]]
        found &= _thinned(pixels, found, self._config.corners.cell_px)
        return last.keep(found), pixels[found], inverse_depth[found]

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

    def _predict(self, last: PairFrame, left_T_left_prev: Float) -> tuple[Float, Float]:
        """Pixels (N, 2) and inverse depths (N,) of the tracks after a motion."""
        w = np.where(last.has_depth, np.maximum(last.points[:, 2], 0.0), 0.0)
        rays = np.column_stack([last.left, np.ones(len(w))])
        moved = rays @ left_T_left_prev[:3, :3].T + w[:, None] * left_T_left_prev[:3, 3]
        pixels, valid = self._pair.left.project(moved)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse_depth = np.where(last.has_depth & valid, w / moved[:, 2], np.nan)
        return np.where(valid[:, None], pixels, last.pixels), inverse_depth

    def _match(
        self,
        left: Pyramid,
        right: Image,
        pixels: Float,
        rays: Float,
        inverse_depth: Float,
        rejected: dict[str, int],
    ) -> tuple[Float, Bool]:
        """Normalised coordinates (N, 2) in the right image, and whether the match passed its tests (N,)."""
        pair, settings = self._pair, self._config.stereo
        margin = _SEARCH_MARGIN_PX / (pair.right.focal_px * pair.baseline_m)
        nearest = 1.0 / settings.min_depth_m
        known = np.isfinite(inverse_depth)
        expected = np.where(known, inverse_depth, 0.0)
        bounds = np.column_stack(
            [
                np.where(known, np.clip(expected - margin, 0.0, nearest), 0.0),
                np.where(known, np.clip(expected + margin, margin, nearest), nearest),
            ]
        )
        coarse, found = epipolar_search(
            left[0],
            right,
            pixels,
            rays,
            bounds,
            pair.right_T_left,
            pair.right.model_number,
            pair.right.intrinsics,
            pair.right.distortion,
            settings.min_correlation,
        )
        rejected["appearance"] = int((~found).sum())
        fine = np.zeros_like(pixels)
        good = np.zeros(len(pixels), dtype=bool)
        fine[found], good[found] = track(
            left,
            build_pyramid(right, _REFINEMENT_LEVELS),
            pixels[found],
            coarse[found],
            window_px=self._config.tracking.window_px,
            levels=_REFINEMENT_LEVELS,
            max_return_px=self._config.tracking.max_forward_backward_px,
        )
        good &= np.linalg.norm(fine - coarse, axis=1) <= _MAX_REFINEMENT_PX
        rejected["left_right"] = int((found & ~good).sum())
        normalised, has_ray = pair.right.unproject(fine)
        return normalised, good & has_ray & pair.right.contains(fine)


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


_NOTHING = PairFrame(
    stamp_ns=0,
    ids=np.zeros(0, dtype=np.int64),
    pixels=np.zeros((0, 2)),
    left=np.zeros((0, 2)),
    right=np.zeros((0, 2)),
    points=np.zeros((0, 3)),
    covariances=np.zeros((0, 3, 3)),
    has_depth=np.zeros(0, dtype=bool),
    flat_for=np.zeros(0, dtype=np.int64),
    rejected={},
)
