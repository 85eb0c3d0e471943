"""Constant-velocity prediction of relative motion."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3_inverse
from graphvio.measurements.motion import RelativeMotion


class SteadyMotion:
    """Chain of measured motions that predicts a repetition of the last one, as the odometry does without an IMU."""

    def __init__(self) -> None:
        self._nav_T_body: dict[int, Float] = {}
        self._latest_ns: int | None = None
        self._step = np.eye(4)  # earlier_T_later
        self._now_ns = 0
        self._nav_T_now = np.eye(4)

    def begin(self, stamp_ns: int) -> None:
        """Begin a step: predict the pose of a frameset."""
        self._now_ns = stamp_ns
        self._nav_T_now = np.eye(4) if self._latest_ns is None else self._nav_T_body[self._latest_ns] @ self._step

    def predict(self, then_ns: int) -> Float | None:
        """Return the predicted ``now_T_then`` (4, 4) of body, or None for an unknown stamp."""
        then = self._nav_T_body.get(then_ns)
        return None if then is None else se3_inverse(self._nav_T_now) @ then

    def end(self, motion: RelativeMotion | None) -> None:
        """End the step at the measured pose; without one, at the predicted pose."""
        if motion is not None and motion.reference_stamp_ns in self._nav_T_body:
            self._nav_T_now = self._nav_T_body[motion.reference_stamp_ns] @ motion.reference_T_current
            if self._latest_ns is not None:  # without a measurement it stays: rounding would double with each step
                self._step = se3_inverse(self._nav_T_body[self._latest_ns]) @ self._nav_T_now
        self._nav_T_body[self._now_ns] = self._nav_T_now
        self._latest_ns = self._now_ns
