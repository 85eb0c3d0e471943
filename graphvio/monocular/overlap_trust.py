"""Whether cameras whose views overlap can be trusted with the scale: the IMU alone is asked once.

An error of how two cameras are turned to each other looks like another distance of all points, and no residual shows
it: half a degree may be a third of the scale. Until the scale is known without what cameras see of each other's
points, too, keyframes are collected for a window without that.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from graphvio.measurements.motion import CameraTracks
from graphvio.monocular.initialiser import Initialiser
from graphvio.monocular.states import States, size_m
from graphvio.monocular.window import KeyframeWindow

_MAX_SIGMAS = 4.0
_MIN_OFF = 0.025  # seconds after the scale is known, the IMU alone was at most 2.3 % off
_MIN_COMMON = 5  # keyframes
_MIN_SIZE_M = 0.05
_SUFFICIENT_SIGMA = 0.01  # of the scale by the IMU
_MAX_COMPARISONS = 8  # each takes as long as an initialisation


def alone(camera_tracks: Mapping[int, CameraTracks]) -> dict[int, CameraTracks]:
    """Return what each camera sees by itself."""
    return {j: CameraTracks(tracks.ids, tracks.rays, readout=tracks.readout) for j, tracks in camera_tracks.items()}


class OverlapTrust:
    """Finds the scale without overlaps beside the estimate that uses them, and compares.

    Args:
        initialiser: without anything in it.
    """

    def __init__(self, initialiser: Initialiser) -> None:
        self._initialiser: Initialiser | None = initialiser
        self._compared = 0

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest keyframe that is kept, or None."""
        return None if self._initialiser is None else self._initialiser.oldest_ns

    def set_gyro_bias_prior(self, gyro_bias: np.ndarray, sigma: float) -> None:
        """Set the gyro's bias (3,) rad/s as a standstill shows it."""
        if self._initialiser is not None:
            self._initialiser.set_gyro_bias_prior(gyro_bias, sigma)

    def add(
        self, stamp_ns: int, camera_tracks: Mapping[int, CameraTracks], is_stationary: bool, states: States | None
    ) -> tuple[KeyframeWindow, str] | None:
        """Add a keyframe.

        Args:
            stamp_ns: of the keyframe.
            camera_tracks: of all cameras.
            is_stationary: whether the rig stands.
            states: of the window that uses overlaps, or None as long as it does not know the scale.

        Returns:
            The window without overlaps and what is wrong with these, where they cannot be trusted.
        """
        if self._initialiser is None:
            return None
        window = self._initialiser.add(stamp_ns, alone(camera_tracks), is_stationary)
        if window is None:
            return None
        if states is None:
            return window, "what cameras see of each other's points fits no motion"
        _, mine, theirs = np.intersect1d(window.states.stamps_ns, states.stamps_ns, return_indices=True)
        if len(mine) < _MIN_COMMON:
            return None
        own_size_m = size_m(window.states.poses[mine, :3, 3])
        if own_size_m < _MIN_SIZE_M:
            return None
        off = size_m(states.poses[theirs, :3, 3]) / own_size_m - 1.0
        self._compared += 1
        if abs(off) < max(_MAX_SIGMAS * self._initialiser.scale_sigma, _MIN_OFF):
            if self._compared == _MAX_COMPARISONS or self._initialiser.scale_sigma < _SUFFICIENT_SIGMA:
                self._initialiser = None
            return None
        return window, f"overlapping views show a scale that is {100 * off:+.0f} % off the accelerometer's"
