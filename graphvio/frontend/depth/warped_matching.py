"""Matching between cameras that point in different directions: patches are warped as the other camera sees them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphvio.arrays import AnyArray, Bool, Float, Image
from graphvio.cameras import fold_radius
from graphvio.config import Config
from graphvio.frontend.depth.matching import StereoMatcher, TwoCameras
from graphvio.frontend.depth.motion_stereo import PRIOR_INVERSE_DEPTH
from graphvio.frontend.depth.prediction import around, patch_deviation_px, predict_warps
from graphvio.frontend.depth.stereo import (
    FINE_STEPS,
    HALF_COARSE_PATCH,
    HALF_PATCH,
    MAX_STEPS,
    empty_patch,
    epipolar_lines,
    is_ambiguous,
    nearest_in_reach,
    scan_curve,
)
from graphvio.frontend.depth.tracks import passes
from graphvio.frontend.imaging.lucas_kanade import Pyramid, register
from graphvio.frontend.imaging.sampling import pixel_words
from graphvio.kernels import kernel

_SEARCH_CORRELATION = 0.7
_MAX_SHIFT_PX = 4.0
_PREDICTED_PX = 0.5
_MAX_PARALLAX_RAD = 0.2  # between the rays of both cameras; beyond it errors are several times the usual noise


class WarpedMatcher(StereoMatcher):
    """Matcher of one camera's corners in another one that may point in any direction.

    A patch is warped by the cameras' relative rotation and their lenses, for a surface that faces the camera. Points
    that are so near that the cameras see them from too different directions are left out.

    Args:
        pair: the camera that has the corners as the left one, and the other one.
        config: configuration of all stages.
    """

    def __init__(self, pair: TwoCameras, config: Config) -> None:
        width, height = pair.right.size_px
        super().__init__(pair, config, np.ones((height, width), dtype=bool))

    def _search(
        self, left: Pyramid, right: Pyramid, pixels: Float, rays: Float, inverse_depths: Float, slopes: Float,
        min_gradient: float, rejected: dict[str, int],
    ) -> tuple[Float, Float, Bool]:  # fmt: skip
        """Find sub-pixel matches (N, 2) in the right image, no slopes (N, 2), and whether appearance agrees (N,)."""
        pair, settings, tracking = self._pair, self._config.stereo, self._config.tracking
        camera = (pair.right_T_left, pair.right.model_number, pair.right.intrinsics, pair.right.distortion)
        nearest, known = 1.0 / settings.min_depth_m, np.isfinite(inverse_depths)
        expected = np.where(known, np.clip(inverse_depths, 0.0, nearest), PRIOR_INVERSE_DEPTH)
        half = tracking.window_px // 2
        step_px = patch_deviation_px(half)
        beside = around(pixels, step_px)
        rays_beside = pair.left.unproject(beside.reshape(-1, 2))[0].reshape(beside.shape)
        warps, _, usable = predict_warps(rays_beside, np.tile(expected, (5, 1)), step_px, *camera)
        searched = np.flatnonzero(~known & usable)
        seen = usable & known
        if len(searched):
            expected[searched], seen[searched] = _warped_search(
                left[:2], right[:2], pixels[searched], rays[searched], warps[searched], nearest, *camera
            )
        warps, bends, usable = predict_warps(rays_beside, np.tile(expected, (5, 1)), step_px, *camera)
        guess, _, in_reach = epipolar_lines(rays, expected, *camera)
        # A surface that does not face the camera looks less like its patch the more the viewing directions differ.
        is_alike = float(np.linalg.norm(pair.right_T_left[:3, 3])) * expected < _MAX_PARALLAX_RAD
        found = passes(np.ones(len(pixels), dtype=bool), seen & usable & in_reach & is_alike, "search", rejected)
        matched, registered, localised, correlations = register(
            pixel_words(left[0]), right[0], pixels, warps, bends, guess, found, half, _MAX_SHIFT_PX, min_gradient, True
        )
        found = passes(found, registered, "alignment", rejected)
        found = passes(found, correlations >= settings.min_correlation, "appearance", rejected)
        return matched, np.zeros((len(pixels), 2)), passes(found, localised, "corner", rejected)


@kernel
def _warped_search(
    left: Sequence[Image], right: Sequence[Image], pixels: Float, rays: Float, warps: Float, nearest: float,
    right_T_left: Float, model: int, intrinsics: Float, distortion: Float,
) -> tuple[Float, Bool]:  # fmt: skip
    """Search the right image for warped patches along their epipolar curves, to the pixel, see `epipolar_search`.

    Args:
        left: image (height, width), and the same in half the size.
        right: image (height, width), and the same in half the size.
        pixels: (N, 2) corners in the left image.
        rays: (N, 2) their normalised coordinates.
        warps: (N, 2, 2) derivative of the left pixel with respect to the right pixel.
        nearest: largest inverse depth, 1/m.
        right_T_left: (4, 4) transform from the left to the right camera.
        model: number of the right camera's model.
        intrinsics: (4,) ``fx, fy, cx, cy`` of the right camera, pixels.
        distortion: (8,) distortion coefficients of the right camera.

    Returns:
        Inverse depths (N,), 1/m, and whether there is one clear best place (N,).
    """
    n = len(pixels)
    depths, found = np.zeros(n), np.zeros(n, dtype=np.bool_)
    coarse, fine, scores = empty_patch(HALF_COARSE_PATCH), empty_patch(HALF_PATCH), np.empty(MAX_STEPS + 1)
    camera = (right_T_left, model, intrinsics, distortion, fold_radius(model, distortion))
    for i in range(n):
        x, y, w0 = pixels[i, 0], pixels[i, 1], 0.0
        if not (
            _warped_patch(left[1], 0.5 * x, 0.5 * y, warps[i], coarse) and _warped_patch(left[0], x, y, warps[i], fine)
        ):
            continue
        w1 = nearest_in_reach(rays[i], w0, nearest, camera)
        best, steps = scan_curve(right[1], 0.5, coarse, rays[i], w0, w1, camera, scores)
        if steps == 0 or scores[best] < _SEARCH_CORRELATION or is_ambiguous(scores[: steps + 1], best):
            continue
        step = (w1 - w0) / steps
        w0, w1 = w0 + (best - FINE_STEPS) * step, w0 + (best + FINE_STEPS) * step
        best, steps = scan_curve(right[0], 1.0, fine, rays[i], w0, w1, camera, scores)
        if steps == 0 or scores[best] < _SEARCH_CORRELATION:
            continue
        depths[i], found[i] = max(w0 + (w1 - w0) * best / steps, 0.0), True
    return depths, found


@kernel
def _warped_patch(image: Image, x: float, y: float, warp: Float, patch: AnyArray) -> bool:
    """Fill a warped patch around (x, y) with zero mean and unit norm; False at the edge or without contrast."""
    half, (height, width) = len(patch) // 2, image.shape
    total = 0.0
    for j in range(len(patch)):
        for i in range(len(patch)):
            u = x + warp[0, 0] * (i - half) + warp[0, 1] * (j - half)
            v = y + warp[1, 0] * (i - half) + warp[1, 1] * (j - half)
            if not (0.0 <= u < width - 1 and 0.0 <= v < height - 1):
                return False
            c, r = int(u), int(v)
            a, b = u - c, v - r
            upper = image[r, c] * (1.0 - a) + image[r, c + 1] * a
            value = upper * (1.0 - b) + (image[r + 1, c] * (1.0 - a) + image[r + 1, c + 1] * a) * b
            patch[j, i] = value
            total += value
    mean, norm2 = total / patch.size, 0.0
    for j in range(len(patch)):
        for i in range(len(patch)):
            patch[j, i] -= mean
            norm2 += patch[j, i] * patch[j, i]
    if norm2 < 1e-6:
        return False
    norm = np.sqrt(norm2)
    for j in range(len(patch)):
        for i in range(len(patch)):
            patch[j, i] /= norm
    return True
