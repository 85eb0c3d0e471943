"""Rides of vehicles: motions given by speed and heading over time, with the leaning and swaying of the vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.simulation.motion import STEP_S, Motion, smoothed

_SMOOTH_S = 2.0  # time over which speed and heading are smoothed
_MARGIN_S = 3.0  # time before and after the knots of speed and heading
_TONES = (0.61, 0.87, 1.16, 1.43)  # frequencies of the swaying, as fractions of its mean frequency


@dataclass(frozen=True)
class Vehicle:
    """Motion of a vehicle in addition to its path; swaying and tilting are proportional to the speed.

    Attributes:
        height_m: height of the body over the ground.
        lean: angle by which it leans towards the acceleration, rad per m/s^2; 1/g for a drone, negative for a vehicle
            on springs.
        sway_m: amplitudes of the swaying along x, y and z of the world, of each of its four sines.
        sway_hz: mean frequency of these sines.
        tilt_rad: amplitude of pitch and roll, of each of four sines.
        tilt_hz: mean frequency of these sines.
    """

    height_m: float
    lean: float
    sway_m: tuple[float, float, float]
    sway_hz: float
    tilt_rad: float
    tilt_hz: float


class Ride:
    """A ride from the world's origin, with speed and heading interpolated linearly between knots, then smoothed.

    Args:
        speeds: knots (seconds since departure, m/s); the first is at 0 s, and the last has speed 0.
        headings: knots (seconds since departure, degrees to the left of x).
        vehicle: the vehicle.

    Attributes:
        path: (N, 2) positions, metres, frame world, in steps of 10 ms.
    """

    def __init__(
        self, speeds: Sequence[tuple[float, float]], headings: Sequence[tuple[float, float]], vehicle: Vehicle
    ) -> None:
        knots_s, knots_mps = np.array(speeds).T
        turns_s, turns_deg = np.array(headings).T
        self._top_s = float(knots_s[np.argmax(knots_mps)]) + 0.5 * _SMOOTH_S
        times = np.arange(-_MARGIN_S, knots_s[-1] + _MARGIN_S, STEP_S)
        speed = smoothed(np.interp(times, knots_s, knots_mps), _SMOOTH_S)
        yaw = smoothed(np.deg2rad(np.interp(times, turns_s, turns_deg)), _SMOOTH_S)
        self.path = STEP_S * np.cumsum(speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0)
        pace = speed / speed.max()
        phases = 2.0 * np.pi * np.arange(20).reshape(5, 4) ** 2 / 7.0

        def swaying(axis: int, amplitude: float, mean_hz: float) -> Float:
            sines = [np.sin(2.0 * np.pi * f * mean_hz * times + p) for f, p in zip(_TONES, phases[axis], strict=True)]
            return np.asarray(pace * amplitude * np.sum(sines, axis=0))

        sways = [swaying(i, vehicle.sway_m[i], vehicle.sway_hz) for i in range(3)]
        pitch, roll = (swaying(i, vehicle.tilt_rad, vehicle.tilt_hz) for i in (3, 4))
        pitch += vehicle.lean * np.gradient(speed, STEP_S)
        roll -= vehicle.lean * speed * np.gradient(yaw, STEP_S)
        position = [self.path[:, 0], self.path[:, 1], np.full(len(times), vehicle.height_m)]
        self._times = times
        self._course = np.column_stack([*(p + s for p, s in zip(position, sways, strict=True)), yaw, pitch, roll])

    def motion(self, duration_s: float, stationary_s: float) -> Motion:
        """Make the motion of the body.

        Args:
            duration_s: duration of the motion.
            stationary_s: initial standstill; with 0 the motion begins at full speed.
        """
        departs_s = stationary_s + 0.5 * _SMOOTH_S if stationary_s > 0.0 else -self._top_s

        def course(times: Float) -> Float:
            """See `Motion`."""
            return np.column_stack([np.interp(times - departs_s, self._times, self._course[:, i]) for i in range(6)])

        return Motion(course, duration_s)
