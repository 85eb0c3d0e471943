"""The covariance that calibration errors add to an innovation, given the motions that the state has followed."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.estimator import StateEstimator
from graphvio.geometry import se3_adjoint, se3_inverse
from graphvio.linear_algebra import squared_length
from graphvio.measurements.motion import RelativeMotion, VisualResult
from graphvio.rig import Rig
from graphvio.self_calibration.innovation import InnovationErrors
from graphvio.self_calibration.parameters import depths_of_pair

_SHARED = 0.9  # share of the covariance added to a partial motion that later ones from its reference have, too
_MAX_JUMP2 = 25.0  # squared Mahalanobis distance of a motion's change, by its covariance


class _Measured(NamedTuple):
    """A motion, and the pairs that measured it."""

    motion: RelativeMotion
    pairs: frozenset[int]

    def has_reference_of(self, motion: RelativeMotion) -> bool:
        """Whether both motions begin at the same reference."""
        return self.motion.reference_stamp_ns == motion.reference_stamp_ns


class _VelocityError(NamedTuple):
    """The effect of depth errors on the state's velocity: its derivatives (P, 2, 6), and the errors at that time."""

    by_depths: Float
    errors: InnovationErrors


class CalibrationInnovationCovariance:
    """Adds to motions by vision the covariance by which calibration errors make them contradict the IMU.

    The state follows vision, and velocity and biases absorb the effect of the calibration error. An innovation
    therefore contains only the error accumulated since vision last constrained the state, usually one step. It contains
    the whole error if the motion was measured by other pairs, or with another calibration, than the motions the state
    has followed.

    Args:
        rig: The rig whose calibration has the covariance.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._errors: InnovationErrors | None = None
        self._covariance: Float | None = None
        self._followed_ns = -1  # the newest frameset whose motion passed the test
        self._followed: _Measured | None = None  # that motion
        self._tested: _Measured | None = None  # the newest motion
        self._followed_velocity: _VelocityError | None = None  # error of the state's velocity since that motion
        self._tested_by: dict[frozenset[int], RelativeMotion] = {}  # the newest motion of each set of pairs
        self._velocity: Float | None = None  # (6,) of body at the newest frameset
        self._velocities: dict[int, Float | None] = {}
        """Stamp -> body velocity one frameset earlier; of the newest, the references and the last accepted frameset."""

    def add_frameset(self, stamp_ns: int, estimator: StateEstimator, references: Set[int], covariance: Float) -> None:
        """Record whether the state has followed the motion of a frameset.

        Args:
            stamp_ns: Stamp of the frameset.
            estimator: State estimator, updated by the frameset.
            references: Stamps of framesets from which motions are measured.
            covariance: (C, C) covariance of the calibration with which the state has followed motions until then.
        """
        if self._covariance is not covariance:
            self._covariance, self._errors = covariance, InnovationErrors(covariance, self._rig)
        assert self._errors is not None
        gate_result = estimator.gate_results.get("vision")
        if gate_result is not None and gate_result.accepted:
            self._note_velocity(stamp_ns, estimator, self._errors)
            self._followed_ns, self._followed = stamp_ns, self._tested
        if self._tested is not None:
            self._tested_by[self._tested.pairs] = self._tested.motion
        self._tested_by = {
            pairs: motion for pairs, motion in self._tested_by.items() if motion.reference_stamp_ns in references
        }
        kept = {*references, self._followed_ns}
        self._velocities = {ns: each for ns, each in self._velocities.items() if ns in kept}
        self._velocities[stamp_ns] = self._velocity
        self._velocity = _body_velocity(estimator)

    def _note_velocity(self, stamp_ns: int, estimator: StateEstimator, errors: InnovationErrors) -> None:
        """Record the effect of depth errors on the velocity, from two successive motions from the same reference."""
        before, now = self._followed, self._tested
        if before is None or now is None or not before.has_reference_of(now.motion):
            return
        now_T_before = estimator.motion_since(self._followed_ns)
        if before.motion.by_depth_errors is None or now.motion.by_depth_errors is None or now_T_before is None:
            return
        carried = before.motion.by_depth_errors @ se3_adjoint(now_T_before).T
        by_depths = (now.motion.by_depth_errors - carried) / (1e-9 * (stamp_ns - self._followed_ns))
        self._followed_velocity = _VelocityError(by_depths, errors)

    def recalibrate(self, change: Float) -> bool:
        """Account for a new calibration, with which motions are measured from now on.

        Args:
            change: (C,) change of the cameras' calibration parameters.

        Returns:
            Whether motions since the references change by more than their noise: the state cannot follow such a jump.
        """
        self._followed = None
        of_depths = np.array([depths_of_pair(self._rig, j) @ change for j in range(len(self._rig.pairs))])
        return any(
            squared_length(np.einsum("jk,jkt", of_depths, motion.by_depth_errors[: len(of_depths)]), motion.covariance)
            > _MAX_JUMP2
            for motion in self._tested_by.values()
            if motion.by_depth_errors is not None
        )

    def with_calibration_covariance(self, visual: VisualResult, estimator: StateEstimator) -> VisualResult:
        """Return a frameset's result whose motions have the covariance that the calibration's errors add.

        Args:
            visual: The front-end's result for the frameset.
            estimator: State estimator that has predicted the state at the frameset.
        """
        pairs = frozenset(j for j, report in visual.pairs.items() if report.inliers)
        self._tested = None if visual.motion is None else _Measured(visual.motion, pairs)
        if self._errors is None:
            return visual
        if visual.motion is None:
            return replace(visual, partial_motion=self._noisier(visual.partial_motion, estimator))
        alternatives = tuple(self._motion_with_covariance(motion, pairs, estimator) for motion in visual.alternatives)
        return replace(
            visual, motion=self._motion_with_covariance(visual.motion, pairs, estimator), alternatives=alternatives
        )

    def _noisier(self, motion: RelativeMotion | None, estimator: StateEstimator) -> RelativeMotion | None:
        """Return a partial motion with that covariance added to its own: the state must not follow its error."""
        if motion is None:
            return None
        motion = self._motion_with_covariance(motion, frozenset(motion.pairs), estimator)
        if motion.calibration_covariance is None:
            return motion
        added = motion.calibration_covariance  # about the same for all motions from this reference
        return replace(
            motion,
            covariance=motion.covariance + added,
            shared_covariance=motion.shared_covariance + _SHARED * added,
            calibration_covariance=None,
        )

    def _motion_with_covariance(
        self, motion: RelativeMotion, pairs: frozenset[int], estimator: StateEstimator
    ) -> RelativeMotion:
        assert self._errors is not None
        since_ns = max(motion.reference_stamp_ns, self._followed_ns)
        now_T_since = estimator.motion_since(since_ns)
        if now_T_since is None:
            return motion
        now = self._velocity  # the predicted state's velocity would come from the IMU under test
        added = self._errors.covariance(se3_inverse(now_T_since), self._velocities.get(since_ns), now)
        followed = self._followed
        if motion.by_depth_errors is not None:
            by_depth_errors = motion.by_depth_errors
            if (
                followed is not None
                and followed.motion.by_depth_errors is not None
                and followed.has_reference_of(motion)
            ):
                by_depth_errors = by_depth_errors - followed.motion.by_depth_errors @ se3_adjoint(now_T_since).T
            added = added + self._errors.of_depths(by_depth_errors)
            velocity = self._followed_velocity
            if velocity is not None and (followed is None or not followed.has_reference_of(motion)):
                # The prediction uses a velocity that was measured with another calibration, or from another reference.
                step_s = (motion.stamp_ns - since_ns) * 1e-9
                added = added + velocity.errors.of_depths(step_s * velocity.by_depths)
        if followed is not None and followed.pairs != pairs:
            for j in followed.pairs ^ pairs:
                added = added + self._errors.of_other_extrinsics(j, motion.reference_T_current)
        return replace(motion, calibration_covariance=added)


def _body_velocity(estimator: StateEstimator) -> Float | None:
    """Return angular and linear velocity (6,) of body in its own frame, or None where the rate is not known."""
    rate = estimator.latest_rate()
    if rate is None:
        return None
    state = estimator.state()
    return np.concatenate([rate, state.nav_T_body[:3, :3].T @ state.velocity_nav])
