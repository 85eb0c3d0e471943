"""Where to search for tracks that a wrong prediction has lost: by the found tracks, or by the shift of the image."""

import cv2
import numpy as np

from graphvio.arrays import Bool, Float, Image

_MIN_TRACKS = 8
_MIN_INLIERS, _MIN_INLIER_SHARE = 8, 0.4
_MAX_ERROR_PX = 4.0  # reprojection error, of tracks through blurred images
_MIN_INVERSE_DEPTH = 1e-3  # 1/m, of points at infinity or of unknown depth
_ITERATIONS = 200


def motion_of_found(rays: Float, inverse_depths: Float, seen: Float, found: Bool, focal_px: float) -> Float | None:
    """Estimate the motion of points in a camera since the previous image, by RANSAC with 3-point poses.

    Args:
        rays: (N, 2) normalised coordinates in the previous image.
        inverse_depths: (N,) there, 1/m, 0 where unknown.
        seen: (N, 2) normalised coordinates now.
        found: (N,) which tracks were found now.
        focal_px: focal length of the camera.

    Returns:
        ``now_T_then`` (4, 4), or None where too few tracks fit one motion.
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

    A rotation about an axis perpendicular to the optical axis shifts all of the content alike. If the images have
    little in common, the result may be any shift.

    Args:
        before: (height, width) the previous image, small, such as the coarsest level of a pyramid.
        now: (height, width) the newest image, of the same size.
    """
    height, width = before.shape
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(before.astype(np.float32), now.astype(np.float32), window)
    return np.array(shift)
