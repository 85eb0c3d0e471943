"""Features of two images that are one: matched by their descriptors, verified by the geometry of two views."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.geometry import skew
from graphvio.optimization.loops.database import FeatureDatabase, colmap, colmap_camera
from graphvio.rig import Camera

_COLMAP_CENTRE_PX = 0.5
_LEAST_DISTANCE = 1e-12  # of a ray from a plane that there is not: two views from one point


class ImageMatcher:
    """Matches images of a database, from any thread.

    Args:
        database: of the features.
        lock: held while the database is read.
    """

    def __init__(self, database: FeatureDatabase, lock: threading.Lock) -> None:
        self._database = database
        self._lock = lock
        self._of_thread = threading.local()

    def match(self, first: str, second: str) -> Int:
        """Rows (M, 2) of features of two images that look alike, each the other's best."""
        with self._lock:
            keypoints = [_keypoints(self._database.pixels(name)) for name in (first, second)]
            descriptors = [self._database.descriptors(name) for name in (first, second)]
        rows = self._matcher().match(keypoints[0], descriptors[0], keypoints[1], descriptors[1])
        return np.asarray(rows, dtype=np.int64).reshape(-1, 2)

    def pixels(self, first: str, second: str) -> tuple[Float, Float]:
        """Features (K, 2) and (L, 2) of two images."""
        with self._lock:
            return self._database.pixels(first), self._database.pixels(second)

    def _matcher(self) -> Any:
        if not hasattr(self._of_thread, "made"):
            library = colmap()
            options = library.FeatureMatchingOptions()
            options.num_threads = 1
            options.use_gpu = False
            options.sift.cpu_brute_force_matcher = True  # finds the same as an index does, which first has to be built
            self._of_thread.made = library.FeatureMatcher.create(options, library.Device.cpu)
        return self._of_thread.made


def estimated_geometry(cameras: tuple[Camera, Camera], pixels: tuple[Float, Float], rows: Int) -> Any:
    """COLMAP's two-view geometry that explains most matches (M, 2) of pixels (K, 2) and (L, 2)."""
    first, second = (colmap_camera(camera, 1) for camera in cameras)
    one, other = (each + _COLMAP_CENTRE_PX for each in pixels)
    return colmap().estimate_calibrated_two_view_geometry(first, one, second, other, rows.astype(np.uint32))


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
    length = np.maximum(np.linalg.norm(normals, axis=1), _LEAST_DISTANCE)
    return np.asarray(np.arcsin(np.minimum(np.abs(np.sum(rays * normals, axis=1)) / length, 1.0)))


def _keypoints(pixels: Float) -> Any:
    rows = np.zeros((len(pixels), 4), dtype=np.float32)
    rows[:, :2], rows[:, 2] = pixels + _COLMAP_CENTRE_PX, 1.0
    return colmap().keypoints_from_matrix(np.ascontiguousarray(rows))
