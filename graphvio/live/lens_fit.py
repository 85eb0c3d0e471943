"""Approximation of OpenCV's rational lens models by those of graphvio, and correction of images for the difference.

Factory calibrations of 8 or 14 coefficients are rational models, which no model of 5 coefficients matches: for a real
camera, the nearest one is off by 0.1 px in most of the image and by more than half a pixel in its corners. So images
are resampled to remove that difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from graphvio.arrays import AnyArray, Float, Image
from graphvio.cameras import MODEL_NAMES, project_points, unproject_pixels
from graphvio.errors import RigError

_MODELS = ("radial-tangential", "equidistant")
_EXACT_PX = 0.02  # less than the error of any calibration
_MAX_ERROR_PX = 8.0
_GRID = (32, 20)
_SAME_PX = 0.01
_MIN_SHARE = 0.95
_STEPS = 100
_OUTSIDE = -10.0
_MARGIN_PX = 1.0


@dataclass(frozen=True, eq=False)
class FittedLens:
    """A lens with one of graphvio's models."""

    model: str  # name of the model
    intrinsics: Float  # (4,), pixels
    distortion: Float  # (5,)
    error_px: float = 0.0  # maximum difference between the models, by which images are resampled
    maps: tuple[AnyArray, AnyArray] | None = None  # of `cv2.remap`, or None where the model is exact

    def corrected(self, image: Image) -> Image:
        """Return the image (height, width) that this lens would have made."""
        if self.maps is None:
            return image
        moved = cv2.remap(image, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return moved.astype(np.uint8, copy=False)


def fit_rational(intrinsics: Float, coefficients: Float, size_px: tuple[int, int], where: str) -> FittedLens:
    """Fit a radial-tangential or an equidistant model, whichever is nearer, to OpenCV's of up to 14 coefficients.

    Args:
        intrinsics: (4,) ``[fx, fy, cx, cy]``, pixels.
        coefficients: ``[k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tx, ty]`` or fewer.
        size_px: (width, height) of the image.
        where: name of the camera, for messages.

    Raises:
        RigError: if neither model is near enough.
    """
    coefficients = np.asarray(coefficients, dtype=np.float64)
    if not coefficients[5:].any():
        return FittedLens("radial-tangential", intrinsics, np.pad(coefficients[:5], (0, max(5 - len(coefficients), 0))))
    matrix = np.array([[intrinsics[0], 0.0, intrinsics[2]], [0.0, intrinsics[1], intrinsics[3]], [0.0, 0.0, 1.0]])
    points, pixels = _sample_points(matrix, coefficients, size_px)
    best = min((_fit(model, intrinsics, points, pixels) for model in _MODELS), key=lambda fit: fit.error_px)
    if len(points) < _MIN_SHARE * _GRID[0] * _GRID[1] or best.error_px > _MAX_ERROR_PX:
        raise RigError(
            f"{where}: the factory's lens model of {len(coefficients)} coefficients is like none of "
            f"{', '.join(_MODELS)} (off by {best.error_px:.1f} px); calibrate the camera with Kalibr, and give the "
            "rig file"
        )
    if best.error_px < _EXACT_PX:
        return best
    maps = _maps(best, matrix, coefficients, size_px)
    return FittedLens(best.model, best.intrinsics, best.distortion, best.error_px, maps)


def _sample_points(matrix: Float, coefficients: Float, size_px: tuple[int, int]) -> tuple[Float, Float]:
    """Return points (N, 3) in the camera's frame whose pixels (N, 2) cover the image from border to border."""
    pixels = _grid(np.linspace(0, size_px[0] - 1, _GRID[0]), np.linspace(0, size_px[1] - 1, _GRID[1]))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _STEPS, 1e-12)
    rays = cv2.undistortPoints(pixels[:, None], matrix, coefficients, criteria=criteria).reshape(-1, 2)
    points: Float = np.column_stack([rays, np.ones(len(rays))]).astype(np.float64)
    again = _projected(points, matrix, coefficients)
    has_converged = np.linalg.norm(again - pixels, axis=1) < _SAME_PX  # the inverse is iterative
    return points[has_converged], again[has_converged]


def _fit(model: str, intrinsics: Float, points: Float, pixels: Float) -> FittedLens:
    from scipy.optimize import least_squares

    free = 5 if model == "radial-tangential" else 4

    def residuals(parameters: Float) -> Float:
        distortion = np.pad(parameters[4:], (0, 5 - free))
        projected, _ = project_points(MODEL_NAMES[model], parameters[:4], distortion, points)
        return np.asarray((projected - pixels).ravel())

    start = np.concatenate([intrinsics, np.zeros(free)])
    found = least_squares(residuals, start, x_scale=np.concatenate([np.full(4, 100.0), np.ones(free)])).x
    error_px = np.linalg.norm(residuals(found).reshape(-1, 2), axis=1).max(initial=0.0)
    return FittedLens(model, found[:4].copy(), np.pad(found[4:], (0, 5 - free)), float(error_px))


def _maps(lens: FittedLens, matrix: Float, coefficients: Float, size_px: tuple[int, int]) -> tuple[AnyArray, AnyArray]:
    """Return where each pixel of the fitted lens is in the camera's own image, in `cv2.remap`'s fastest format."""
    pixels = _grid(np.arange(size_px[0], dtype=np.float64), np.arange(size_px[1], dtype=np.float64))
    rays, valid = unproject_pixels(MODEL_NAMES[lens.model], lens.intrinsics, lens.distortion, pixels)
    own = _projected(np.column_stack([rays, np.ones(len(rays))]), matrix, coefficients)
    # Outside its field of view, the lens model folds back into the image.
    visible = valid & (np.linalg.norm(own - pixels, axis=1) <= lens.error_px + _MARGIN_PX)
    # Border pixels map up to a fraction of a pixel outside of the image; black there would be an edge that never moves.
    own = np.clip(own, 0.0, np.array(size_px) - 1.0)
    own[~visible] = _OUTSIDE
    x, y = own.astype(np.float32).reshape(size_px[1], size_px[0], 2).transpose(2, 0, 1)
    whole, fraction = cv2.convertMaps(np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.CV_16SC2)
    return whole, fraction


def _projected(points: Float, matrix: Float, coefficients: Float) -> Float:
    return np.asarray(cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)[0].reshape(-1, 2))


def _grid(x: AnyArray, y: AnyArray) -> Float:
    columns, rows = np.meshgrid(x, y)
    return np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
