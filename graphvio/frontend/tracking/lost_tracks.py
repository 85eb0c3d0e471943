"""Where tracks are that a wrong prediction has lost: by those that were found, or by the whole image."""

import cv2
import numpy as np

from graphvio.arrays import Bool, Float, Image

_MIN_TRACKS = 8
_MIN_INLIERS, _MIN_INLIER_SHARE = 8, 0.4
_MAX_ERROR_PX = 4.0  # of tracks through blurred images
_MIN_INVERSE_DEPTH = 1e-3  # 1/m, of a point at infinity
_ITERATIONS = 200


def motion_of_found(rays: Float, inverse_depths: Float, seen: Float, found: Bool, focal_px: float) -> Float | None:
    """Estimate the motion of points in a camera since the images before, by 3-point poses of random triples.

    Args:
        rays: (N, 2) normalised coordinates then.
        inverse_depths: (N,) then, 1/m, 0 where unknown.
        seen: (N, 2) normalised coordinates now.
        found: (N,) which tracks are seen.
        focal_px: of the camera.

    Returns:
        ``now_T_then`` (4, 4), or None where too few tracks move as one.
    """
    if found.sum() < _MIN_TRACKS:
        return None
    depths = 1.0 / np.maximum(inverse_depths[found], _MIN_INVERSE_DEPTH)
    points = np.column_stack([rays[found], np.ones(len(depths))]) * depths[:, None]
    is_solved, rotation, translation, inliers = cv2.solvePnPRansac(
        points, seen[found], np.eye(3), None, iterationsCount=_ITERATIONS,
        reprojectionError=_MAX_ERROR_PX / focal_px, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not is_solved or inliers is None or len(inliers) < max(_MIN_INLIERS, _MIN_INLIER_SHARE * found.sum()):
        return None
    now_T_then = np.eye(4)
    now_T_then[:3, :3], now_T_then[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
    return now_T_then


def image_shift(before: Image, now: Image) -> Float:
    """Measure the shift (2,) in pixels of an image's content by phase correlation.

    A turn about an axis across the view shifts all of the content alike. Of images that have little in common it may be
    any shift.

    Args:
        before: (height, width) of a small image, such as the coarsest level of a pyramid.
        now: (height, width).
    """
    height, width = before.shape
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(before.astype(np.float32), now.astype(np.float32), window)
    return np.array(shift)
