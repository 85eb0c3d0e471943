"""Motions of the body: a spline whose poses, rates and accelerations are exact, and walks along a path, built on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float

KNOT_S = 0.05
STEP_S = 0.01
_CORNER_S = 1.5  # time over which a corner of the path is rounded
_HEADING_S = 2.2  # time over which the body turns at a corner

# Uniform quintic B-spline: weights of six control values as polynomials of the position u (0 to 1) between two
# knots; row i holds the coefficients of 1, u, ..., u^5 for control value i.
_BASIS = (
    np.array(
        [
            [1, -5, 10, -10, 5, -1],
            [26, -50, 20, 20, -20, 5],
            [66, 0, -60, 0, 30, -10],
            [26, 50, 20, -20, -20, 10],
            [1, 5, 10, 10, 5, -5],
            [0, 0, 0, 0, 0, 1],
        ]
    )
    / 120.0
)


@dataclass(frozen=True, eq=False)
class MotionStates:
    """States of the body at N times.

    Attributes:
        world_T_body: (N, 4, 4).
        velocity: (N, 3) m/s, frame world.
        acceleration: (N, 3) m/s^2, frame world, without gravity.
        angular_velocity: (N, 3) rad/s, frame body.
    """

    world_T_body: Float
    velocity: Float
    acceleration: Float
    angular_velocity: Float


class Motion:
    """A motion of the body, four times continuously differentiable.

    Args:
        course: returns ``[x, y, z, yaw, pitch, roll]`` (N, 6) in metres and radians at times (N,) in seconds. These are
            the control values of the spline, which follows them and rounds the sharpest bends. The rotation is
            ``Rz(yaw) Ry(pitch) Rx(roll)``.
        duration_s: end of the motion, which is defined from 0 to there.
    """

    def __init__(self, course: Callable[[Float], Float], duration_s: float) -> None:
        self.duration_s = duration_s
        intervals = int(np.ceil(duration_s / KNOT_S - 1e-9)) + 1
        self._control = course(np.arange(-2.0, intervals + 3.0, dtype=np.float64) * KNOT_S)

    def at(self, times_s: Float) -> MotionStates:
        """Evaluate the states at times (N,) in seconds.

        Raises:
            ValueError: if a time lies outside the motion.
        """
        times_s = np.atleast_1d(np.asarray(times_s, dtype=np.float64))
        if times_s.min() < 0.0 or times_s.max() > self.duration_s + 1e-6:
            raise ValueError(f"times {times_s.min()} to {times_s.max()} s; the motion lasts {self.duration_s} s")
        place = times_s / KNOT_S
        first = np.minimum(place.astype(np.int64), len(self._control) - 6)
        u = (place - first)[:, None]
        control = self._control[first[:, None] + np.arange(6)]
        values, rates, second = (np.einsum("ni,nic->nc", weights, control) for weights in _weights_and_derivatives(u))
        yaw, pitch, roll = values[:, 3], values[:, 4], values[:, 5]
        world_T_body = np.zeros((len(times_s), 4, 4))
        world_T_body[:, :3, :3] = _rotations(yaw, pitch, roll)
        world_T_body[:, :3, 3] = values[:, :3]
        world_T_body[:, 3, 3] = 1.0
        return MotionStates(world_T_body, rates[:, :3], second[:, :3], _body_rates(pitch, roll, rates[:, 3:]))


def _weights_and_derivatives(u: Float) -> tuple[Float, Float, Float]:
    """Compute weights (N, 6) of the control values, and their first and second derivatives with respect to time."""
    powers = u ** np.arange(6)
    n = np.arange(6)
    first = np.zeros_like(powers)
    first[:, 1:] = n[1:] * powers[:, :5] / KNOT_S
    second = np.zeros_like(powers)
    second[:, 2:] = n[2:] * n[1:5] * powers[:, :4] / KNOT_S**2
    return powers @ _BASIS.T, first @ _BASIS.T, second @ _BASIS.T


def _rotations(yaw: Float, pitch: Float, roll: Float) -> Float:
    """Return the rotations ``Rz(yaw) Ry(pitch) Rx(roll)`` (N, 3, 3)."""
    cy, sy, cp = np.cos(yaw), np.sin(yaw), np.cos(pitch)
    sp, cr, sr = np.sin(pitch), np.cos(roll), np.sin(roll)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _body_rates(pitch: Float, roll: Float, rates: Float) -> Float:
    """Convert rates (N, 3) of yaw, pitch and roll to angular velocity (N, 3) in frame body."""
    yaw_rate, pitch_rate, roll_rate = rates.T
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    wx, wy = roll_rate - sp * yaw_rate, cr * pitch_rate + sr * cp * yaw_rate
    return np.column_stack([wx, wy, cr * cp * yaw_rate - sr * pitch_rate])


@dataclass(frozen=True)
class Gait:
    """Periodic motion of the body with the steps of a walk: steps per second, and amplitudes in metres and radians."""

    steps_hz: float = 1.9
    vertical_m: float = 0.024
    lateral_m: float = 0.020
    pitch_rad: float = 0.014
    roll_rad: float = 0.018
    yaw_rad: float = 0.020
    glance_rad: float = 0.09


class Walk:
    """A walk along a path, which stops at its end and stays there.

    Args:
        path: (N, 3) corners of the path, metres, at the height of the body.
        speed_mps: speed, m/s.
        duration_s: duration of the motion.
        stationary_s: initial standstill, after which it takes about a second to reach the speed; with 0 the walk is at
            full speed from the beginning.
        gait: periodic motion with the steps; None for the default one.
    """

    def __init__(
        self, path: Float, speed_mps: float, duration_s: float, stationary_s: float = 1.0, gait: Gait | None = None
    ) -> None:
        self.path = np.asarray(path, dtype=np.float64)
        self.gait = gait if gait is not None else Gait()
        lengths = np.linalg.norm(np.diff(self.path, axis=0), axis=1)
        self._corner_at = np.concatenate([[0.0], np.cumsum(lengths)])
        # Smoothing spreads the departure over half its window on each side: depart later, for a true standstill.
        start_s = stationary_s + 0.5 * max(_CORNER_S, _HEADING_S) if stationary_s > 0.0 else -2.0
        # Compute the whole path even if a part is wanted, so that a shorter motion is the beginning of the whole one.
        end_s = max(duration_s, start_s + self._corner_at[-1] / speed_mps)
        self._times = np.arange(-2.0, end_s + 3.0, STEP_S)
        walked = np.clip(speed_mps * (self._times - start_s), 0.0, None)
        self._walked = np.minimum(walked, self._corner_at[-1])
        self.motion = Motion(self._course, duration_s)

    def time_at(self, walked_m: float) -> float:
        """Return the time in seconds at which ``walked_m`` metres of the path are walked."""
        return float(np.interp(walked_m, self._walked, self._times))

    def _course(self, times: Float) -> Float:
        along = np.column_stack([np.interp(self._walked, self._corner_at, self.path[:, i]) for i in range(3)])
        steps = np.diff(self.path[:, :2], axis=0)
        headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        leg = np.clip(np.searchsorted(self._corner_at, self._walked, side="right") - 1, 0, len(headings) - 1)
        position = np.column_stack([smoothed(along[:, i], _CORNER_S) for i in range(3)])
        yaw = smoothed(headings[leg], _HEADING_S)
        pace = smoothed(np.gradient(self._walked, STEP_S), _CORNER_S)
        stride = pace / max(float(pace.max()), 1e-9)  # no periodic motion at standstill
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


def smoothed(values: Float, window_s: float) -> Float:
    """Smooth values (N,) by a raised cosine of the given full width."""
    half = round(0.5 * window_s / STEP_S)
    window = np.hanning(2 * half + 3)[1:-1]
    padded = np.pad(values, half, mode="edge")
    return np.convolve(padded, window / window.sum(), mode="valid")
