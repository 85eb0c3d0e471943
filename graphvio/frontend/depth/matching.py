"""Stereo matching of one pair: left corners found in the right image and triangulated (section 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.config import Config
from graphvio.frontend.depth.prediction import stereo_warps
from graphvio.frontend.depth.slanted import align_slanted
from graphvio.frontend.depth.stereo import epipolar_lines, epipolar_search, triangulate
from graphvio.frontend.depth.tracks import passes, usable_at
from graphvio.frontend.imaging.lucas_kanade import Pyramid, register
from graphvio.frontend.imaging.sampling import pixel_words
from graphvio.rig import Camera

_SEARCH_CORRELATION = 0.6  # of undeformed patches; aligned ones must reach `StereoConfig.min_correlation`
_MAX_REFINEMENT_PX = 3.0
_SEARCH_MARGIN_PX = 6.0
_PREDICTED_PX = 0.5
_MIN_ALIKE = 0.75  # share of new corners with a similar place on their epipolar lines; below it, others are tried
_SHIFTS_PX = (-8.0, -6.0, -4.0, -2.0, 2.0, 4.0, 6.0, 8.0)
# Places that look like the corner by chance are as many on any line, often for half of the corners. How many more the
# shifted lines need: in number, in sigmas of a count by chance, and over the excess of the calibration's lines.
_MIN_MORE, _MIN_SIGMAS, _MIN_RATIO = 10, 5.0, 2.0


@dataclass(frozen=True, eq=False)
class StereoMatches:
    """Matches of N left corners in the right image.

    Attributes:
        right: (N, 2) normalised coordinates in the right image.
        right_pixels: (N, 2) the same, in pixels.
        points: (N, 3) ``[x, y, 1/Z]`` in the left camera's frame.
        covariances: (N, 3, 3) of ``points``, for a pixel noise of 1 px.
        slopes: (N, 2) derivative of the shift along the epipolar line with respect to the left pixel.
        good: (N,) whether the match passed all tests; elsewhere the other values mean nothing.
        rejected: test -> number of corners that failed it, of those that had passed the tests before it.
    """

    right: Float
    right_pixels: Float
    points: Float
    covariances: Float
    slopes: Float
    good: Bool
    rejected: dict[str, int]


class TwoCameras(Protocol):
    """Two cameras between which corners are matched: a stereo pair, or others with overlapping views."""

    @property
    def left(self) -> Camera:
        """The camera that has the corners."""

    @property
    def right(self) -> Camera:
        """The camera in which they are matched."""

    @property
    def right_T_left(self) -> Float:
        """Transform (4, 4) from the left to the right camera."""


class StereoMatcher:
    """Matcher of one pair's left corners in the right image."""

    def __init__(self, pair: TwoCameras, config: Config, allowed_right: Bool) -> None:
        self._pair = pair
        self._config = config
        self._allowed = allowed_right
        self._margin_px = 0.0  # by how much the calibration's epipolar lines may be off
        self._shift_px: Float = np.zeros(2)  # of all epipolar lines, where the images show that they are off

    def allow(self, allowed_right: Bool) -> None:
        """Set where (height, width) the newest right image may be used for matches."""
        self._allowed = allowed_right

    def recalibrate(self, pair: TwoCameras, epipolar_margin_px: float) -> None:
        """Use another calibration of the cameras from now on, whose epipolar lines may be off by a margin."""
        self._pair = pair
        self._margin_px = epipolar_margin_px
        self._shift_px = np.zeros(2)

    @property
    def are_lines_off(self) -> bool:
        """Whether corners are matched on lines beside the epipolar lines of the calibration."""
        return bool(self._shift_px.any())

    def match(
        self,
        left: Pyramid,
        right: Pyramid,
        pixels: Float,
        rays: Float,
        inverse_depths: Float,
        slopes: Float,
        min_gradient: float,
    ) -> StereoMatches:
        """Match corners left to right, test the matches and triangulate them.

        Args:
            left: pyramid of the left image, of two levels at least.
            right: pyramid of the right image, of two levels at least.
            pixels: (N, 2) corners in the left image.
            rays: (N, 2) their normalised coordinates.
            inverse_depths: (N,) expected inverse depths, 1/m, NaN where unknown.
            slopes: (N, 2) expected slopes, zero where unknown.
            min_gradient: smallest rms gradient of a right patch along its weaker direction, grey levels per pixel.
        """
        pair, settings = self._pair, self._config.stereo
        rejected: dict[str, int] = {}
        matched_px, slopes, good = self._search(
            left, right, pixels, rays, inverse_depths, slopes, min_gradient, rejected
        )
        inside, usable = usable_at(matched_px, self._allowed, 0.0)
        good = passes(good, inside, "outside", rejected)
        good = passes(good, usable, "masked", rejected)
        normalised, has_ray = pair.right.unproject(matched_px)
        good &= has_ray
        points, covariances, errors = triangulate(
            rays, normalised, pair.right_T_left, pair.left.focal_px, pair.right.focal_px
        )
        max_error_px = settings.max_epipolar_px + self._margin_px + np.sqrt(0.5) * np.linalg.norm(self._shift_px)
        good = passes(good, errors <= max_error_px, "epipolar", rejected)
        sigma = np.sqrt(np.maximum(covariances[:, 2, 2], 0.0)) * self._config.motion.pixel_sigma_px
        in_range = (points[:, 2] <= 1.0 / settings.min_depth_m) & (points[:, 2] >= -3.0 * sigma)
        good = passes(good, in_range, "depth_range", rejected)
        return StereoMatches(normalised, matched_px, points, covariances, slopes, good, rejected)

    def _search(
        self, left: Pyramid, right: Pyramid, pixels: Float, rays: Float, inverse_depths: Float, slopes: Float,
        min_gradient: float, rejected: dict[str, int],
    ) -> tuple[Float, Float, Bool]:  # fmt: skip
        """Find sub-pixel matches (N, 2) in the right image, slopes (N, 2), and whether appearance agrees (N,)."""
        pair, settings, tracking = self._pair, self._config.stereo, self._config.tracking
        known = np.isfinite(inverse_depths)
        nearest = 1.0 / settings.min_depth_m
        expected = np.where(known, np.minimum(np.maximum(inverse_depths, 0.0), nearest), 0.0)
        camera = _projection(pair)
        unknown = np.flatnonzero(~known)
        seen = np.ones(len(pixels), dtype=bool)
        if len(unknown):
            bounds = np.zeros((len(unknown), 2))
            bounds[:, 1] = nearest
            expected[unknown], seen[unknown] = self._search_lines(left, right, pixels[unknown], rays[unknown], bounds)
        guess, directions, in_reach = epipolar_lines(rays, expected, *camera)
        guess += self._shift_px
        found = passes(np.ones(len(pixels), dtype=bool), seen & in_reach, "search", rejected)
        half = tracking.window_px // 2
        warps, bends = stereo_warps(rays, expected, pair.right_T_left, *_lens(pair.left), *_lens(pair.right))
        right_words = pixel_words(right[0])
        matched, slopes, correlations, converged = align_slanted(
            left[0], right[0], right_words, pixels, guess, directions, warps, bends, slopes, known, found, half
        )
        shift = np.hypot(matched[:, 0] - guess[:, 0], matched[:, 1] - guess[:, 1])
        close = shift <= np.where(known, _SEARCH_MARGIN_PX, _MAX_REFINEMENT_PX + self._margin_px)
        found = passes(found, converged & close, "alignment", rejected)
        found = passes(found, correlations >= settings.min_correlation, "appearance", rejected)
        # A match where motion and earlier depth predict it needs no other check.
        unchecked = np.flatnonzero(found & ~(known & (shift < _PREDICTED_PX)))
        localised, returned = np.ones(len(found), dtype=bool), np.ones(len(found), dtype=bool)
        if len(unchecked):
            _, returned[unchecked], localised[unchecked], _ = register(
                right_words,
                left[0],
                matched[unchecked],
                warps[unchecked] + directions[unchecked, :, None] * slopes[unchecked, None, :],
                np.zeros((len(unchecked), 2, 2)),
                pixels[unchecked],
                np.ones(len(unchecked), dtype=bool),
                half,
                tracking.max_forward_backward_px,
                min_gradient,
                True,
            )
        found = passes(found, localised, "corner", rejected)
        return matched, slopes, passes(found, returned, "left_right", rejected)

    def _search_lines(
        self, left: Pyramid, right: Pyramid, pixels: Float, rays: Float, bounds: Float
    ) -> tuple[Float, Bool]:
        """Search corners (N,) along their epipolar lines: inverse depths (N,), and whether they were found (N,).

        If the calibration may be wrong and many lines have no place that looks like the corner, shifted lines are tried
        as well. A shift with which clearly more lines have one is kept until the next calibration.
        """
        depths, found, alike = self._found_along(self._shift_px, left, right, pixels, rays, bounds)
        if not self._margin_px or alike.mean() >= _MIN_ALIKE:
            return depths, found
        _, directions, _ = epipolar_lines(rays, np.zeros(len(rays)), *_projection(self._pair))
        along = directions.sum(axis=0)
        across = np.array([-along[1], along[0]]) / max(np.linalg.norm(along), 1e-9)
        tried = [(self._shift_px, (depths, found, alike))]
        for distance_px in _SHIFTS_PX:
            shift_px = distance_px * across
            tried.append((shift_px, self._found_along(shift_px, left, right, pixels, rays, bounds)))
        counts = np.array([each.sum() for _, (_, _, each) in tried])
        by_chance = float(np.median(counts))
        sigma = np.sqrt(by_chance * (1.0 - by_chance / len(pixels)))
        best = int(np.argmax(counts))
        here, there = counts[0] - by_chance, counts[best] - by_chance
        if there >= max(_MIN_MORE, _MIN_SIGMAS * sigma) + _MIN_RATIO * max(here, 0.0):
            self._shift_px, (depths, found, _) = tried[best]
        return depths, found

    def _found_along(
        self, shift_px: Float, left: Pyramid, right: Pyramid, pixels: Float, rays: Float, bounds: Float
    ) -> tuple[Float, Bool, Bool]:
        """Search along epipolar lines that are shifted by (2,) pixels, see `epipolar_search`."""
        right_T_left, model, intrinsics, distortion = _projection(self._pair)
        shifted = intrinsics + np.concatenate([np.zeros(2), shift_px])
        return epipolar_search(
            left[:2], right[:2], pixels, rays, bounds, right_T_left, model, shifted, distortion, _SEARCH_CORRELATION
        )


def _lens(camera: Camera) -> tuple[int, Float, Float]:
    return camera.model_number, camera.intrinsics, camera.distortion


def _projection(pair: TwoCameras) -> tuple[Float, int, Float, Float]:
    """Return transform, model, intrinsics and distortion that project points of the left camera to the right image."""
    return pair.right_T_left, *_lens(pair.right)
