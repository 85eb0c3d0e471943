"""Signs of a knock in a rig of single cameras: overlapping views that leave their epipolar lines, all at once."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3_inverse, skew
from graphvio.monocular.reprojection import Cameras
from graphvio.monocular.sightings import Views

_MIN_COMMON = 30  # landmarks that two cameras see at a keyframe
_MIN_CHANGE_PX = 0.25  # median, as for pairs
CONFIRMED = 3  # keyframes since a knock, one after the other
_KNOWN = 8  # keyframes before it
_MAX_RELATIVE_CHANGE = 0.2  # between keyframes since the knock: a turned camera's offset stays
_MAX_RELATIVE_SPREAD = 0.5  # of the offsets before the knock, in units of the change


class OverlapKnockDetector:
    """Monitors how far landmarks that two cameras see are off the epipolar lines, whatever moves in the scene.

    What counts is a change from one keyframe to the next, after which the offset stays. A constant offset is an error
    of the rig file, which the window estimates.
    """

    def __init__(self) -> None:
        self._offsets_px: dict[tuple[int, int], list[float]] = {}

    def forget(self) -> None:
        """Forget all offsets: later ones are measured by other cameras."""
        self._offsets_px = {}

    def update(self, views: Views, cameras: Cameras) -> frozenset[int]:
        """Add a keyframe, and return the cameras that may have been knocked.

        Args:
            views: views from the keyframe.
            cameras: calibration that is in force.

        Returns:
            Indices of the cameras whose common landmarks left their epipolar lines three keyframes ago: one of each two
            has been turned, and these do not show which one. None with rolling shutters, whose lines are exposed at
            different places.
        """
        if views.readout.any():
            return frozenset()
        knocked: set[int] = set()
        for pair in combinations(np.unique(views.camera).tolist(), 2):
            offset_px = _offset_px(views, cameras, *pair)
            if offset_px is None:
                continue
            offsets = [*self._offsets_px.get(pair, []), offset_px][-_KNOWN - CONFIRMED :]
            self._offsets_px[pair] = offsets
            if _has_changed(np.array(offsets)):
                knocked.update(pair)
        return frozenset(knocked)


def _has_changed(offsets_px: Float) -> bool:
    """Return whether offsets (N,) changed before the last three, and stay as they are since then."""
    if len(offsets_px) < _KNOWN + CONFIRMED:
        return False
    before, since = offsets_px[:-CONFIRMED], offsets_px[-CONFIRMED:]
    changes = since - np.median(before)
    newest = abs(changes[-1])
    is_large = bool((np.abs(changes) > _MIN_CHANGE_PX).all())
    stays = bool((np.abs(changes - changes[-1]) <= _MAX_RELATIVE_CHANGE * newest).all())
    return is_large and stays and float(np.ptp(before)) <= _MAX_RELATIVE_SPREAD * newest


def _offset_px(views: Views, cameras: Cameras, one: int, other: int) -> float | None:
    """Return the median signed distance of views from the epipolar lines in another camera; None if there are few."""
    of_one, of_other = (np.flatnonzero(views.camera == camera) for camera in (one, other))
    _, first, second = np.intersect1d(views.landmark[of_one], views.landmark[of_other], return_indices=True)
    if len(first) < _MIN_COMMON:
        return None
    common = of_one[first], of_other[second]
    rays = [np.column_stack([views.rays[rows], np.ones(len(rows))]) for rows in common]
    other_T_one = se3_inverse(cameras.body_T_cam[other]) @ cameras.body_T_cam[one]
    lines = rays[0] @ (skew(other_T_one[:3, 3]) @ other_T_one[:3, :3]).T
    distances = np.sum(lines * rays[1], axis=1) / np.hypot(lines[:, 0], lines[:, 1])
    return float(np.median(distances) * cameras.focal_px[other])
