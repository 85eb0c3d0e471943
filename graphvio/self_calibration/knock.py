"""Signs of a knock: matches that all leave their epipolar lines, and pairs that contradict each other for long."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from graphvio.arrays import Float
from graphvio.cameras import central_scale, unproject_pixels
from graphvio.geometry import skew
from graphvio.rig import Rig
from graphvio.self_calibration.parameters import PAIR, STEREO, RigCalibration, extrinsics_of, slices_of_groups
from graphvio.self_calibration.window import View

_MIN_MATCHES = 30
_MAX_OFFSET_PX = 0.25  # median; a calibration that is well known is off by a tenth of it
_MAX_SIGMAS = 4.0  # of the offset, by the calibration's covariance: elsewhere in an image it may be known less well
_CONFIRMED = 3  # keyframes, one after the other
_MAX_CHANGE = 0.2  # relative, between these keyframes: a turned camera's offset stays, a late camera's does not
# Pairs that contradict each other for longer than this, without a pause of agreement, may have been moved.
_MAX_CONTRADICTION_NS, _MIN_AGREEMENT_NS = 3_000_000_000, 500_000_000
_TURNED_RAD, _MOVED_M = np.deg2rad(0.3), 0.005  # standard deviations of what a knock does to a camera or a pair


class KnockDetector:
    """Monitors how far matches are off their epipolar lines, which does not depend on the scene or on its motion."""

    def __init__(self) -> None:
        self._off_px: dict[int, list[float]] = {}  # pair index -> offsets at its newest keyframes, one after the other

    def update(self, views: Mapping[int, View], calibration: RigCalibration, covariance: Float) -> list[int]:
        """Add a keyframe's views, and return the pairs that have been knocked.

        Args:
            views: index of the pair or single camera -> tracks.
            calibration: calibration that is in force.
            covariance: (C, C) covariance of the cameras' parameters.

        Returns:
            Indices of the pairs whose offset has lasted for three of their keyframes: they are not where they were.
        """
        for j, view in views.items():
            offset_px = epipolar_offset_px(view, calibration, j)
            if offset_px is None:
                continue
            known_px = self._off_px.pop(j, [])
            is_large = abs(offset_px) > _MAX_OFFSET_PX
            if is_large and abs(offset_px) > _MAX_SIGMAS * _offset_sigma_px(view, calibration, j, covariance):
                lasts = all(abs(offset_px - known) <= _MAX_CHANGE * abs(offset_px) for known in known_px)
                self._off_px[j] = [*known_px, offset_px] if lasts else [offset_px]
        knocked = [j for j, offsets in self._off_px.items() if len(offsets) >= _CONFIRMED]
        for j in knocked:
            del self._off_px[j]
        return knocked


class Contradiction:
    """Monitors for how long the pairs have contradicted each other."""

    def __init__(self) -> None:
        self._contradicting_ns: tuple[int, int] | None = None  # stamps of the first and the newest frameset that does
        self._now_ns = 0

    def update(self, stamp_ns: int, are_contradicting: bool) -> None:
        """Add a frameset with a measured motion; a long agreement or a gap ends the contradiction before it."""
        self._now_ns = stamp_ns
        if self._contradicting_ns is not None and stamp_ns - self._contradicting_ns[1] > _MIN_AGREEMENT_NS:
            self._contradicting_ns = None
        if are_contradicting:
            first_ns = stamp_ns if self._contradicting_ns is None else self._contradicting_ns[0]
            self._contradicting_ns = first_ns, stamp_ns

    @property
    def lasts(self) -> bool:
        """Whether the pairs have contradicted each other for more than three seconds."""
        return self._contradicting_ns is not None and self._now_ns - self._contradicting_ns[0] > _MAX_CONTRADICTION_NS


def epipolar_offset_px(view: View, calibration: RigCalibration, pair: int) -> float | None:
    """Return the median signed distance of a pair's matches from their epipolar lines, None where there are few."""
    return None if view.has_right.sum() < _MIN_MATCHES else _offset_px(view, calibration, pair)


def epipolar_distances(rays_one: Float, rays_other: Float, other_T_one: Float) -> Float:
    """Return the signed distances (N,) of points in another image from the epipolar lines of the same points in one.

    Args:
        rays_one: (N, 2) normalised coordinates in one camera.
        rays_other: (N, 2) normalised coordinates in the other one.
        other_T_one: (4, 4) pose of the one in the other.
    """
    one, other = (np.column_stack([rays, np.ones(len(rays))]) for rays in (rays_one, rays_other))
    lines = one @ (skew(other_T_one[:3, 3]) @ other_T_one[:3, :3]).T
    return np.asarray(np.sum(lines * other, axis=1) / np.hypot(lines[:, 0], lines[:, 1]))


def _offset_px(view: View, calibration: RigCalibration, pair: int) -> float:
    left, right = (
        unproject_pixels(
            int(calibration.models[pair, which]), calibration.intrinsics[pair, which],
            calibration.distortion[pair, which], np.ascontiguousarray(pixels[view.has_right]),
        )[0]
        for which, pixels in enumerate((view.left_px, view.right_px))
    )  # fmt: skip
    distances = epipolar_distances(left, right, calibration.right_T_left[pair])
    scale = central_scale(int(calibration.models[pair, 1]), calibration.distortion[pair, 1])
    return float(np.median(distances) * calibration.intrinsics[pair, 1, 0] * scale)


def _offset_sigma_px(view: View, calibration: RigCalibration, pair: int, covariance: Float) -> float:
    """Return the standard deviation of `epipolar_offset_px`, by the covariance (C, C) of all cameras' parameters."""
    own = np.flatnonzero(calibration.columns // PAIR == pair)
    of_own = covariance[np.ix_(own, own)]
    gradient = np.zeros(len(own))
    for k, sigma in enumerate(np.sqrt(np.diag(of_own))):
        if sigma == 0.0:
            continue
        step = np.zeros(len(covariance))
        for sign in (1.0, -1.0):
            step[own[k]] = sign * sigma
            gradient[k] += sign * _offset_px(view, calibration.moved(step), pair) / (2.0 * sigma)
    return float(np.sqrt(gradient @ of_own @ gradient))


def knock_covariance(rig: Rig, n_parameters: int, groups: Iterable[int]) -> Float:
    """Return the covariance (C, C) of the change that a knock makes to some pairs and single cameras.

    It turns and shifts cameras; lenses, the IMU and the length of a baseline stay.
    """
    variances = np.zeros(n_parameters)
    for j in groups:
        own, extrinsics = variances[slices_of_groups(rig)[j]], variances[extrinsics_of(rig, j)]
        if j < len(rig.pairs):
            own[STEREO : STEREO + 3] = _TURNED_RAD**2
        extrinsics[:3], extrinsics[3:] = _TURNED_RAD**2, _MOVED_M**2
    return np.diag(variances)
