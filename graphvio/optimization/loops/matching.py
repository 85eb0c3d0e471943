"""Matching of the features of two images by their descriptors, and verification of matches by two-view geometry."""

from __future__ import annotations

from typing import Any

import numpy as np

from graphvio.arrays import AnyArray, Bool, Float, Int
from graphvio.geometry import skew
from graphvio.optimization.loops.colmap_library import CENTRE_PX, colmap
from graphvio.optimization.loops.database import colmap_camera
from graphvio.rig import Camera

_UNIT = 512.0**2  # COLMAP scales descriptors to this squared length
_MAX_ANGLE_RAD = 0.7  # between matching descriptors; COLMAP's value
_MAX_RATIO = 0.8  # of the best angle to the second best; COLMAP's value
_MIN_LENGTH = 1e-12  # of the normal of an epipolar plane, which is zero for two views from one point


def alike(first: AnyArray, second: AnyArray) -> Int:
    """Match descriptors (K, 128) and (L, 128), uint8, as COLMAP's matcher on the CPU does; returns rows (M, 2) of both.

    Two matching descriptors are each other's nearest, and both pass the ratio test.
    """
    if not len(first) or not len(second):
        return np.zeros((0, 2), dtype=np.int64)
    products = first.astype(np.float32) @ second.astype(np.float32).T  # exact, as the entries are integers
    second_of, is_clear = _best(products)
    first_of, is_clear_back = _best(np.ascontiguousarray(products.T))
    mutual = is_clear & is_clear_back[second_of] & (first_of[second_of] == np.arange(len(first)))
    rows = np.flatnonzero(mutual)
    return np.column_stack([rows, second_of[rows]])


def _best(products: AnyArray) -> tuple[Int, Bool]:
    """Return the column with the largest product in each row (K,), and whether it passes both thresholds (K,)."""
    rows = np.arange(len(products))
    best = np.argmax(products, axis=1)
    largest = products[rows, best]
    others = products.copy()
    others[rows, best] = 0.0
    angle = np.arccos(np.minimum(largest / np.float32(_UNIT), 1.0))
    rival = np.arccos(np.minimum(others.max(axis=1) / np.float32(_UNIT), 1.0))
    return best, (angle <= _MAX_ANGLE_RAD) & (angle < _MAX_RATIO * rival)


def estimated_geometry(cameras: tuple[Camera, Camera], pixels: tuple[Float, Float], rows: Int) -> Any:
    """Estimate COLMAP's two-view geometry from matches (M, 2) of features (K, 2) and (L, 2), by RANSAC."""
    first, second = (colmap_camera(camera, 1) for camera in cameras)
    one, other = (each + CENTRE_PX for each in pixels)
    options = colmap().TwoViewGeometryOptions()
    options.ransac.random_seed = 0  # otherwise results depend on earlier calls of the thread
    return colmap().estimate_calibrated_two_view_geometry(first, one, second, other, rows.astype(np.uint32), options)


def known_geometry(
    cameras: tuple[Camera, Camera], second_T_first: Float, pixels: tuple[Float, Float], rows: Int, max_error_px: float
) -> Any:
    """Return COLMAP's two-view geometry of a known motion, with the matches that agree with it.

    Args:
        cameras: the cameras of the two images.
        second_T_first: the motion (4, 4) between the cameras.
        pixels: features (K, 2) and (L, 2) of the two images.
        rows: matches (M, 2) of the features.
        max_error_px: maximum angle to the epipolar plane, times the focal length.
    """
    essential = skew(second_T_first[:3, 3]) @ second_T_first[:3, :3]
    first, has_first = _rays(cameras[0], pixels[0][rows[:, 0]])
    second, has_second = _rays(cameras[1], pixels[1][rows[:, 1]])
    fits = has_first & has_second
    fits &= _off_plane(second, first @ essential.T) * cameras[1].focal_px <= max_error_px
    fits &= _off_plane(first, second @ essential) * cameras[0].focal_px <= max_error_px
    library = colmap()
    geometry = library.TwoViewGeometry()
    geometry.config = library.TwoViewGeometryConfiguration.CALIBRATED
    geometry.E = essential
    geometry.cam2_from_cam1 = library.Rigid3d(np.ascontiguousarray(second_T_first[:3]))
    geometry.inlier_matches = np.ascontiguousarray(rows[fits], dtype=np.uint32).reshape(-1, 2)
    return geometry


def _rays(camera: Camera, pixels: Float) -> tuple[Float, Bool]:
    """Return unit vectors (M, 3) of pixels (M, 2), and whether they exist (M,)."""
    rays, has_ray = camera.unproject(pixels)
    rows = np.column_stack([rays, np.ones(len(rays))])
    return rows / np.linalg.norm(rows, axis=1, keepdims=True), has_ray


def _off_plane(rays: Float, normals: Float) -> Float:
    """Return the angles (M,), in radians, between unit vectors (M, 3) and planes with normals (M, 3)."""
    length = np.maximum(np.linalg.norm(normals, axis=1), _MIN_LENGTH)
    return np.asarray(np.arcsin(np.minimum(np.abs(np.sum(rays * normals, axis=1)) / length, 1.0)))
