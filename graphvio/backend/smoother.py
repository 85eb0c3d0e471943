"""A fixed-lag smoother over poses, velocities and IMU biases at frameset times (section 5).

Its calls mirror a filter's. `extend` predicts, from the IMU or by constant velocity (eq. 11); `gate` tests the
innovation of a relative motion; `add_motion` and `update` are the measurement update; `initialise` resets. Its model is
preintegration, not eq. (13).
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.factors import (
    b,
    constant_velocity,
    first_state,
    g,
    gravity,
    imu_without_samples,
    position_reset,
    v,
    x,
    zero_velocity,
    zero_velocity_noise,
)
from graphvio.backend.gating import excess, gate_innovation, gate_motion, relative_covariance
from graphvio.backend.noise import gaussian, robust
from graphvio.backend.preintegration import interval_params, is_as_stated, preintegrate, preintegration_params
from graphvio.backend.readout_factor import corrected, jacobians_of, readout_factor
from graphvio.backend.reference_views import ReferenceViews
from graphvio.backend.states import InitialUncertainty, RigState, StateCovariance, level_gravity, tilt_covariance
from graphvio.backend.window import SOLVER_ERRORS, GraphWindow
from graphvio.config.stages import SmootherConfig
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log, skew
from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import ByVelocities, RelativeMotion
from graphvio.rig import Imu

_UNKNOWN_RATE_SIGMA_RAD_S = 1.0
_DEFINED_SIGMA = 1e-5  # of a pose that defines nav, radians and metres
_RESET_SIGMA_M = 1e-3  # the position's own standard deviation after a reset
_POSE_AND_GRAVITY = np.r_[0:6, 15:18]
_MAX_ADVANCED = 2  # framesets in a row for which the window is not solved as a whole


class Smoother:
    """Poses, and with an IMU velocities and biases, over the last seconds.

    Args:
        config: Configuration of the smoother.
        imu: Noise of the IMU, or None without one.
    """

    def __init__(self, config: SmootherConfig, imu: Imu | None) -> None:
        self._config = config
        self._imu = imu
        self._params = None if imu is None else preintegration_params(imu, config.imu_noise_scale)
        self._window = self._new_window()
        self._stamps: list[int] = []
        self._advanced = 0  # framesets since the window was solved as a whole
        self._index = 0
        self._index_of: dict[int, int] = {}
        self._views = ReferenceViews()
        self._previous_motion = np.zeros(6)  # tangent per second
        self._step_s = 0.0  # between the two newest states
        self._constrained_ns = 0  # stamp of the newest state whose motion was measured
        self._seen_ns: int | None = None  # the same, by vision
        self._nav_covariance = np.zeros((6, 6))  # of nav itself, as a left perturbation: only reported
        self._has_rolling_shutter = False  # motions depend on the velocities of their references
        self._rate_sigmas = np.zeros(2)  # of `_previous_motion`: rad/s and m/s

    @property
    def has_imu(self) -> bool:
        """Whether velocities and biases are estimated."""
        return self._imu is not None

    @property
    def latest_ns(self) -> int:
        """Stamp of the newest state."""
        return self._stamps[-1]

    @property
    def previous_ns(self) -> int | None:
        """Stamp of the state before the newest one, or None if there is one state."""
        return self._stamps[-2] if len(self._stamps) > 1 else None

    def from_state(self, stamp_ns: int) -> Smoother:
        """Return a smoother with only the state of a stamp, whose pose defines nav; for a smoother with an IMU."""
        k, state = self._index_of[stamp_ns], self.state(stamp_ns)
        joint = self._window.joint_covariance([x(k), v(k), b(k), g()])
        of_inertial = np.hstack([np.zeros((12, 6)), np.eye(12)])
        nav_R_body = state.nav_T_body[:3, :3]
        for rows, vector in ((slice(0, 3), state.velocity_nav), (slice(9, 12), state.gravity_nav)):
            of_inertial[rows, :3] = nav_R_body @ skew(nav_R_body.T @ vector)
        pose = np.eye(6) * _DEFINED_SIGMA**2
        uncertainty = InitialUncertainty(pose, 0.0, 0.0, inertial=np.asarray(of_inertial @ joint @ of_inertial.T))
        alone = Smoother(self._config, self._imu)
        alone.initialise(stamp_ns, state, uncertainty)
        return alone

    def initialise(self, stamp_ns: int, state: RigState, uncertainty: InitialUncertainty) -> None:
        """Replace the window by one with a single state."""
        self._window, self._advanced = self._new_window(), 0
        self._stamps, self._index_of, self._views = [], {}, ReferenceViews()
        velocity_body = state.nav_T_body[:3, :3].T @ state.velocity_nav
        self._previous_motion = np.concatenate([np.zeros(3), velocity_body])
        self._rate_sigmas = np.array([_UNKNOWN_RATE_SIGMA_RAD_S, uncertainty.velocity_m_s])
        k = self._append(stamp_ns, state)
        self._constrained_ns, self._seen_ns = stamp_ns, None
        to_nav = se3_adjoint(state.nav_T_body)
        self._nav_covariance = to_nav @ uncertainty.nav_covariance @ to_nav.T
        if self.has_imu:
            self._window.values.insert(g(), state.gravity_nav)
        for factor in first_state(k, state, uncertainty, self.has_imu):
            self._window.add(factor)
        if self.has_imu:
            for factor in gravity(state.gravity_nav, uncertainty):
                self._window.add(factor)

    def extend(self, stamp_ns: int, interval: ImuInterval | None) -> RigState:
        """Predict the next state, by the IMU or without an interval by constant velocity, and append it."""
        i = self._index_of[self.latest_ns]
        # Stamps by two cameras' clocks may differ by more, or less, than the instants of their images.
        dt = self._step_s = 1e-9 * (stamp_ns - self.latest_ns if interval is None else interval.duration_ns)
        before = self.state()
        if interval is None or self._imu is None or self._params is None:
            motion = se3_exp(self._previous_motion * dt)
            state = replace(before, nav_T_body=before.nav_T_body @ motion)
            j = self._append(stamp_ns, state)
            self._link_by_constant_velocity(i, j, motion, dt)
            return state
        bias = gtsam.imuBias.ConstantBias(before.accel_bias, before.gyro_bias)
        params, noise_scale = self._params, self._config.imu_noise_scale
        if not is_as_stated(interval, self._imu, noise_scale):
            params = interval_params(interval, self._imu, noise_scale, before)
        measurements = preintegrate(interval, params, bias)
        predicted = measurements.predict(gtsam.NavState(gtsam.Pose3(before.nav_T_body), before.velocity_nav), bias)
        beyond = before.gravity_nav - level_gravity()  # gtsam predicts with level gravity
        pose = predicted.pose().matrix()
        pose[:3, 3] += 0.5 * dt**2 * beyond
        state = replace(before, nav_T_body=pose, velocity_nav=np.asarray(predicted.velocity()) + dt * beyond)
        j = self._append(stamp_ns, state)
        self._constrained_ns = stamp_ns
        self._window.add(
            gtsam.CombinedImuFactorWithGravityVector(x(i), v(i), x(j), v(j), b(i), b(j), g(), measurements)
        )
        return state

    def knows(self, stamp_ns: int) -> bool:
        """Whether there is a state with this stamp in the window."""
        return stamp_ns in self._index_of

    def pose(self, stamp_ns: int) -> Float:
        """Return ``nav_T_body`` (4, 4) of a state in the window, as it was last solved for."""
        return np.asarray(self._window.values.atPose3(x(self._index_of[stamp_ns])).matrix())

    def state(self, stamp_ns: int | None = None) -> RigState:
        """Return the newest state, or that of a stamp in the window."""
        k = self._index_of[self.latest_ns if stamp_ns is None else stamp_ns]
        values = self._window.values
        pose = np.asarray(values.atPose3(x(k)).matrix())
        if not self.has_imu:
            return RigState(pose, pose[:3, :3] @ self._previous_motion[3:], np.zeros(3), np.zeros(3))
        bias = values.atConstantBias(b(k))
        return RigState(
            pose,
            np.asarray(values.atVector(v(k))),
            np.asarray(bias.gyroscope()),
            np.asarray(bias.accelerometer()),
            np.asarray(values.atVector(g())),
        )

    def latest_rate(self) -> Float | None:
        """Return the mean angular rate (3,) rad/s of body between the two newest states, or None when there is one."""
        return self._previous_motion[:3] if len(self._stamps) > 1 else None

    def covariance(self) -> Float:
        """Return the covariance (6, 6) of the newest pose, tangent ``[rotation, translation]`` in body."""
        return self._with_nav(self._window.joint_covariance([x(self._index_of[self.latest_ns])]))

    def state_covariance(self) -> StateCovariance:
        """Return the covariance of the newest state."""
        k = self._index_of[self.latest_ns]
        if not self.has_imu:
            return StateCovariance(self.covariance())
        joint = self._window.joint_covariance([x(k), v(k), b(k), g()])
        return StateCovariance(
            pose=self._with_nav(joint[:6, :6]),
            velocity=joint[6:9, 6:9],
            gyro_bias=joint[12:15, 12:15],
            accel_bias=joint[9:12, 9:12],
            gravity=joint[15:, 15:],
            tilt=tilt_covariance(self.state(), joint[np.ix_(_POSE_AND_GRAVITY, _POSE_AND_GRAVITY)]),
        )

    def covariance_since(self, stamp_ns: int) -> Float:
        """Return the covariance (6, 6) of the motion from a kept state to the newest one, in the newest body frame."""
        i, j = self._index_of[stamp_ns], self._index_of[self.latest_ns]
        if i == j:
            return np.zeros((6, 6))
        relative = se3_inverse(self.pose(stamp_ns)) @ self.pose(self.latest_ns)
        return relative_covariance(relative, self._window.joint_covariance([x(i), x(j)]))

    def gate(self, motion: RelativeMotion, sigma_scale: float = 1.0) -> GateResult:
        """Test the innovation of a motion that ends in the newest state against the window's prediction.

        Args:
            motion: A motion by vision.
            sigma_scale: Factor on the standard deviations of the prediction.
        """
        newest = x(self._index_of[motion.stamp_ns])
        reference, covariance = self._views.seen(self._index_of[motion.reference_stamp_ns], motion)
        if motion.calibration_covariance is not None:
            covariance = covariance + motion.calibration_covariance
        nav_T_reference = np.asarray(self._window.values.atPose3(reference).matrix())
        predicted, measured = se3_inverse(nav_T_reference) @ self.pose(motion.stamp_ns), motion.reference_T_current
        if motion.by_velocities is None:
            of_state = relative_covariance(predicted, self._window.joint_covariance([reference, newest]))
        else:
            measured, of_state = self._with_velocities(motion, motion.by_velocities, reference, predicted)
        return gate_motion(measured, covariance, predicted, sigma_scale**2 * of_state, self._config.gate_probability)

    def _with_velocities(
        self, motion: RelativeMotion, by_velocities: ByVelocities, reference: int, predicted: Float
    ) -> tuple[Float, Float]:
        """Return a motion (4, 4) corrected for the window's velocities, and the covariance (6, 6) of its prediction.

        The predicted motion (4, 4) begins at the pose with the key ``reference``.
        """
        states = [self.state(motion.stamp_ns), self.state(motion.reference_stamp_ns)]
        nav_R_body = np.array([state.nav_T_body[:3, :3] for state in states])
        in_body = np.array([state.nav_T_body[:3, :3].T @ state.velocity_nav for state in states])
        newest, first = self._index_of[motion.stamp_ns], self._index_of[motion.reference_stamp_ns]
        joint = self._window.joint_covariance([reference, x(newest), v(newest), v(first)])
        jacobian = np.hstack(jacobians_of(predicted, by_velocities, nav_R_body, in_body))
        return corrected(motion, by_velocities, in_body), jacobian @ joint @ jacobian.T

    def gate_zero_velocity(self) -> GateResult:
        """Test the innovation of a velocity of zero."""
        k = self._index_of[self.latest_ns]
        covariance = self._window.joint_covariance([v(k)]) + zero_velocity_noise().covariance()
        return gate_innovation(-self.state().velocity_nav, covariance, self._config.gate_probability)

    def add_zero_velocity(self) -> None:
        """Insert a zero-velocity update of the newest state."""
        self._window.add(zero_velocity(self._index_of[self.latest_ns]))

    def excess_acceleration(self, motion: RelativeMotion) -> float | None:
        """Return the acceleration, m/s^2, that a motion implies over the newest step, if it exceeds the rig's limit.

        None where it does not, or where vision did not constrain the state before that step.
        """
        if len(self._stamps) < 2 or self._seen_ns != self._stamps[-2]:
            return None
        before, dt = self.pose(self._stamps[-2]), self._step_s
        measured = self.pose(motion.reference_stamp_ns) @ motion.reference_T_current
        velocity = before[:3, :3] @ self._previous_motion[3:]  # mean of the step before
        accel = (measured[:3, 3] - before[:3, 3] - velocity * dt) / dt**2
        return excess(accel, motion.covariance[3:, 3:] / dt**4, self._config.max_accel_m_s2)

    def reset_position(self) -> None:
        """Reset the position's uncertainty, except for its correlation with velocity, attitude and biases (section 5).

        The position's own uncertainty grows without bound, and no later measurement reduces it. It remains part of what
        `covariance` returns.
        """
        k = self._index_of[self.latest_ns]
        keys = [x(k), v(k), b(k), g()] if self.has_imu else [x(k)]
        forgotten, factor = position_reset(
            keys, self._window.joint_covariance(keys), _RESET_SIGMA_M, self._window.values
        )
        nav_R_body = self.pose(self.latest_ns)[:3, :3]
        self._nav_covariance[3:, 3:] += nav_R_body @ forgotten @ nav_R_body.T
        self._window.add(factor)

    def _new_window(self) -> GraphWindow:
        return GraphWindow(min_iterations=1 if self._config.huber_probability == 1.0 else 2)

    def _with_nav(self, covariance: Float) -> Float:
        """Return the covariance (6, 6) of the newest pose, in body, with that of nav added to it."""
        from_nav = se3_adjoint(se3_inverse(self.pose(self.latest_ns)))
        return np.asarray(covariance + from_nav @ self._nav_covariance @ from_nav.T)

    def add_motion(self, motion: RelativeMotion) -> None:
        """Insert a relative motion that ends in the newest state."""
        self._constrained_ns = self._seen_ns = motion.stamp_ns
        self._rate_sigmas = np.zeros(2)
        self.add_partial_motion(motion)

    def add_partial_motion(self, motion: RelativeMotion) -> None:
        """Insert a relative motion that need not constrain the newest state in all directions."""
        k = self._index_of[motion.reference_stamp_ns]
        self._views.add(k, motion, self._window)
        reference, covariance = self._views.seen(k, motion)
        noise = robust(gaussian(covariance), self._config.huber_probability)
        newest = self._index_of[motion.stamp_ns]
        if motion.by_velocities is None:
            measured = gtsam.Pose3(motion.reference_T_current)
            self._window.add(gtsam.BetweenFactorPose3(reference, x(newest), measured, noise))
        else:
            self._has_rolling_shutter = True
            self._window.add(readout_factor(reference, x(newest), (v(newest), v(k)), motion, noise))

    def update(self, keep: Iterable[int]) -> list[tuple[int, Float]]:
        """Update the newest states with the newest factors.

        Every third time, or where they change much, the window is optimised as a whole, and the states that are older
        than the lag are marginalised.

        Args:
            keep: stamps of states that stay in the window, and whose covariance will be asked for.

        Returns:
            Stamps and final poses ``nav_T_body`` of the states that left the window, in time order.

        Raises:
            WindowError: if the window cannot be solved; no state leaves it.
        """
        keep = frozenset(keep)
        retained = self._retained(keep)
        advanced = self._advanced < _MAX_ADVANCED and self._window.advance(retained)
        if not advanced:
            self._window.optimize(retained)
        self._advanced = self._advanced + 1 if advanced else 0
        if len(self._stamps) > 1:
            step = se3_inverse(self.pose(self._stamps[-2])) @ self.pose(self._stamps[-1])
            self._previous_motion = se3_log(step) / self._step_s
        return [] if advanced else self._forget(self.latest_ns - round(self._config.lag_s * 1e9), keep)

    def optimize(self) -> None:
        """Optimise the window as a whole.

        Raises:
            WindowError: if it has no unique solution.
        """
        self._window.optimize(self._retained(frozenset()))
        self._advanced = 0

    def all_poses(self) -> list[tuple[int, Float]]:
        """Return stamps and poses of the window, in time order, optimised as a whole where that is possible."""
        if self._advanced:
            with suppress(*SOLVER_ERRORS):
                self.optimize()
        return [(stamp, self.pose(stamp)) for stamp in self._stamps]

    def _append(self, stamp_ns: int, state: RigState) -> int:
        k = self._index
        self._index += 1
        self._stamps.append(stamp_ns)
        self._index_of[stamp_ns] = k
        values = self._window.values
        values.insert(x(k), gtsam.Pose3(state.nav_T_body))
        if self.has_imu:
            values.insert(v(k), state.velocity_nav)
            bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
            values.insert_or_assign(b(k), bias)  # `insert` has more types to try, and takes twice as long
        return k

    def _link_by_constant_velocity(self, i: int, j: int, motion: Float, dt: float) -> None:
        """Insert factors of constant velocity and angular rate between two states, eq. (11) and (12)."""
        config = self._config
        after_s = (self.latest_ns - self._constrained_ns) * 1e-9
        accelerations = np.array([config.motion_angular_accel_sigma_rad_s2, config.motion_accel_sigma_m_s2])
        self._window.add(constant_velocity(i, j, motion, dt, after_s, self._rate_sigmas, accelerations))
        if self._imu is not None:
            for factor in imu_without_samples(
                i, j, dt, config.motion_accel_sigma_m_s2, self._imu, config.imu_noise_scale
            ):
                self._window.add(factor)

    def _retained(self, keep: frozenset[int]) -> list[int]:
        """Return the variables that the next factors will involve, or whose covariance will be needed."""
        stamps = sorted(keep & self._index_of.keys() - {self.latest_ns})
        keys = [key for stamp in stamps for key in self._views.keys(self._index_of[stamp])]
        if self._has_rolling_shutter:
            keys += [v(self._index_of[stamp]) for stamp in stamps]
        newest = self._index_of[self.latest_ns]
        return [*keys, x(newest), v(newest), b(newest), g()] if self.has_imu else [*keys, x(newest)]

    def _forget(self, oldest_ns: int, keep: frozenset[int]) -> list[tuple[int, Float]]:
        leaving = [s for s in self._stamps[:-1] if s < oldest_ns and s not in keep]
        finished = [(stamp, self.pose(stamp)) for stamp in leaving]
        keys: list[int] = []
        for stamp in leaving:
            k = self._index_of[stamp]
            keys += [*self._views.keys(k), v(k), b(k)] if self.has_imu else self._views.keys(k)
        self._window.marginalise(keys)
        for stamp in leaving:
            self._views.forget(self._index_of.pop(stamp))
        self._stamps = [stamp for stamp in self._stamps if stamp in self._index_of]
        return finished
