"""Signs of a knock in a rig of single cameras: overlapping views that leave their epipolar lines, all at once."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3_inverse
from graphvio.monocular.reprojection import Cameras
from graphvio.monocular.sightings import Views
from graphvio.self_calibration.knock import epipolar_distances
from graphvio.self_calibration.parameters import PLACE, SINGLE

_MIN_COMMON = 30  # landmarks that two cameras see at a keyframe
_MIN_CHANGE_PX = 0.25  # median; see `_MAX_OFFSET_PX` in `graphvio.self_calibration.knock`
_MIN_SIGMAS = 4.0  # of the offset, by the covariance of the calibration
CONFIRMED = 3  # keyframes since a knock, one after the other
_BEFORE = 8  # keyframes before it
_MAX_RELATIVE_CHANGE = 0.2  # between keyframes since the knock: a turned camera's offset stays
_MAX_RELATIVE_SPREAD = 0.5  # of the offsets before the knock, in units of the change


class OverlapKnockDetector:
    """Monitors how far landmarks that two cameras see are off the epipolar lines, whatever moves in the scene.

    What counts is a change from one keyframe to the next, after which the offset stays. A constant offset is an error
    of the rig file, which the window estimates.

    Args:
        cameras: cameras of the rig file.
    """

    def __init__(self, cameras: Cameras) -> None:
        self._cameras = cameras
        self._offsets_px: dict[tuple[int, int], list[float]] = {}

    def forget(self) -> None:
        """Forget all offsets: later ones are measured by other cameras."""
        self._offsets_px = {}

    def update(self, views: Views, difference: Float, covariance: Callable[[], Float]) -> frozenset[int]:
        """Add a keyframe, and return the cameras that may have been knocked.

        Args:
            views: views from the keyframe.
            difference: (C * SINGLE,) difference of the cameras in force from those of the rig file.
            covariance: returns the covariance of the calibration, the cameras' parameters first.

        Returns:
            Indices of the cameras whose common landmarks left their epipolar lines three keyframes ago: one of each two
            has been turned, and these do not show which one. None with rolling shutters, whose lines are exposed at
            different places.
        """
        if views.readout.any():
            return frozenset()
        cameras = self._cameras.moved(difference)
        knocked: set[int] = set()
        for pair in combinations(np.unique(views.camera).tolist(), 2):
            offset_px = _offset_px(views, cameras, *pair)
            if offset_px is None:
                continue
            offsets = [*self._offsets_px.get(pair, []), offset_px][-_BEFORE - CONFIRMED :]
            self._offsets_px[pair] = offsets
            if _has_changed(np.array(offsets)):
                # If a place is slightly wrong, near landmarks have another offset than far ones.
                sigma_px = self._offset_sigma_px(views, difference, covariance(), pair)
                if abs(offset_px - np.median(offsets[:-CONFIRMED])) > _MIN_SIGMAS * sigma_px:
                    knocked.update(pair)
        return frozenset(knocked)

    def _offset_sigma_px(self, views: Views, difference: Float, covariance: Float, pair: tuple[int, int]) -> float:
        """Return the standard deviation of an offset by the covariance of both cameras' places."""
        places = np.concatenate([SINGLE * camera + np.arange(PLACE, SINGLE) for camera in pair])
        of_places = covariance[np.ix_(places, places)]
        gradient = np.zeros(len(places))
        for k, sigma in enumerate(np.sqrt(np.diag(of_places))):
            for sign in (1.0, -1.0):
                moved = difference.copy()
                moved[places[k]] += sign * sigma
                offset_px = _offset_px(views, self._cameras.moved(moved), *pair)
                assert offset_px is not None, "the views are the same as before"
                gradient[k] += sign * offset_px / (2.0 * sigma)
        return float(np.sqrt(gradient @ of_places @ gradient))


def _has_changed(offsets_px: Float) -> bool:
    """Return whether offsets (N,) changed before the last three, and stay as they are since then."""
    if len(offsets_px) < _BEFORE + CONFIRMED:
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
    other_T_one = se3_inverse(cameras.body_T_cam[other]) @ cameras.body_T_cam[one]
    distances = epipolar_distances(views.rays[of_one[first]], views.rays[of_other[second]], other_T_one)
    return float(np.median(distances) * cameras.focal_px[other])
