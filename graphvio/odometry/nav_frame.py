"""The nav frame of the estimates, in which body is turned when the cameras' attitude in body is corrected."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.states import RigState, StateCovariance
from graphvio.geometry import se3_inverse, so3_log

_KEPT_TURNS = 100  # a state leaves the estimator's window within far fewer


class NavFrame:
    """Converts states from the estimator's frame to nav.

    The path is measured by the cameras. If their attitude in body is wrong, the path is correct except for a rotation
    of the whole path, and body's attitude is wrong by the same rotation. When the calibration is corrected, body
    therefore has to turn in nav: if body's attitude were continued instead, the path would bend at that point.
    Positions continue, and gravity keeps its direction in body. The estimator is not involved, since none of its
    measurements depends on nav.
    """

    def __init__(self) -> None:
        self._turns: deque[tuple[int, Float]] = deque(maxlen=_KEPT_TURNS)  # first stamp, nav_T_estimator (4, 4)

    def turn(self, stamp_ns: int, estimator_T_body: Float, old_R_new: Float) -> Float:
        """Turn body at its present position.

        Args:
            stamp_ns: Stamp of the first estimate to which the turn applies.
            estimator_T_body: (4, 4) newest pose in the estimator's frame.
            old_R_new: (3, 3) rotation of the corrected body frame relative to the previous one, with the first pair's
                left camera held fixed.

        Returns:
            (6,) tangent ``[rotation, translation]`` of the pose's change, in body.
        """
        turned = np.eye(4)
        turned[:3, :3] = old_R_new
        nav_T_estimator = self._nav_T_estimator @ estimator_T_body @ turned @ se3_inverse(estimator_T_body)
        self._turns.append((stamp_ns, nav_T_estimator))
        return np.concatenate([so3_log(old_R_new), np.zeros(3)])

    def state(self, state: RigState) -> RigState:
        """Return the newest state in nav."""
        if not self._turns:
            return state
        nav_T_estimator = self._nav_T_estimator
        nav_R_estimator = nav_T_estimator[:3, :3]
        return replace(
            state,
            nav_T_body=nav_T_estimator @ state.nav_T_body,
            velocity_nav=nav_R_estimator @ state.velocity_nav,
            gravity_nav=nav_R_estimator @ state.gravity_nav,
        )

    def covariance(self, covariance: StateCovariance) -> StateCovariance:
        """Return the covariance of the newest state in nav; blocks in body or about level axes are unchanged."""
        if not self._turns:
            return covariance
        nav_R_estimator = self._nav_T_estimator[:3, :3]
        velocity, gravity = (
            None if each is None else nav_R_estimator @ each @ nav_R_estimator.T
            for each in (covariance.velocity, covariance.gravity)
        )
        return replace(covariance, velocity=velocity, gravity=gravity)

    def pose(self, stamp_ns: int, estimator_T_body: Float) -> Float:
        """Return an earlier pose (4, 4) in nav, with the turn that was in force at its stamp."""
        for begin_ns, nav_T_estimator in reversed(self._turns):
            if begin_ns <= stamp_ns:
                return np.asarray(nav_T_estimator @ estimator_T_body)
        return estimator_T_body

    @property
    def _nav_T_estimator(self) -> Float:
        return self._turns[-1][1] if self._turns else np.eye(4)
