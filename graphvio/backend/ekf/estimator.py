"""What the paper's filter believes of the rig (section 5): the baseline that the smoother is measured against."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.ekf.filter import ExtendedKalmanFilter
from graphvio.backend.ekf.measurements import Measurement, VisualRates, accelerometer, gyro, stacked, vision
from graphvio.backend.ekf.process import noise_sigmas
from graphvio.backend.ekf.state import ATTITUDE, ERRORS, GYRO_BIAS, POSITION, RATE, VELOCITY, FilterState
from graphvio.backend.estimator import StateEstimator
from graphvio.backend.starts import AFTER_JUMP, MAX_UNBRIDGED_S, first_start
from graphvio.backend.states import RigState, StateCovariance
from graphvio.config import Config
from graphvio.geometry import se3_adjoint, se3_inverse, skew
from graphvio.measurements.estimate import Status
from graphvio.measurements.events import Report
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import RelativeMotion, VisualResult
from graphvio.rig import Rig

_ANCHOR_SIGMA_M = 1e-3  # what a reset leaves of the position's own uncertainty
_LEAST_GROWTH = 1e-4  # of a pose's covariance from frameset to frameset, as a share of it
_UNKNOWN_RATE_SIGMA_RAD_S = 3.0
_FORGOTTEN_SPEED_SIGMA_M_S = 30.0  # on foot or on the road


class FilterEstimator(StateEstimator):
    """The rig's state by the filter; for arguments and attributes see `StateEstimator`."""

    def __init__(self, rig: Rig, config: Config, report: Report, rekey: Callable[[], None]) -> None:
        super().__init__(rig, config, report, rekey)
        self._filter: ExtendedKalmanFilter | None = None
        self._has_imu = False
        self._latest_ns = self._reset_ns = 0
        self._before_ns: int | None = None  # stamp at which the newest step began
        self._refused_ns: int | None = None  # since when vision is refused
        self._interval: ImuInterval | None = None
        self._forgotten = np.zeros((3, 3))  # position covariance, nav, that resets took out of the filter
        self._before_outage = np.zeros((3, 3))  # position covariance, nav, when vision was last used
        self._poses: dict[int, Float] = {}  # nav_T_body at stamps that motions are measured from
        self._covariances: dict[int, Float] = {}  # of these poses as they were known then

    # ------------------------------------------------------------------ what is known

    @property
    def has_started(self) -> bool:
        """See `StateEstimator`."""
        return self._filter is not None

    @property
    def has_imu(self) -> bool:
        """See `StateEstimator`."""
        return self._has_imu

    @property
    def latest_ns(self) -> int:
        """See `StateEstimator`."""
        return self._latest_ns

    def state(self) -> RigState:
        """The newest state; the filter knows of no accelerometer bias."""
        state = self._running.state
        return RigState(state.nav_T_body, state.nav_R_body @ state.velocity_body, state.gyro_bias, np.zeros(3))

    def latest_rate(self) -> Float | None:
        """See `StateEstimator`."""
        return None if self._before_ns is None else self._running.state.rate_body

    def motion_since(self, then_ns: int) -> Float | None:
        """See `StateEstimator`."""
        if self._filter is None or then_ns not in self._poses:
            return None
        return se3_inverse(self._filter.state.nav_T_body) @ self._poses[then_ns]

    def covariance_since(self, then_ns: int) -> Float | None:
        """By what the pose's covariance has grown: a filter knows no state but the newest, and so no correlation. In
        directions in which it has not grown, a little remains."""
        now_T_then = self.motion_since(then_ns)
        if now_T_then is None:
            return None
        to_now, now = se3_adjoint(now_T_then), self.covariance.pose
        sigmas = np.sqrt(np.diag(now))
        growth = (now - to_now @ self._covariances[then_ns] @ to_now.T) / np.outer(sigmas, sigmas)
        sizes, directions = np.linalg.eigh(growth)
        return np.asarray((directions * np.maximum(sizes, _LEAST_GROWTH)) @ directions.T * np.outer(sigmas, sigmas))

    def end(self) -> None:
        """See `StateEstimator`: a filter never corrects a pose later."""

    # ------------------------------------------------------------------ one frameset

    def start(self, stamp_ns: int, found: tuple[ImuInterval, float] | None) -> None:
        """See `StateEstimator`."""
        position = self._position_to_start_at(stamp_ns, found)
        start = first_start(stamp_ns, position, found, self._rig, self._config.initialisation)
        pose, uncertainty = start.state.nav_T_body, start.uncertainty
        estimates_bias = self._config.filter.bias == "estimated"
        bias = start.state.gyro_bias if estimates_bias else np.zeros(3)
        covariance = np.zeros((ERRORS, ERRORS))
        covariance[POSITION, POSITION] = pose[:3, :3] @ uncertainty.pose[3:, 3:] @ pose[:3, :3].T
        covariance[ATTITUDE, ATTITUDE] = uncertainty.pose[:3, :3]
        covariance[VELOCITY, VELOCITY] = uncertainty.velocity_m_s**2 * np.eye(3)
        covariance[RATE, RATE] = _UNKNOWN_RATE_SIGMA_RAD_S**2 * np.eye(3)
        if estimates_bias:
            covariance[GYRO_BIAS, GYRO_BIAS] = uncertainty.gyro_bias_rad_s**2 * np.eye(3)
        state = FilterState(pose[:3, 3], pose[:3, :3], np.zeros(3), np.zeros(3), bias)
        self._filter = ExtendedKalmanFilter(state, covariance)
        self._has_imu = found is not None
        self._latest_ns = self._tracked_ns = self._reset_ns = stamp_ns
        self._note_start(start)
        self._lost, self._interval = False, None
        self._before_ns = self._refused_ns = None
        self._forgotten = np.zeros((3, 3))
        self._poses.clear()

    def predict(self, stamp_ns: int, interval: ImuInterval | None) -> None:
        """Go on to a frameset's instant by constant velocity; the IMU since the last one is measured there."""
        self.gate_results = {}
        config, dt = self._config.filter, (stamp_ns - self._latest_ns) * 1e-9
        if interval is None and dt > MAX_UNBRIDGED_S:
            self._jump(stamp_ns, dt)
            dt = 0.0
        walk = config.gyro_bias_walk_rad_s if config.bias == "estimated" else 0.0
        sigmas = noise_sigmas(dt, config.accel_sigma_m_s2, config.angular_accel_sigma_rad_s2, walk)
        self._running.predict(dt, sigmas)
        self._interval, self._before_ns, self._latest_ns = interval, self._latest_ns, stamp_ns

    def use(self, visual: VisualResult, at_rest: bool) -> RelativeMotion | None:
        """Test each measurement against the prediction, and update with those that pass; rest is none of them."""
        motion, config = visual.motion, self._config.filter
        if motion is not None and motion.reference_stamp_ns != self._before_ns:
            if self._before_ns is not None and motion.reference_stamp_ns < self._before_ns:
                self._report(
                    motion.stamp_ns,
                    "motion_over_several_steps",
                    "left out: the paper's filter takes the mean velocity of the newest step; pairs whose images come "
                    "in turns want the smoother",
                )
            motion = None
        sees = motion is not None
        rates = None if motion is None else VisualRates.of(motion)
        offered: list[Measurement] = []
        if motion is not None and rates is not None and self._passes_as_vision(motion, rates):
            offered.append(vision(self._running.state, rates))
        else:
            motion = rates = None
        offered += [each for each in self._inertial(rates) if self._passes(each)]
        if offered:
            self._running.update(stacked(offered))
        if motion is not None or not sees:
            self._refused_ns = None
        elif self._refused_ns is None:
            self._refused_ns = self._latest_ns
        elif self._latest_ns - self._refused_ns > config.max_gated_s * 1e9:
            self._forget_velocities()
            self._refused_ns = None
            self._report(self._latest_ns, "gate_reset", "refused for too long: the velocities are forgotten")
        return motion

    def update(self, stamp_ns: int, used: bool, keep: frozenset[int]) -> Status:
        """Reset the position's covariance, if it is time to, and tell how well the newest state is known."""
        running = self._running
        if stamp_ns - self._reset_ns >= self._config.filter.reset_s * 1e9:
            self._forgotten = self._forgotten + running.reset_position(_ANCHOR_SIGMA_M)
            self._reset_ns = stamp_ns
        pose = running.state.nav_T_body
        self._poses = {ns: known for ns, known in self._poses.items() if ns in keep} | {stamp_ns: pose}
        self._final.append((stamp_ns, pose))
        position = running.covariance[POSITION, POSITION] + self._forgotten
        self.covariance = self._state_covariance(position)
        self._covariances = {ns: self._covariances[ns] for ns in self._poses if ns != stamp_ns}
        self._covariances[stamp_ns] = self.covariance.pose
        if used:
            if self._lost:
                self.epoch += 1
                self._report(stamp_ns, "new_epoch", f"vision is back: epoch {self.epoch} starts at the best guess")
            self._lost, self._tracked_ns, self._before_outage = False, stamp_ns, position
        sigma = float(np.sqrt(max(np.linalg.eigvalsh(position - self._before_outage)[-1], 0.0)))
        return self._status(stamp_ns, used, sigma)

    def _lacking(self) -> str:
        """Nothing but a first motion: to this filter, motion is no help to know the attitude better."""
        return ""

    @property
    def _running(self) -> ExtendedKalmanFilter:
        assert self._filter is not None, "it has started"
        return self._filter

    def _state_covariance(self, position: Float) -> StateCovariance:
        """How well the newest state is known, if its position is to (3, 3) in nav."""
        running = self._running
        state, covariance = running.state, running.covariance
        body_R_nav = state.nav_R_body.T
        pose = np.empty((6, 6))
        pose[:3, :3] = covariance[ATTITUDE, ATTITUDE]
        pose[3:, :3] = body_R_nav @ covariance[POSITION, ATTITUDE]
        pose[:3, 3:] = pose[3:, :3].T
        pose[3:, 3:] = body_R_nav @ position @ body_R_nav.T
        by_error = np.zeros((3, ERRORS))  # of the velocity in nav
        by_error[:, VELOCITY] = state.nav_R_body
        by_error[:, ATTITUDE] = -state.nav_R_body @ skew(state.velocity_body)
        velocity = by_error @ covariance @ by_error.T
        return StateCovariance(pose, velocity, covariance[GYRO_BIAS, GYRO_BIAS] if self._has_imu else None)

    def _inertial(self, rates: VisualRates | None) -> list[Measurement]:
        """The gyro and the accelerometer over the newest step, as far as they are to be used."""
        interval, config, state = self._interval, self._config.filter, self._running.state
        if interval is None:
            return []
        measured = [accelerometer(state, interval.mean_force, config.gravity_sigma_m_s2)]
        if config.bias == "estimated" or rates is None:
            return [gyro(state, interval.mean_rate, config.gyro_sigma_rad_s), *measured]
        # The first approach: where gyro and vision agree, the gyro's bias must not spoil what vision says.
        if np.abs(interval.mean_rate - rates.values[3:]).max() > config.gyro_threshold_rad_s:
            measured.append(gyro(state, interval.mean_rate, config.gyro_sigma_rad_s))
        return measured

    def _passes_as_vision(self, motion: RelativeMotion, rates: VisualRates) -> bool:
        """Whether vision passes the chi-square test and asks for no impossible acceleration."""
        state, config = self._running.state, self._config.filter
        accel = float(np.linalg.norm(rates.values[:3] - state.velocity_body)) / motion.duration_s
        sigma = np.sqrt(np.linalg.eigvalsh(self._running.covariance[VELOCITY, VELOCITY])[-1])
        is_known = sigma / motion.duration_s < config.max_accel_m_s2  # the velocity, well enough to tell
        if is_known and accel > config.max_accel_m_s2:
            self._report(motion.stamp_ns, "vision_gated", f"asks for an acceleration of {accel:.0f} m/s^2")
            return False
        return self._passes(vision(state, rates))

    def _passes(self, measurement: Measurement) -> bool:
        gate_result = self._running.test(measurement, self._config.filter.gate_probability)
        self.gate_results[measurement.name] = gate_result
        if not gate_result.accepted:
            self._report(
                self._latest_ns,
                f"{measurement.name}_gated",
                f"innovation {gate_result.statistic:.1f} beyond chi-square {gate_result.threshold:.1f}",
            )
        return gate_result.accepted

    def _jump(self, stamp_ns: int, gap_s: float) -> None:
        """After a gap that nothing bridges: a new epoch at the last pose, as uncertain as after any such gap."""
        self.epoch += 1
        self._report(stamp_ns, "time_jump", f"{gap_s:.1f} s without data: epoch {self.epoch} starts at the last pose")
        self._forget_velocities()
        self._running.covariance[POSITION, POSITION] += AFTER_JUMP[3:, 3:]
        self._running.covariance[ATTITUDE, ATTITUDE] += AFTER_JUMP[:3, :3]
        self._lost, self._tracked_ns, self._refused_ns = False, stamp_ns, None
        self._rekey()

    def _forget_velocities(self) -> None:
        """What went on unseen, or was refused for long, tells nothing of how the rig moves now."""
        running = self._running
        for part, sigma in ((VELOCITY, _FORGOTTEN_SPEED_SIGMA_M_S), (RATE, _UNKNOWN_RATE_SIGMA_RAD_S)):
            running.covariance[part, :] = running.covariance[:, part] = 0.0
            running.covariance[part, part] = sigma**2 * np.eye(3)
        running.state = replace(running.state, velocity_body=np.zeros(3), rate_body=np.zeros(3))
