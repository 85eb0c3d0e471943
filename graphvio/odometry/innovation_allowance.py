"""What innovation tests allow for errors of the calibration, given how far the state has followed vision."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.estimator import StateEstimator
from graphvio.geometry import se3_inverse
from graphvio.measurements.motion import RelativeMotion, VisualResult
from graphvio.rig import Rig
from graphvio.self_calibration.innovation import InnovationErrors


class InnovationAllowance:
    """Adds to motions by vision the covariance by which errors of the calibration make them contradict the IMU.

    The state follows vision, and velocity and biases follow what the errors do. An innovation therefore contains what
    they add since vision last constrained the state, mostly over one step.

    Args:
        rig: To which the covariance of the calibration belongs.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._errors: InnovationErrors | None = None
        self._covariance: Float | None = None
        self._followed_ns = -1  # the newest frameset whose motion passed the test
        self._velocity: Float | None = None  # (6,) of body at the newest frameset
        self._velocities: dict[int, Float | None] = {}
        """The same one frameset before that and before those which motions are measured from."""

    def add(self, stamp_ns: int, estimator: StateEstimator, references: Set[int], covariance: Float) -> None:
        """Take a frameset.

        Args:
            stamp_ns: Its stamp.
            estimator: Has been updated by it.
            references: Stamps of framesets that motions are measured from.
            covariance: (C, C) of the calibration that the state has followed until then.
        """
        if self._covariance is not covariance:
            self._covariance, self._errors = covariance, InnovationErrors(covariance, self._rig)
        gate_result = estimator.gate_results.get("vision")
        if gate_result is not None and gate_result.accepted:
            self._followed_ns = stamp_ns
        kept = {*references, self._followed_ns}
        self._velocities = {ns: each for ns, each in self._velocities.items() if ns in kept}
        self._velocities[stamp_ns] = self._velocity
        self._velocity = _body_velocity(estimator)

    def allow(self, visual: VisualResult, estimator: StateEstimator) -> VisualResult:
        """Return a frameset's result whose motions have the covariance that the calibration's errors add.

        Args:
            visual: Of the frameset.
            estimator: Has predicted the state there.
        """
        errors, now = self._errors, self._velocity  # that of the state here would come from the IMU under test
        if visual.motion is None or errors is None:
            return visual

        def allowed(motion: RelativeMotion) -> RelativeMotion:
            since_ns = max(motion.reference_stamp_ns, self._followed_ns)
            now_T_then = estimator.motion_since(since_ns)
            if now_T_then is None:
                return motion
            added = errors.covariance(se3_inverse(now_T_then), self._velocities.get(since_ns), now)
            return replace(motion, calibration_covariance=added)

        alternatives = tuple(map(allowed, visual.alternatives))
        return replace(visual, motion=allowed(visual.motion), alternatives=alternatives)


def _body_velocity(estimator: StateEstimator) -> Float | None:
    """Return angular and linear velocity (6,) of body in its own frame, or None where the rate is not known."""
    rate = estimator.latest_rate()
    if rate is None:
        return None
    state = estimator.state()
    return np.concatenate([rate, state.nav_T_body[:3, :3].T @ state.velocity_nav])
