"""Smooth motion of the body, with exact derivatives: one spline gives poses, rates and accelerations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float

KNOT_S = 0.05

# Uniform quintic B-spline: weights of six control values as polynomials of the place u (0 to 1) between two
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
    """A motion that is four times continuously differentiable.

    Args:
        course: gives ``[x, y, z, yaw, pitch, roll]`` (N, 6) in metres and radians at times (N,) in seconds.
            The motion is the spline with these as control values: it follows the course, its sharpest bends
            rounded. Rotation is ``Rz(yaw) Ry(pitch) Rx(roll)``.
        duration_s: end; the motion is defined from 0 to there.
    """

    def __init__(self, course: Callable[[Float], Float], duration_s: float) -> None:
        self.duration_s = duration_s
        intervals = int(np.ceil(duration_s / KNOT_S - 1e-9)) + 1
        self._control = course(np.arange(-2.0, intervals + 3.0, dtype=np.float64) * KNOT_S)

    def at(self, times_s: Float) -> MotionStates:
        """States at times (N,) in seconds.

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
    """Weights (N, 6) of the control values, and their first and second derivatives by time."""
    powers = u ** np.arange(6)
    n = np.arange(6)
    first = np.zeros_like(powers)
    first[:, 1:] = n[1:] * powers[:, :5] / KNOT_S
    second = np.zeros_like(powers)
    second[:, 2:] = n[2:] * n[1:5] * powers[:, :4] / KNOT_S**2
    return powers @ _BASIS.T, first @ _BASIS.T, second @ _BASIS.T


def _rotations(yaw: Float, pitch: Float, roll: Float) -> Float:
    """``Rz Ry Rx`` (N, 3, 3)."""
    cy, sy, cp, sp, cr, sr = (
        np.cos(yaw),
        np.sin(yaw),
        np.cos(pitch),
        np.sin(pitch),
        np.cos(roll),
        np.sin(roll),
    )
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _body_rates(pitch: Float, roll: Float, rates: Float) -> Float:
    """Angular velocity (N, 3) in frame body of the rates (N, 3) of yaw, pitch and roll."""
    yaw_rate, pitch_rate, roll_rate = rates.T
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    return np.column_stack(
        [
            roll_rate - sp * yaw_rate,
            cr * pitch_rate + sr * cp * yaw_rate,
            cr * cp * yaw_rate - sr * pitch_rate,
        ]
    )
