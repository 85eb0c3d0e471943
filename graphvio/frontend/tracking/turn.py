"""Rotation of a single camera between two images, measured by its tracks alone, without scale and without an IMU."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from graphvio.arrays import Float
from graphvio.frontend.depth.tracks import common_rows
from graphvio.geometry import so3_log
from graphvio.measurements.motion import CameraTracks
from graphvio.rig import Rig

_MIN_TRACKS = 30
_MIN_FITTING = 0.5  # share of the tracks that fit the essential matrix
_MAX_SLOPE = 1.5  # of rays against the axis: beyond it, errors in the image plane are many times as large
_MAX_OFF_PX = 0.5
_CONFIDENCE = 0.999
_MAX_OFF_PLANE_PX = 0.7
_MAX_IN_PLANE = 0.85  # share of the tracks that fit: a plane has two essential matrices, with different rotations


def turn_between(rig: Rig, then: Mapping[int, CameraTracks], now: Mapping[int, CameraTracks]) -> Float | None:
    """Measure the rotation ``then_R_now`` (3, 3) of body by the essential matrix of the camera with most tracks.

    Args:
        rig: The rig, of single cameras.
        then: Tracks of the cameras at an instant, by camera index.
        now: The same some tenths of a second later.

    Returns:
        The rotation, or None if too few tracks are common to both instants or fit one motion, or if nearly all of them
        lie on a plane.
    """
    tracks = {j: _tracks(then[j], now[j]) for j in then.keys() & now.keys()}
    if not tracks:
        return None
    camera = max(tracks, key=lambda j: (len(tracks[j][0]), -j))
    first, second = tracks[camera]
    if len(first) < _MIN_TRACKS:
        return None
    focal_px = rig.cameras[camera].focal_px
    essential, fits = cv2.findEssentialMat(
        first, second, np.eye(3), method=cv2.USAC_ACCURATE, prob=_CONFIDENCE, threshold=_MAX_OFF_PX / focal_px
    )
    fitting = np.count_nonzero(fits)
    if essential is None or essential.shape != (3, 3) or fitting < _MIN_FITTING * len(first):
        return None
    _, in_plane = cv2.findHomography(
        first, second, cv2.USAC_ACCURATE, _MAX_OFF_PLANE_PX / focal_px, confidence=_CONFIDENCE
    )
    if np.count_nonzero(in_plane) > _MAX_IN_PLANE * fitting:
        return None
    # Of the two rotations that fit the essential matrix, one has half a turn more.
    rotations = [np.ascontiguousarray(each, dtype=np.float64) for each in cv2.decomposeEssentialMat(essential)[:2]]
    now_R_then = min(rotations, key=lambda rotation: float(np.linalg.norm(so3_log(rotation))))
    body_R_cam = rig.cameras[camera].body_T_cam[:3, :3]
    return np.asarray(body_R_cam @ now_R_then.T @ body_R_cam.T)


def _tracks(then: CameraTracks, now: CameraTracks) -> tuple[Float, Float]:
    """Return the rays then and now, (N, 2) each, of the tracks that are common to both and near the axis."""
    first, second = common_rows(then.ids, now.ids)
    before, after = then.rays[first], now.rays[second]
    is_near_axis = (np.hypot(*before.T) < _MAX_SLOPE) & (np.hypot(*after.T) < _MAX_SLOPE)
    return np.ascontiguousarray(before[is_near_axis]), np.ascontiguousarray(after[is_near_axis])
