"""Stereo matching of one pair: left corners found in the right image and triangulated (section 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Bool, Float, Image
from graphvio.config import Config
from graphvio.frontend.lucas_kanade import Pyramid, register
from graphvio.frontend.slanted import align_slanted
from graphvio.frontend.stereo import epipolar_lines, epipolar_search, triangulate
from graphvio.rig import StereoPair

_SEARCH_CORRELATION = 0.6  # of undeformed patches; aligned ones must reach `StereoConfig.min_correlation`
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
        known = np.isfinite(inverse_depths)
        expected = np.where(known, np.clip(inverse_depths, 0.0, 1.0 / settings.min_depth_m), 0.0)
        guess, directions, usable = epipolar_lines(
            rays, expected, pair.right_T_left, pair.right.model_number, pair.right.intrinsics, pair.right.distortion
        )
        nearest = np.full(int((~known).sum()), 1.0 / settings.min_depth_m)
        guess[~known], usable[~known] = epipolar_search(
            left[0],
            right,
            pixels[~known],
            rays[~known],
            np.column_stack([np.zeros_like(nearest), nearest]),
            pair.right_T_left,
            pair.right.model_number,
            pair.right.intrinsics,
            pair.right.distortion,
            _SEARCH_CORRELATION,
        )
        found = _passes(np.ones(len(pixels), dtype=bool), usable, "search", rejected)
        half = tracking.window_px // 2
        matched, slopes, correlations, converged = align_slanted(left[0], right, pixels, guess, directions, half)
        close = np.linalg.norm(matched - guess, axis=1) <= np.where(known, _SEARCH_MARGIN_PX, _MAX_REFINEMENT_PX)
        found = _passes(found, converged & close, "alignment", rejected)
        found = _passes(found, correlations >= settings.min_correlation, "appearance", rejected)
        rows = np.flatnonzero(found)
        warps = np.eye(2) + directions[rows][:, :, None] * slopes[rows][:, None, :]
        _, returned = register(
            right, left[0], matched[rows], warps, pixels[rows],
            window_px=tracking.window_px, max_shift_px=tracking.max_forward_backward_px,
        )  # fmt: skip
        back = np.zeros(len(pixels), dtype=bool)
        back[rows] = returned
        return matched, _passes(found, back, "left_right", rejected)


def _passes(candidates: Bool, test: Bool, name: str, rejected: dict[str, int]) -> Bool:
    rejected[name] = int((candidates & ~test).sum())
    return np.asarray(candidates & test)
