"""Stereo matching of one pair: left corners found in the right image and triangulated, each test counted (section 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Bool, Float, Image
from graphvio.config import Config
from graphvio.frontend.lucas_kanade import Pyramid, build_pyramid, track
from graphvio.frontend.stereo import epipolar_search, triangulate
from graphvio.rig import StereoPair

_REFINEMENT_LEVELS = 2
_MAX_REFINEMENT_PX = 3.0
_SEARCH_MARGIN_PX = 6.0


@dataclass(frozen=True, eq=False)
class StereoMatches:
    """N left corners in the right image.

    Attributes:
        right: (N, 2) normalised coordinates in the right image.
        points: (N, 3) ``[x, y, 1/Z]`` in the left camera's frame.
        covariances: (N, 3, 3) of ``points``, for a pixel noise of 1 px.
        good: (N,) whether the match passed all tests; elsewhere the others mean nothing.
        rejected: test -> how many corners it threw out that had passed the tests before it.
    """

    right: Float
    points: Float
    covariances: Float
    good: Bool
    rejected: dict[str, int]


class StereoMatcher:
    """Finds the left image's corners in the right one."""

    def __init__(self, pair: StereoPair, config: Config, allowed_right: Bool) -> None:
        self._pair = pair
        self._config = config
        self._allowed = allowed_right

    def match(self, left: Pyramid, right: Image, pixels: Float, rays: Float, inverse_depths: Float) -> StereoMatches:
        """Search, refine, test, triangulate.

        Args:
            left: pyramid of the left image.
            right: image (height, width).
            pixels: (N, 2) corners in the left image.
            rays: (N, 2) their normalised coordinates.
            inverse_depths: (N,) expected, 1/m, NaN where nothing is known.
        """
        pair, settings = self._pair, self._config.stereo
        rejected: dict[str, int] = {}
        matched_px, good = self._search(left, right, pixels, rays, inverse_depths, rejected)
        columns, rows = np.where(good[:, None], matched_px, 0.0).round().astype(np.int64).T
        good = _passes(good, pair.right.contains(matched_px), "outside", rejected)
        height, width = self._allowed.shape
        seen = self._allowed[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
        good = _passes(good, seen, "masked", rejected)
        normalised, has_ray = pair.right.unproject(matched_px)
        good &= has_ray
        points, covariances, errors = triangulate(
            rays, normalised, pair.right_T_left, pair.left.focal_px, pair.right.focal_px
        )
        good = _passes(good, errors <= settings.max_epipolar_px, "epipolar", rejected)
        sigma = np.sqrt(covariances[:, 2, 2]) * self._config.motion.pixel_sigma_px
        in_range = (points[:, 2] <= 1.0 / settings.min_depth_m) & (points[:, 2] >= -3.0 * sigma)
        good = _passes(good, in_range, "depth_range", rejected)
        return StereoMatches(normalised, points, covariances, good, rejected)

    def _search(
        self, left: Pyramid, right: Image, pixels: Float, rays: Float, inverse_depths: Float, rejected: dict[str, int]
    ) -> tuple[Float, Bool]:
        """Pixels (N, 2) in the right image to sub-pixel precision, and whether appearance and the way back agree."""
        pair, settings, tracking = self._pair, self._config.stereo, self._config.tracking
        margin = _SEARCH_MARGIN_PX / (pair.right.focal_px * pair.baseline_m)
        nearest = 1.0 / settings.min_depth_m
        known = np.isfinite(inverse_depths)
        expected = np.where(known, inverse_depths, 0.0)
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
        found = _passes(np.ones(len(pixels), dtype=bool), found, "appearance", rejected)
        fine = np.zeros_like(pixels)
        returned = np.zeros(len(pixels), dtype=bool)
        fine[found], returned[found] = track(
            left,
            build_pyramid(right, _REFINEMENT_LEVELS),
            pixels[found],
            coarse[found],
            window_px=tracking.window_px,
            levels=_REFINEMENT_LEVELS,
            max_return_px=tracking.max_forward_backward_px,
        )
        returned &= np.linalg.norm(fine - coarse, axis=1) <= _MAX_REFINEMENT_PX
        return fine, _passes(found, returned, "left_right", rejected)


def _passes(candidates: Bool, test: Bool, name: str, rejected: dict[str, int]) -> Bool:
    rejected[name] = int((candidates & ~test).sum())
    return np.asarray(candidates & test)
