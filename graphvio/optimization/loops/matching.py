"""Features of two images that are one: matched by their descriptors, verified by the geometry of two views."""

from __future__ import annotations

from typing import Any

import numpy as np

from graphvio.arrays import AnyArray, Bool, Float, Int
from graphvio.geometry import skew
from graphvio.optimization.loops.database import CENTRE_PX, colmap, colmap_camera
from graphvio.rig import Camera

_UNIT = 512.0**2  # COLMAP scales descriptors to this squared length
_MOST_ANGLE = 0.7  # between descriptors of one feature, radians; COLMAP's
_MOST_RATIO = 0.8  # of the best's angle to the second best's; COLMAP's
_LEAST_LENGTH = 1e-12  # of the normal of a plane that there is not: two views from one point


def alike(first: AnyArray, second: AnyArray) -> Int:
    """Rows (M, 2) of descriptors (K, 128) and (L, 128), uint8, that are each other's best and have no rival.

    They are those that COLMAP's own matcher finds on the CPU, in a thirtieth of its time.
    """
    if not len(first) or not len(second):
        return np.zeros((0, 2), dtype=np.int64)
    products = first.astype(np.float32) @ second.astype(np.float32).T  # whole numbers, and exact
    there, is_clear = _best(products)
    back, is_clear_back = _best(np.ascontiguousarray(products.T))
    mutual = is_clear & is_clear_back[there] & (back[there] == np.arange(len(first)))
    rows = np.flatnonzero(mutual)
    return np.column_stack([rows, there[rows]])


def _best(products: AnyArray) -> tuple[Int, Bool]:
    """Column of the largest product of each row (K,), and whether it is near and clearly nearer than all others."""
    rows = np.arange(len(products))
    best = np.argmax(products, axis=1)
    largest = products[rows, best]
    others = products.copy()
    others[rows, best] = 0.0
    angle = np.arccos(np.minimum(largest / np.float32(_UNIT), 1.0))
    rival = np.arccos(np.minimum(others.max(axis=1) / np.float32(_UNIT), 1.0))
    return best, (angle <= _MOST_ANGLE) & (angle < _MOST_RATIO * rival)


def estimated_geometry(cameras: tuple[Camera, Camera], pixels: tuple[Float, Float], rows: Int) -> Any:
    """COLMAP's two-view geometry that explains most matches (M, 2) of pixels (K, 2) and (L, 2)."""
    first, second = (colmap_camera(camera, 1) for camera in cameras)
    one, other = (each + CENTRE_PX for each in pixels)
    options = colmap().TwoViewGeometryOptions()
    options.ransac.random_seed = 0  # else it depends on what the thread did before
    return colmap().estimate_calibrated_two_view_geometry(first, one, second, other, rows.astype(np.uint32), options)


def known_geometry(
    cameras: tuple[Camera, Camera], second_T_first: Float, pixels: tuple[Float, Float], rows: Int, most_px: float
) -> Any:
    """COLMAP's two-view geometry of a known motion, and the matches that it explains.

    Args:
        cameras: of the two images.
        second_T_first: (4, 4).
        pixels: features (K, 2) and (L, 2).
        rows: (M, 2) of features that look alike.
        most_px: distance from the plane through the ray and both cameras, as an angle times the focal length.
    """
    essential = skew(second_T_first[:3, 3]) @ second_T_first[:3, :3]
    first, has_first = _rays(cameras[0], pixels[0][rows[:, 0]])
    second, has_second = _rays(cameras[1], pixels[1][rows[:, 1]])
    fits = has_first & has_second
    fits &= _off_plane(second, first @ essential.T) * cameras[1].focal_px <= most_px
    fits &= _off_plane(first, second @ essential) * cameras[0].focal_px <= most_px
    library = colmap()
    made = library.TwoViewGeometry()
    made.config = library.TwoViewGeometryConfiguration.CALIBRATED
    made.E = essential
    made.cam2_from_cam1 = library.Rigid3d(np.ascontiguousarray(second_T_first[:3]))
    made.inlier_matches = np.ascontiguousarray(rows[fits], dtype=np.uint32).reshape(-1, 2)
    return made


def _rays(camera: Camera, pixels: Float) -> tuple[Float, Bool]:
    """Unit vectors (M, 3), and whether there are any (M,)."""
    rays, has_ray = camera.unproject(pixels)
    rows = np.column_stack([rays, np.ones(len(rays))])
    return rows / np.linalg.norm(rows, axis=1, keepdims=True), has_ray


def _off_plane(rays: Float, normals: Float) -> Float:
    """Angles (M,), radians, of unit vectors (M, 3) with planes of normals (M, 3)."""
    length = np.maximum(np.linalg.norm(normals, axis=1), _LEAST_LENGTH)
    return np.asarray(np.arcsin(np.minimum(np.abs(np.sum(rays * normals, axis=1)) / length, 1.0)))
