"""State estimation by the paper's extended Kalman filter (section 5), the baseline for the smoother."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.ekf.filter import ExtendedKalmanFilter
from graphvio.backend.ekf.measurements import Measurement, VisualRates, accelerometer, gyro, stacked, vision
from graphvio.backend.ekf.process import noise_sigmas
from graphvio.backend.ekf.state import ATTITUDE, ERRORS, GYRO_BIAS, POSITION, RATE, VELOCITY, FilterState
from graphvio.backend.estimator import MeasurementUpdate, StateUpdate
from graphvio.backend.initial_state import AFTER_JUMP, MAX_UNBRIDGED_S, first_state_at
from graphvio.backend.states import RigState, StateCovariance, tilt_covariance
from graphvio.backend.status import StatusMonitor
from graphvio.config import Config
from graphvio.geometry import se3_adjoint, se3_inverse, skew
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import LocatedPoints, RelativeMotion, VisualResult
from graphvio.rig import Rig

_RESET_SIGMA_M = 1e-3  # the position's own standard deviation after a reset
_MIN_GROWTH = 1e-4  # least growth of a pose's covariance from frameset to frameset, as a share of it
_UNKNOWN_RATE_SIGMA_RAD_S = 3.0
_UNKNOWN_SPEED_SIGMA_M_S = 30.0  # includes walking and driving
_GATED = {
    "vision": EventKind.VISION_GATED,
    "gyro": EventKind.GYRO_GATED,
    "accelerometer": EventKind.ACCELEROMETER_GATED,
}


class FilterEstimator:
    """A `graphvio.backend.estimator.StateEstimator` around `ExtendedKalmanFilter`.

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
        self._tracked_ns = 0  # stamp of the last state that vision constrains
        self._final: list[tuple[int, Float]] = []
        self._filter: ExtendedKalmanFilter | None = None
        self._has_imu = False
        self._latest_ns = self._reset_ns = 0
        self._before_ns: int | None = None  # stamp at which the newest step began
        self._refused_ns: int | None = None  # stamp since which vision has been refused
        self._interval: ImuInterval | None = None
        self._reset_covariance = np.zeros((3, 3))  # position covariance, nav, that resets took out of the filter
        self._before_outage = np.zeros((3, 3))  # position covariance, nav, when vision was last used
        self._poses: dict[int, Float] = {}  # nav_T_body at stamps that motions are measured from
        self._covariances: dict[int, Float] = {}  # covariances of these poses at their stamps

    @property
    def is_initialised(self) -> bool:
        """Whether the filter has a state."""
        return self._filter is not None

    @property
    def has_pose(self) -> bool:
        """Whether the filter has a state, which always has a pose."""
        return self.is_initialised

    @property
    def has_imu(self) -> bool:
        """Whether gyro and accelerometer are measured."""
        return self._has_imu

    @property
    def latest_ns(self) -> int:
        """Stamp of the filter's state."""
        return self._latest_ns

    def state(self) -> RigState:
        """Return the filter's state, whose accelerometer bias is zero."""
        state = self._running.state
        return RigState(state.nav_T_body, state.nav_R_body @ state.velocity_body, state.gyro_bias, np.zeros(3))

    def latest_rate(self) -> Float | None:
        """Return the estimated angular rate (3,) rad/s of body, or None at an initialisation."""
        return None if self._before_ns is None else self._running.state.rate_body

    def motion_since(self, then_ns: int) -> Float | None:
        """Return ``now_T_then`` (4, 4) of body since a pose that was kept, or None if it was not."""
        if self._filter is None or then_ns not in self._poses:
            return None
        return se3_inverse(self._filter.state.nav_T_body) @ self._poses[then_ns]

    def covariance_since(self, then_ns: int) -> Float | None:
        """Return the growth (6, 6) of the pose's covariance since then, or None if that pose was not kept.

        A filter has only the newest state, and so no correlation with earlier ones. In directions in which the
        covariance has not grown, a small share of it is returned.
        """
        now_T_then = self.motion_since(then_ns)
        if now_T_then is None:
            return None
        to_now, now = se3_adjoint(now_T_then), self.covariance.pose
        sigmas = np.sqrt(np.diag(now))
        growth = (now - to_now @ self._covariances[then_ns] @ to_now.T) / np.outer(sigmas, sigmas)
        sizes, directions = np.linalg.eigh(growth)
        return np.asarray((directions * np.maximum(sizes, _MIN_GROWTH)) @ directions.T * np.outer(sigmas, sigmas))

    def located_points(self) -> dict[int, LocatedPoints]:
        """Return nothing: the front-end locates the points."""
        return {}

    def take_final(self) -> list[tuple[int, Float]]:
        """Return stamps and poses ``nav_T_body`` since the last call: a filter does not correct them later."""
        taken, self._final = self._final, []
        return taken

    def finish(self) -> None:
        """Do nothing, as all poses are final."""

    # ------------------------------------------------------------------ one frameset

    def add_sample(self, stamp_ns: int, values: Float) -> None:
        """Do nothing: the intervals between framesets have the samples."""

    def initialise(self, stamp_ns: int, imu: tuple[ImuInterval, float] | None) -> None:
        """Create a filter with a first state; if there is a state already, a new epoch begins at its position."""
        position = np.zeros(3)
        if self._filter is not None:
            self.epoch += 1
            self._report(stamp_ns, EventKind.IMU_CAME, f"epoch {self.epoch} begins with gravity pointing down")
            position = self.state().nav_T_body[:3, 3]
        elif self._rig.imu is not None and imu is None:
            self._status.report_no_imu(stamp_ns)
        initial = first_state_at(stamp_ns, position, imu, self._rig, self._config.initialisation)
        pose, uncertainty = initial.state.nav_T_body, initial.uncertainty
        estimates_bias = self._config.filter.bias == "estimated"
        bias = initial.state.gyro_bias if estimates_bias else np.zeros(3)
        covariance = np.zeros((ERRORS, ERRORS))
        covariance[POSITION, POSITION] = pose[:3, :3] @ uncertainty.pose[3:, 3:] @ pose[:3, :3].T
        covariance[ATTITUDE, ATTITUDE] = uncertainty.pose[:3, :3]
        covariance[VELOCITY, VELOCITY] = uncertainty.velocity_m_s**2 * np.eye(3)
        covariance[RATE, RATE] = _UNKNOWN_RATE_SIGMA_RAD_S**2 * np.eye(3)
        if estimates_bias:
            covariance[GYRO_BIAS, GYRO_BIAS] = uncertainty.gyro_bias_rad_s**2 * np.eye(3)
        state = FilterState(pose[:3, 3], pose[:3, :3], np.zeros(3), np.zeros(3), bias)
        self._filter = ExtendedKalmanFilter(state, covariance)
        self._has_imu = imu is not None
        self._latest_ns = self._tracked_ns = self._reset_ns = stamp_ns
        self.initialisations += 1
        self._status.note_initialisation(initial)
        self._status.is_lost, self._interval = False, None
        self._before_ns = self._refused_ns = None
        self._reset_covariance = np.zeros((3, 3))
        self._poses.clear()

    def predict(self, stamp_ns: int, interval: ImuInterval | None) -> bool:
        """Predict by constant velocity; the IMU since the previous frameset is a measurement of the new state."""
        self.gate_results = {}
        config, dt = self._config.filter, (stamp_ns - self._latest_ns) * 1e-9
        is_gap = interval is None and dt > MAX_UNBRIDGED_S
        if is_gap:
            self._reinitialise_after_gap(stamp_ns, dt)
            dt = 0.0
        walk = config.gyro_bias_walk_rad_s if config.bias == "estimated" else 0.0
        sigmas = noise_sigmas(dt, config.accel_sigma_m_s2, config.angular_accel_sigma_rad_s2, walk)
        self._running.predict(dt, sigmas)
        self._interval, self._before_ns, self._latest_ns = interval, self._latest_ns, stamp_ns
        return is_gap

    def apply(self, visual: VisualResult, is_stationary: bool) -> MeasurementUpdate:
        """Gate vision, gyro and accelerometer, update with those that pass; the paper has no zero-velocity update."""
        motion, config = visual.motion, self._config.filter
        if motion is not None and motion.reference_stamp_ns != self._before_ns:
            if self._before_ns is not None and motion.reference_stamp_ns < self._before_ns:
                self._report(
                    motion.stamp_ns,
                    EventKind.MOTION_OVER_SEVERAL_STEPS,
                    "left out: the paper's filter uses the mean velocity of the newest step; use the smoother for "
                    "pairs whose images come in turns",
                )
            motion = None
        is_seen = motion is not None
        rates = None if motion is None else VisualRates.of(motion.with_any_velocity())
        candidates: list[Measurement] = []
        if motion is not None and rates is not None and self._passes_as_vision(motion, rates):
            candidates.append(vision(self._running.state, rates))
        else:
            motion = rates = None
        candidates += [each for each in self._inertial(rates) if self._passes(each)]
        if candidates:
            self._running.update(stacked(candidates))
        if motion is not None or not is_seen:
            self._refused_ns = None
        elif self._refused_ns is None:
            self._refused_ns = self._latest_ns
        elif self._latest_ns - self._refused_ns > config.max_gated_s * 1e9:
            self._reset_velocities()
            self._refused_ns = None
            self._report(self._latest_ns, EventKind.GATE_RESET, "refused for too long: velocities are reinitialised")
        return MeasurementUpdate(motion)

    def update(self, stamp_ns: int, is_constrained: bool, keep: frozenset[int]) -> StateUpdate:
        """Reset the position's covariance if that is due, and keep the poses from which motions are measured."""
        running = self._running
        if stamp_ns - self._reset_ns >= self._config.filter.reset_s * 1e9:
            self._reset_covariance = self._reset_covariance + running.reset_position(_RESET_SIGMA_M)
            self._reset_ns = stamp_ns
        pose = running.state.nav_T_body
        self._poses = {ns: known for ns, known in self._poses.items() if ns in keep} | {stamp_ns: pose}
        self._final.append((stamp_ns, pose))
        position = running.covariance[POSITION, POSITION] + self._reset_covariance
        self.covariance = self._state_covariance(position)
        self._covariances = {ns: self._covariances[ns] for ns in self._poses if ns != stamp_ns}
        self._covariances[stamp_ns] = self.covariance.pose
        if is_constrained:
            if self._status.is_lost:
                self.epoch += 1
                self._report(
                    stamp_ns, EventKind.NEW_EPOCH, f"vision is back: epoch {self.epoch} begins at the predicted pose"
                )
            self._status.is_lost, self._tracked_ns, self._before_outage = False, stamp_ns, position
        sigma = float(np.sqrt(max(np.linalg.eigvalsh(position - self._before_outage)[-1], 0.0)))
        # Motion does not make this filter's attitude better known: an initialisation is over with the first motion.
        return StateUpdate(self._status.status(stamp_ns, is_constrained, sigma, self.has_imu, lambda: ""))

    @property
    def _running(self) -> ExtendedKalmanFilter:
        assert self._filter is not None, "the state is initialised"
        return self._filter

    def _state_covariance(self, position: Float) -> StateCovariance:
        """Return the covariance of the newest state, whose position has a covariance (3, 3) in nav."""
        running = self._running
        state, covariance = running.state, running.covariance
        body_R_nav = state.nav_R_body.T
        pose = np.empty((6, 6))
        pose[:3, :3] = covariance[ATTITUDE, ATTITUDE]
        pose[3:, :3] = body_R_nav @ covariance[POSITION, ATTITUDE]
        pose[:3, 3:] = pose[3:, :3].T
        pose[3:, 3:] = body_R_nav @ position @ body_R_nav.T
        by_error = np.zeros((3, ERRORS))  # Jacobian of the velocity in nav
        by_error[:, VELOCITY] = state.nav_R_body
        by_error[:, ATTITUDE] = -state.nav_R_body @ skew(state.velocity_body)
        velocity = by_error @ covariance @ by_error.T
        if not self._has_imu:
            return StateCovariance(pose, velocity)
        of_level_nav = np.zeros((9, 9))  # the filter's nav is level by definition
        of_level_nav[:6, :6] = pose
        return StateCovariance(
            pose,
            velocity,
            covariance[GYRO_BIAS, GYRO_BIAS],
            gravity=np.zeros((3, 3)),
            tilt=tilt_covariance(self.state(), of_level_nav),
        )

    def _inertial(self, rates: VisualRates | None) -> list[Measurement]:
        """Return those of the gyro's and the accelerometer's measurements over the newest step that are used."""
        interval, config, state = self._interval, self._config.filter, self._running.state
        if interval is None:
            return []
        measured = [accelerometer(state, interval.mean_force, config.gravity_sigma_m_s2)]
        if config.bias == "estimated" or rates is None:
            return [gyro(state, interval.mean_rate, config.gyro_sigma_rad_s), *measured]
        # The paper's first approach: where gyro and vision agree, the gyro's bias must not disturb vision.
        if np.abs(interval.mean_rate - rates.values[3:]).max() > config.gyro_threshold_rad_s:
            measured.append(gyro(state, interval.mean_rate, config.gyro_sigma_rad_s))
        return measured

    def _passes_as_vision(self, motion: RelativeMotion, rates: VisualRates) -> bool:
        """Whether vision passes the chi-square test and implies no impossible acceleration."""
        state, config = self._running.state, self._config.filter
        accel = float(np.linalg.norm(rates.values[:3] - state.velocity_body)) / motion.duration_s
        sigma = np.sqrt(np.linalg.eigvalsh(self._running.covariance[VELOCITY, VELOCITY])[-1])
        is_known = sigma / motion.duration_s < config.max_accel_m_s2  # the velocity, well enough to decide
        if is_known and accel > config.max_accel_m_s2:
            self._report(motion.stamp_ns, EventKind.VISION_GATED, f"asks for an acceleration of {accel:.0f} m/s^2")
            return False
        return self._passes(vision(state, rates))

    def _passes(self, measurement: Measurement) -> bool:
        gate_result = self._running.gate(measurement, self._config.filter.gate_probability)
        self.gate_results[measurement.name] = gate_result
        if not gate_result.accepted:
            self._report(self._latest_ns, _GATED[measurement.name], gate_result.exceedance)
        return gate_result.accepted

    def _reinitialise_after_gap(self, stamp_ns: int, gap_s: float) -> None:
        """Begin an epoch at the last pose, after a gap that nothing bridges."""
        self.epoch += 1
        self._report(
            stamp_ns, EventKind.TIME_JUMP, f"{gap_s:.1f} s without data: epoch {self.epoch} begins at the last pose"
        )
        self._reset_velocities()
        self._running.covariance[POSITION, POSITION] += AFTER_JUMP[3:, 3:]
        self._running.covariance[ATTITUDE, ATTITUDE] += AFTER_JUMP[:3, :3]
        self._status.is_lost, self._tracked_ns, self._refused_ns = False, stamp_ns, None

    def _reset_velocities(self) -> None:
        """Make velocity and angular rate unknown, after a gap, or after the gate has refused vision for too long."""
        running = self._running
        for part, sigma in ((VELOCITY, _UNKNOWN_SPEED_SIGMA_M_S), (RATE, _UNKNOWN_RATE_SIGMA_RAD_S)):
            running.covariance[part, :] = running.covariance[:, part] = 0.0
            running.covariance[part, part] = sigma**2 * np.eye(3)
        running.state = replace(running.state, velocity_body=np.zeros(3), rate_body=np.zeros(3))
