"""Test whether cameras with overlapping views find the right scale, by a window that gets it from the IMU alone.

An error of the rotation between two cameras changes the distances of all points, and no residual shows it: half a
degree may change the scale by a third. Until the scale is also known without matches between cameras, keyframes are
collected for a second window that does not use them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from graphvio.measurements.motion import CameraTracks
from graphvio.monocular.initialiser import Initialiser
from graphvio.monocular.states import States, size_m
from graphvio.monocular.window import KeyframeWindow

_MAX_SIGMAS = 4.0
_MIN_OFF = 0.025  # share: seconds after the scale is known, the IMU alone was at most 2.3 % off
_MIN_COMMON = 5  # keyframes
_MIN_SIZE_M = 0.05
_SUFFICIENT_SIGMA = 0.01  # of the scale by the IMU alone, as a share: agreement with it ends the test
_MAX_COMPARISONS = 8  # each takes as long as an initialisation


def alone(camera_tracks: Mapping[int, CameraTracks]) -> dict[int, CameraTracks]:
    """Return the tracks of each camera by itself: without matches in other cameras, and points handed over."""
    return {j: CameraTracks(tracks.ids, tracks.rays, readout=tracks.readout) for j, tracks in camera_tracks.items()}


class OverlapTrust:
    """Finds the scale without overlapping views beside the estimate that uses them, and compares the two.

    Args:
        initialiser: an initialiser without keyframes.
    """

    def __init__(self, initialiser: Initialiser) -> None:
        self._initialiser: Initialiser | None = initialiser
        self._compared = 0

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest keyframe that is kept, or None."""
        return None if self._initialiser is None else self._initialiser.oldest_ns

    def set_gyro_bias_prior(self, gyro_bias: np.ndarray, sigma: float) -> None:
        """Set the prior of the gyro's bias, (3,) rad/s as measured at a standstill, and its standard deviation."""
        if self._initialiser is not None:
            self._initialiser.set_gyro_bias_prior(gyro_bias, sigma)

    def add(
        self, stamp_ns: int, camera_tracks: Mapping[int, CameraTracks], is_stationary: bool, states: States | None
    ) -> tuple[KeyframeWindow, str] | None:
        """Add a keyframe, and compare the scales once both are known.

        Args:
            stamp_ns: stamp of the keyframe.
            camera_tracks: tracks of all cameras.
            is_stationary: whether the rig stands.
            states: states of the window that uses overlapping views, or None as long as that does not know the scale.

        Returns:
            The window without overlapping views and what is wrong with these, where they cannot be trusted; else None.
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
