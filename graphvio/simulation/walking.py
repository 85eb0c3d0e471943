"""How a person walks along a path: speed, rounded corners, the bob and sway of each step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.simulation.motion import Motion

_STEP_S = 0.01
_CORNER_S = 1.5  # over which a corner of the path is rounded
_HEADING_S = 2.2  # over which the body turns at a corner


@dataclass(frozen=True)
class Gait:
    """What each step does to the body: amplitudes in metres and radians, steps per second."""

    steps_hz: float = 1.9
    vertical_m: float = 0.024
    lateral_m: float = 0.020
    pitch_rad: float = 0.014
    roll_rad: float = 0.018
    yaw_rad: float = 0.020
    glance_rad: float = 0.09


class Walk:
    """A walk along the corners (N, 3) of a path, in metres, at the height of the body.

    It rests for ``rest_s`` first and then takes about a second to reach its speed; with no rest it is
    under way at full speed from the start. It stops at the end of the path and stays there.
    """

    def __init__(
        self, path: Float, speed_mps: float, duration_s: float, rest_s: float = 1.0, gait: Gait | None = None
    ) -> None:
        self.path = np.asarray(path, dtype=np.float64)
        self.gait = gait if gait is not None else Gait()
        lengths = np.linalg.norm(np.diff(self.path, axis=0), axis=1)
        self._corner_at = np.concatenate([[0.0], np.cumsum(lengths)])
        # Smoothing spreads the start over half its window on each side: begin later, to rest truly.
        start_s = rest_s + 0.5 * max(_CORNER_S, _HEADING_S) if rest_s > 0.0 else -2.0
        # The whole path, however little of it is wanted: a cut recording is the beginning of the whole one.
        end_s = max(duration_s, start_s + self._corner_at[-1] / speed_mps)
        self._times = np.arange(-2.0, end_s + 3.0, _STEP_S)
        walked = np.clip(speed_mps * (self._times - start_s), 0.0, None)
        self._walked = np.minimum(walked, self._corner_at[-1])
        self.motion = Motion(self._course, duration_s)

    def time_at(self, walked_m: float) -> float:
        """Time in seconds at which so much of the path is walked."""
        return float(np.interp(walked_m, self._walked, self._times))

    def _course(self, times: Float) -> Float:
        along = np.column_stack([np.interp(self._walked, self._corner_at, self.path[:, i]) for i in range(3)])
        steps = np.diff(self.path[:, :2], axis=0)
        headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        leg = np.clip(np.searchsorted(self._corner_at, self._walked, side="right") - 1, 0, len(headings) - 1)
        position = np.column_stack([_smoothed(along[:, i], _CORNER_S) for i in range(3)])
        yaw = _smoothed(headings[leg], _HEADING_S)
        pace = _smoothed(np.gradient(self._walked, _STEP_S), _CORNER_S)
        stride = pace / max(float(pace.max()), 1e-9)  # nobody bobs while standing still
        gait, t = self.gait, self._times
        step, side = 2.0 * np.pi * gait.steps_hz * t, np.pi * gait.steps_hz * t
        sway = stride * gait.lateral_m * np.sin(side)
        course = np.column_stack(
            [
                position[:, 0] - sway * np.sin(yaw),
                position[:, 1] + sway * np.cos(yaw),
                position[:, 2] + stride * gait.vertical_m * np.sin(step),
                yaw + stride * (gait.yaw_rad * np.sin(side + 0.7) + gait.glance_rad * np.sin(0.9 * t)),
                stride * (gait.pitch_rad * np.sin(step + 1.1) + 0.3 * gait.glance_rad * np.sin(0.53 * t + 0.5)),
                stride * gait.roll_rad * np.sin(side + 0.3),
            ]
        )
        return np.column_stack([np.interp(times, t, course[:, i]) for i in range(6)])


def _smoothed(values: Float, window_s: float) -> Float:
    """Values (N,) averaged under a raised cosine of the given full width."""
    half = round(0.5 * window_s / _STEP_S)
    window = np.hanning(2 * half + 3)[1:-1]
    padded = np.pad(values, half, mode="edge")
    return np.convolve(padded, window / window.sum(), mode="valid")
