"""State estimation by the fixed-lag smoother: innovation tests, updates, and reinitialisation after breaks."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.contradiction import Contradiction
from graphvio.backend.dead_reckoning import DeadReckoning
from graphvio.backend.estimator import MeasurementUpdate, StateUpdate
from graphvio.backend.imu_match import ImuMatch
from graphvio.backend.initial_state import (
    MAX_UNBRIDGED_S,
    InitialState,
    after_failure,
    after_gap,
    after_lost,
    first_state_at,
    from_prediction,
    from_vision,
    with_free_gravity,
    with_inertial_state,
    with_late_imu,
    with_new_imu,
    with_uncertain_position,
    with_wide_attitude,
)
from graphvio.backend.refused_motions import RefusedMotions
from graphvio.backend.smoother import Smoother
from graphvio.backend.states import RigState, StateCovariance
from graphvio.backend.status import StatusMonitor, missing_of
from graphvio.backend.window import SOLVER_ERRORS
from graphvio.config import Config
from graphvio.geometry import se3_inverse, se3_log
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.inertial_state import InertialState
from graphvio.measurements.motion import LocatedPoints, Quality, RelativeMotion, VisualResult
from graphvio.rig import Rig

_MIN_TRUSTED_MOTIONS = 20  # after fewer motions, the attitude of a lost state is not taken over
_MAX_MOTIONS_OF_A_STANDSTILL = 20  # accepted ones after which an assumed standstill is certain
_MIN_AGAINST_STANDSTILL = 3  # refused motions that disprove an assumed standstill, if the first is weak
_MIN_GAP_S = 0.5  # longer gaps of vision let an IMU with a wrong rig file spoil velocity and tilt
_MIN_AFTER_GAP = 2  # refused good motions after such a gap, from which on they are used
_MAX_TILT_RATIO = 2.0  # ratio of sigmas: a state with a wrong calibration has too small ones
_MIN_OFF2 = 21.0  # squared Mahalanobis distance (12 dimensions) of a state that is replaced: 5 % exceed it by chance
_MAX_PARTIAL_STATISTIC = 25.0  # squared Mahalanobis distance (up to 6 dimensions): once in 3000 by chance
_CONSTANT_VELOCITY_SCALE = 3.0  # factor on its sigmas in the gate: fast hand-held cameras often violate it


class SmootherEstimator:
    """A `graphvio.backend.estimator.StateEstimator` around `graphvio.backend.smoother.Smoother`.

    Args:
        rig: Cameras and IMU.
        config: Configuration of all stages.
        report: Receives events.
    """

    def __init__(self, rig: Rig, config: Config, report: Report) -> None:
        self.epoch = 0
        self.covariance = StateCovariance(np.zeros((6, 6)))
        self.gate_results: dict[str, GateResult] = {}
        self.initialisations = 0
        self._rig = rig
        self._config = config
        self._report = report
        self._status = StatusMonitor(config.smoother.lost_position_sigma_m, report)
        self._smoother: Smoother | None = None
        self._contradiction = Contradiction()
        self._dead_reckoning = DeadReckoning()
        self._reset_ns = 0
        self._tracked_ns = 0  # stamp of the last state that vision constrains
        self._accepted = 0  # motions since the initialisation
        self._refused = RefusedMotions()
        self._are_points_wrong = False  # whether points of partial motions were, since the last good motion
        self._is_predicted_by_imu = False  # whether the newest state is
        self._is_imu_left_out = False
        self._is_standstill_assumed = False  # from the IMU alone, which cannot show a steady motion
        self._tracked_covariance = np.zeros((6, 6))  # covariance of the last pose that vision constrains
        self._sigma_m = 0.0  # sigma of the position since vision last constrained it
        self._rebuilt_sigma_m = 0.0  # the same at a rebuild of the window since then, or zero
        self._kept_ns: frozenset[int] = frozenset()  # stamps of states from which motions are asked for
        self._carried: dict[int, tuple[Float, Float]] = {}  # motions since states that were discarded
        self._final: list[tuple[int, Float]] = []

    @property
    def is_initialised(self) -> bool:
        """Whether the smoother has a state."""
        return self._smoother is not None

    @property
    def has_pose(self) -> bool:
        """Whether the smoother has a state, which always has a pose."""
        return self.is_initialised

    @property
    def has_imu(self) -> bool:
        """Whether velocities and biases are estimated."""
        return self._smoother is not None and self._smoother.has_imu

    @property
    def latest_ns(self) -> int:
        """Stamp of the newest state of the window."""
        return self._running.latest_ns

    def state(self) -> RigState:
        """Return the newest state of the window."""
        return self._running.state()

    def latest_rate(self) -> Float | None:
        """Return the mean angular rate (3,) rad/s between the window's two newest states, or None if there is one."""
        return self._running.latest_rate()

    def motion_since(self, then_ns: int) -> Float | None:
        """Return ``now_T_then`` (4, 4) between two states of the window, or None if the earlier one has left it."""
        smoother = self._smoother
        if smoother is None or not smoother.knows(then_ns):
            return self._carried[then_ns][0] if then_ns in self._carried else None
        return se3_inverse(smoother.pose(smoother.latest_ns)) @ smoother.pose(then_ns)

    def covariance_since(self, then_ns: int) -> Float | None:
        """Return the joint posterior's covariance (6, 6) of `motion_since`, or None if the window has none."""
        smoother = self._smoother
        if smoother is None or not smoother.knows(then_ns):
            return self._carried[then_ns][1] if then_ns in self._carried else None
        try:
            return smoother.covariance_since(then_ns)
        except SOLVER_ERRORS:
            return None

    def located_points(self) -> dict[int, LocatedPoints]:
        """Return nothing: the front-end locates the points."""
        return {}

    def take_final(self) -> list[tuple[int, Float]]:
        """Return stamps and poses ``nav_T_body`` that left the window since the last call."""
        taken, self._final = self._final, []
        return taken

    def finish(self) -> None:
        """Declare all poses of the window final."""
        if self._smoother is not None:
            self._final += self._smoother.all_poses()

    # ------------------------------------------------------------------ one frameset

    def add_sample(self, stamp_ns: int, values: Float) -> None:
        """Do nothing: the intervals between framesets have the samples."""

    def initialise(self, stamp_ns: int, imu: tuple[ImuInterval, float] | None) -> None:
        """Create a smoother with one state."""
        if self._rig.imu is not None and imu is None:
            self._status.report_no_imu(stamp_ns)
        self._smoother = Smoother(self._config.smoother, self._rig.imu if imu else None)
        initial = first_state_at(stamp_ns, np.zeros(3), imu, self._rig, self._config.initialisation)
        self._initialise_at(with_free_gravity(initial) if imu else initial)
        self._is_standstill_assumed = imu is not None and initial.is_known

    def predict(self, stamp_ns: int, interval: ImuInterval | None) -> bool:
        """Extend the window by the IMU, or by constant velocity; a gap that neither bridges ends the epoch."""
        self.gate_results, self._carried = {}, {}
        if interval is None and stamp_ns - self.latest_ns > MAX_UNBRIDGED_S * 1e9:
            self._reinitialise_after_gap(stamp_ns)
            return True
        if self.has_imu and interval is None:
            self._refused.note_missing_imu()
        self._is_predicted_by_imu = self.has_imu and interval is not None
        before = self.state()
        try:
            self._running.extend(stamp_ns, interval)
            self._dead_reckoning.predict(stamp_ns, interval)
        except SOLVER_ERRORS as error:
            self._rebuild(stamp_ns, before, error)
            return True
        return False

    def apply(self, visual: VisualResult, is_stationary: bool) -> MeasurementUpdate:
        """Gate the relative motion and the zero velocity, and insert those that pass into the window."""
        try:
            update = self._apply_motion(visual)
            if is_stationary and self.has_imu:
                self._apply_zero_velocity()
        except SOLVER_ERRORS as error:
            self._rebuild(self.latest_ns, self.state(), error)
            return MeasurementUpdate(None, needs_keyframe=True)
        return update

    def update(self, stamp_ns: int, is_constrained: bool, keep: frozenset[int]) -> StateUpdate:
        """Optimise the window and marginalise; a window without a solution is rebuilt around the prediction."""
        smoother, is_rebuilt = self._running, False
        self._kept_ns = keep
        if is_constrained:
            self._tracked_ns = stamp_ns
        try:
            self._final += smoother.update(keep | {self._tracked_ns})
            self._reset_position(stamp_ns)
            self.covariance = smoother.state_covariance()
            if is_constrained:
                self._tracked_covariance = self.covariance.pose
                self._sigma_m = self._rebuilt_sigma_m = 0.0
            else:
                since = smoother.covariance_since(self._tracked_ns)
                self._sigma_m = float(np.hypot(np.sqrt(np.linalg.eigvalsh(since[3:, 3:])[-1]), self._rebuilt_sigma_m))
        except SOLVER_ERRORS as error:
            self._rebuild(stamp_ns, smoother.state(), error)
            with suppress(*SOLVER_ERRORS):
                self.covariance = self._running.state_covariance()
            is_constrained, is_rebuilt = False, True
        status = self._status.status(
            stamp_ns,
            is_constrained,
            self._sigma_m,
            self.has_imu,
            lambda: "" if self._is_imu_left_out else missing_of(self.covariance, self._config.initialisation),
        )
        return StateUpdate(status, needs_keyframe=is_rebuilt)

    def leave_imu_out(self) -> None:
        """Stop waiting for the IMU until `use_imu_again`: the initialisation needs no tilt and velocity from it."""
        self._is_imu_left_out = True

    def pose_by_vision(self) -> Float:
        """Return ``nav_T_body`` (4, 4) of the newest state; while motions are refused, the pose that these lead to."""
        return self._refused.nav_T_body.get(self.latest_ns, self.state().nav_T_body)

    def distrust_prediction(self) -> None:
        """Mark the prediction as wrong, after an error of the IMU's calibration, if motions are being refused.

        The next motion of good quality then resets the state. Gyro bias and attitude become uncertain, as they have
        followed wrong samples; when motions are only refused for too long, roll and pitch do not.
        """
        self._refused.distrust_prediction()
        self._dead_reckoning.restart()

    def use_imu_again(self, motion: RelativeMotion, match: ImuMatch) -> None:
        """Use the IMU again after it was left out: keep the newest pose, and reset velocity, biases and gravity.

        Args:
            motion: A motion by vision that ends in the newest state.
            match: Result of the comparison of the IMU with vision; has the gyro bias and gravity.
        """
        self._is_imu_left_out = False
        try:
            initial = with_new_imu(motion, match, self.state(), self.covariance)
            self._reinitialise(initial, self.latest_ns - 1)
            self.covariance = self._running.state_covariance()
        except SOLVER_ERRORS as error:
            self._rebuild(self.latest_ns, self.state(), error)

    def use_inertial_state(self, known: InertialState) -> bool:
        """Replace velocity, biases and gravity by those known at a keyframe of the window, if the two disagree.

        The keyframe's values must be about as well known: the standard deviation of their tilt is below twice that of
        the state. A state that agrees with them stays as it is, since a new window ends the keyframe.

        Returns:
            Whether the state was replaced.
        """
        smoother, tilt = self._running, self.covariance.tilt
        if not self.has_imu or self._is_imu_left_out or self._refused or self._status.is_lost or tilt is None:
            return False
        is_known = known.tilt_sigma_rad < _MAX_TILT_RATIO * np.sqrt(np.linalg.eigvalsh(tilt)[-1])
        if not is_known or not smoother.knows(known.stamp_ns):
            return False
        try:
            smoother.optimize()
            then, now, covariance = smoother.state(known.stamp_ns), smoother.state(), smoother.state_covariance()
            body_R_nav = then.nav_T_body[:3, :3].T
            off2 = known.distance2(
                body_R_nav @ then.velocity_nav, then.accel_bias, then.gyro_bias, body_R_nav @ then.gravity_nav
            )
            if off2 < _MIN_OFF2:  # they agree: nothing would be gained
                return False
            blind_s = 1e-9 * (smoother.latest_ns - self._tracked_ns)
            initial = with_inertial_state(known, then, smoother.latest_ns, now, blind_s, covariance)
            self._carry_motions(initial.state.nav_T_body)
            self._final += smoother.all_poses()[:-1]
            smoother.initialise(initial.stamp_ns, initial.state, initial.uncertainty)
            self._dead_reckoning.restart()
            self._tracked_ns, self._rebuilt_sigma_m = initial.stamp_ns, self._sigma_m
            self.covariance = smoother.state_covariance()
        except SOLVER_ERRORS as error:
            self._rebuild(self.latest_ns, self.state(), error)
        return True

    def _carry_motions(self, nav_T_newest: Float) -> None:
        """Keep the motions from the references and the last keyframe to the newest state, until the next prediction."""
        motions = {}
        for then_ns in self._kept_ns:
            covariance = self.covariance_since(then_ns)
            if covariance is not None:
                motions[then_ns] = (se3_inverse(nav_T_newest) @ self._running.pose(then_ns), covariance)
        self._carried = motions

    def use_late_imu(self, motion: RelativeMotion, imu: tuple[ImuInterval, float]) -> None:
        """Use the IMU from now on, after an initialisation without it: keep the newest pose, and take gravity from it.

        Args:
            motion: A motion by vision that ends in the newest state.
            imu: The IMU readings around the state, and the state's time in that interval, seconds.
        """
        stamp_ns, state = self.latest_ns, self.state()
        first = first_state_at(stamp_ns, np.zeros(3), imu, self._rig, self._config.initialisation)
        self._final += [(ns, pose) for ns, pose in self._running.all_poses() if ns < stamp_ns]
        self._smoother = Smoother(self._config.smoother, self._rig.imu)
        self._report(stamp_ns, EventKind.IMU_CAME, "it is used from now on, and the path goes on")
        try:
            self._initialise_at(with_late_imu(first, motion, state, self.covariance))
            self.covariance = self._running.state_covariance()
        except SOLVER_ERRORS as error:
            self._rebuild(stamp_ns, state, error)

    # ------------------------------------------------------------------ measurement update

    def _apply_motion(self, visual: VisualResult) -> MeasurementUpdate:
        """Insert the motion if it passes the gate; reinitialise after lost, or after refusing for too long."""
        smoother, motion = self._running, visual.motion
        if motion is None:
            return self._apply_partial_motion(visual.partial_motion)
        if not smoother.knows(motion.reference_stamp_ns):  # the state was reinitialised since then
            return MeasurementUpdate(None, needs_keyframe=True)
        if self._status.is_lost and (motion.reference_stamp_ns > self._tracked_ns or self._rebuilt_sigma_m):
            # The motion begins at a state that vision did not constrain.
            self._reinitialise_after_lost(motion)
            return MeasurementUpdate(motion, needs_keyframe=True)
        is_tested = self._is_predicted_by_imu and not self._is_imu_left_out
        followed = self._dead_reckoning.pairs_to_follow(visual, smoother) if is_tested else ()
        motion, gate_result = self._contradiction.resolve(visual, smoother.gate, self.has_imu, followed)
        if not gate_result.accepted and not self.has_imu:
            gate_result = smoother.gate(motion, _CONSTANT_VELOCITY_SCALE)
        self.gate_results["vision"] = gate_result
        excess = smoother.excess_acceleration(motion)
        if gate_result.accepted and excess is None:
            if visual.quality is Quality.GOOD:
                self._are_points_wrong = False
            return self._accept(motion)
        why = gate_result.exceedance if excess is None else f"asks for an acceleration of {excess:.0f} m/s^2"
        self._report(motion.stamp_ns, EventKind.VISION_GATED, f"{why}, {motion.inliers} inliers")
        if visual.quality is not Quality.GOOD and not self._may_be_moving:
            # Weak vision cannot refute the prediction, except that of a standstill that was only assumed.
            return MeasurementUpdate(None)
        return self._refuse(motion, visual.quality)

    def _apply_partial_motion(self, motion: RelativeMotion | None) -> MeasurementUpdate:
        """Correct the state that the IMU predicts by the motion of a few points, if it passes the gate.

        The frameset still counts as one without vision. Where the motion is not used, a new keyframe is asked for.
        """
        if motion is None:
            return MeasurementUpdate(None)
        is_predicted = self._is_predicted_by_imu and not (
            self._is_imu_left_out or self._refused or self._status.is_lost
        )
        if not is_predicted or not self._running.knows(motion.reference_stamp_ns):
            return MeasurementUpdate(None, needs_keyframe=True)
        # A few points may all be on a person who walks by.
        self._are_points_wrong |= not self._running.gate(motion).statistic <= _MAX_PARTIAL_STATISTIC
        if self._are_points_wrong:
            return MeasurementUpdate(None, needs_keyframe=True)
        self._running.add_partial_motion(motion)
        return MeasurementUpdate(None, partial_motion=motion)

    def _accept(self, motion: RelativeMotion) -> MeasurementUpdate:
        """Insert a motion that passes the gate; reinitialise if it begins at a state whose own motion was refused."""
        if motion.reference_stamp_ns not in self._refused.nav_T_body:
            self._running.add_motion(motion)
            self._accepted += 1
            self._note_accepted()
            return MeasurementUpdate(motion)
        # The motion agrees with the prediction only because both start from a state that vision did not constrain.
        self._refused.add(motion, self._running.pose, self._tracked_ns)
        if self._refused.is_distrusted or self._refused.has_imu_failed:
            self._reinitialise_from_vision(motion, "the IMU failed while vision was refused")
        else:
            self._reinitialise_from_prediction(motion)
        return MeasurementUpdate(motion, needs_keyframe=True)

    def _refuse(self, motion: RelativeMotion, quality: Quality) -> MeasurementUpdate:
        """Leave out a motion that the gate refuses, or reinitialise from vision if the prediction has proved wrong."""
        refused = self._refused
        refused.add(motion, self._running.pose, self._tracked_ns)
        is_first_good = quality is Quality.GOOD and self._accepted == 0  # no motion has agreed with a standstill
        if self._may_be_moving and (is_first_good or len(refused) >= _MIN_AGAINST_STANDSTILL):
            refused.distrust_prediction()
            why = "it was initialised in a steady motion, as at a standstill"
        elif self._gap_s > _MIN_GAP_S and not self._may_be_moving and len(refused) >= _MIN_AFTER_GAP:
            refused.distrust_prediction()
            why = f"refused after {self._gap_s:.1f} s that the IMU alone has bridged"
        elif refused.is_distrusted:
            why = "the IMU was corrected wrongly while vision was refused"
        elif motion.stamp_ns - refused.first_ns > self._config.smoother.max_gated_s * 1e9:
            why = "refused for too long"
        else:
            return MeasurementUpdate(None)
        self._reinitialise_from_vision(motion, why)
        return MeasurementUpdate(motion, needs_keyframe=True)

    def _apply_zero_velocity(self) -> None:
        gate_result = self._running.gate_zero_velocity()
        self.gate_results["zero_velocity"] = gate_result
        if gate_result.accepted:
            self._running.add_zero_velocity()
        else:
            self._report(self.latest_ns, EventKind.ZERO_VELOCITY_GATED, gate_result.exceedance)

    def _reset_position(self, stamp_ns: int) -> None:
        """Reset the position's own uncertainty from time to time, see `Smoother.reset_position`."""
        if stamp_ns - self._reset_ns >= self._config.smoother.reset_s * 1e9:
            self._running.reset_position()
            self._reset_ns = stamp_ns

    # ------------------------------------------------------------------ breaks

    def _rebuild(self, stamp_ns: int, state: RigState, error: Exception) -> None:
        """Replace a window that has no solution by a new one around a state; status and epoch stay as they are."""
        self._report(stamp_ns, EventKind.WINDOW_REBUILT, str(error))
        was_lost, sigma_m = self._status.is_lost, self._sigma_m
        self._reinitialise(after_failure(stamp_ns, state, self.covariance), stamp_ns - 1)
        self._status.is_lost, self._sigma_m, self._rebuilt_sigma_m = was_lost, sigma_m, sigma_m

    def _reinitialise_after_gap(self, stamp_ns: int) -> None:
        """Begin an epoch at the last pose, after a pause or a jump of the clock that nothing bridges."""
        last_ns = self.latest_ns
        self._reinitialise(after_gap(stamp_ns, self.state(), self.covariance), last_ns)
        self.epoch += 1
        gap_s = (stamp_ns - last_ns) * 1e-9
        self._report(
            stamp_ns, EventKind.TIME_JUMP, f"{gap_s:.1f} s without data: epoch {self.epoch} begins at the last pose"
        )

    def _reinitialise_after_lost(self, motion: RelativeMotion) -> None:
        """Begin an epoch at the predicted pose, with the velocity of the first motion after the estimate was lost."""
        smoother = self._running
        initial = after_lost(motion, smoother.state(), smoother.state_covariance())
        if self.has_imu and self._accepted < _MIN_TRUSTED_MOTIONS:
            initial = with_wide_attitude(initial)
        self._reinitialise(initial, self._tracked_ns)
        self.epoch += 1
        self._report(
            motion.stamp_ns,
            EventKind.NEW_EPOCH,
            f"vision is back: epoch {self.epoch} begins at the predicted pose",
        )

    def _reinitialise_from_vision(self, motion: RelativeMotion, why: str) -> None:
        """Reinitialise at the pose that a chain of refused motions leads to: the prediction is wrong.

        The chain begins at a state that vision constrained, or after a gap that the IMU alone has bridged. Unless the
        IMU is known to have failed at that moment, or was corrected wrongly, the pose is uncertain by its difference
        from the prediction.
        """
        refused, nav_T_body = self._refused, self._refused.nav_T_body[motion.stamp_ns]
        predicted = self._running.state()
        has_failed = refused.is_distrusted or (refused.has_imu_failed and not self._is_imu_left_out)
        initial = from_vision(
            motion, nav_T_body, predicted, self._tracked_covariance, self.covariance.gravity, has_failed
        )
        if refused.is_distrusted:
            initial = with_wide_attitude(initial)
        if self._gap_s > _MIN_GAP_S and refused.is_after_gap:
            # The velocity's error grew during the gap: its mean, half of the final error, displaced the position.
            off_m_s = float(np.linalg.norm(initial.state.velocity_nav - predicted.velocity_nav))
            initial = with_uncertain_position(initial, 0.5 * off_m_s * self._gap_s)
        self._reinitialise(initial, self._tracked_ns)
        apart_m = np.linalg.norm(se3_log(se3_inverse(nav_T_body) @ predicted.nav_T_body)[3:])
        self._report(
            motion.stamp_ns,
            EventKind.GATE_RESET,
            f"{why}: the state is reinitialised from vision, {apart_m:.3f} m from the prediction",
        )

    def _reinitialise_from_prediction(self, motion: RelativeMotion) -> None:
        """Reinitialise at the prediction where refused motions are followed by one that agrees with it.

        Whether vision or the IMU was wrong until then is not known: the pose is uncertain by their difference.
        """
        nav_T_body, predicted = self._refused.nav_T_body[motion.stamp_ns], self._running.state()
        initial = from_prediction(motion, nav_T_body, predicted, self._tracked_covariance, self.covariance.gravity)
        self._reinitialise(initial, self._tracked_ns)
        apart = se3_log(se3_inverse(nav_T_body) @ predicted.nav_T_body)
        self._report(
            motion.stamp_ns,
            EventKind.GATE_RESET,
            "vision was refused, and agrees again: the state is reinitialised at the prediction, which is "
            f"{np.linalg.norm(apart[3:]):.3f} m and {np.rad2deg(np.linalg.norm(apart[:3])):.2f} deg elsewhere",
        )

    def _reinitialise(self, initial: InitialState, last_final_ns: int) -> None:
        """Replace the window; its poses up to a stamp are final, and the later ones are discarded."""
        self._final += [(ns, pose) for ns, pose in self._running.all_poses() if ns <= last_final_ns]
        self._initialise_at(initial)

    def _initialise_at(self, initial: InitialState) -> None:
        self._accepted = 0
        self._is_standstill_assumed = self._are_points_wrong = False
        self._running.initialise(initial.stamp_ns, initial.state, initial.uncertainty)
        self._dead_reckoning = DeadReckoning()
        self._reset_ns = initial.stamp_ns
        self.initialisations += 1
        self._status.note_initialisation(initial)
        self._tracked_ns = initial.stamp_ns
        self._sigma_m = self._rebuilt_sigma_m = 0.0
        self._note_accepted()

    def _note_accepted(self) -> None:
        """Record that vision is accepted: nothing is refused any more, and the estimate is not lost."""
        self._refused.clear()
        self._status.is_lost = False

    @property
    def _gap_s(self) -> float:
        """Time over which the IMU alone had measured the motion when vision was first refused, seconds."""
        if not self.has_imu or self._is_imu_left_out or not self._refused:
            return 0.0
        return 1e-9 * (self._refused.first_ns - self._tracked_ns)

    @property
    def _may_be_moving(self) -> bool:
        """Whether the initialisation assumed a standstill, and there were too few motions yet to confirm it."""
        return self._is_standstill_assumed and self._accepted < _MAX_MOTIONS_OF_A_STANDSTILL

    @property
    def _running(self) -> Smoother:
        assert self._smoother is not None, "the state is initialised"
        return self._smoother
