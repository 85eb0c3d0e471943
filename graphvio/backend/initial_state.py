"""Initial states of an estimator: the first one, and those after each kind of break."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.imu_match import ImuMatch
from graphvio.backend.initialisation import InitialAttitude, initial_attitude, level
from graphvio.backend.states import (
    InitialUncertainty,
    RigState,
    StateCovariance,
    as_origin,
    certain_origin,
    gravity_by_tilt,
    origin_covariance,
)
from graphvio.config.stages import InitialisationConfig
from graphvio.geometry import se3, se3_inverse, se3_log
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.inertial_state import InertialState
from graphvio.measurements.motion import RelativeMotion
from graphvio.rig import Rig

_UNKNOWN_SPEED_SIGMA = 30.0  # without an IMU any first motion is accepted, on foot or on the road
_MOVING_SPEED_SIGMA = 5.0  # the gate accepts about five times as much
_STATIONARY_SPEED_SIGMA = 0.02
_REINITIALISED_SPEED_SIGMA = 1.0
_GYRO_BIAS_SIGMA = 0.01
_WIDE_GYRO_BIAS_SIGMA = 0.1
_WIDE_TILT_RAD = 0.3
_AFTER_REBUILD = np.diag([0.05] * 3 + [0.1] * 3) ** 2  # added to the pose's covariance, radians and metres
AFTER_JUMP = np.diag([0.2] * 3 + [1.0] * 3) ** 2
"""Added to a pose's covariance (6, 6) after a gap that nothing bridges."""
MAX_UNBRIDGED_S = 3.0
"""A longer gap without an IMU is not bridged by constant velocity."""


@dataclass(frozen=True, eq=False)
class InitialState:
    """A first state and its uncertainty.

    Attributes:
        stamp_ns: Stamp of the state.
        state: The rig at that instant.
        uncertainty: Uncertainty of the state.
        is_known: Whether attitude and velocity are known well enough; else the first motions have to complete them.
    """

    stamp_ns: int
    state: RigState
    uncertainty: InitialUncertainty
    is_known: bool = True


def first_state_at(
    stamp_ns: int, position: Float, imu: tuple[ImuInterval, float] | None, rig: Rig, config: InitialisationConfig
) -> InitialState:
    """Return the initial state at a position in nav, with roll and pitch from the IMU.

    Args:
        stamp_ns: Stamp of the state.
        position: (3,) position in nav, m.
        imu: The IMU readings around the state, and the state's time in that interval, seconds. Without them, the first
            pair's left camera is assumed to be upright, and the speed is unknown.
        rig: The rig, for its cameras.
        config: Configuration of the initialisation.
    """
    if imu is None:
        attitude = InitialAttitude(level(-rig.groups[0].left.body_T_cam[:3, 1]), 1e-3, np.zeros(3), 1.0, False)
        speed_sigma = _UNKNOWN_SPEED_SIGMA
    else:
        attitude = initial_attitude(*imu, config)
        speed_sigma = _STATIONARY_SPEED_SIGMA if attitude.is_stationary else _MOVING_SPEED_SIGMA
    state = RigState(se3(attitude.nav_R_body, position), np.zeros(3), attitude.gyro_bias, np.zeros(3))
    uncertainty = InitialUncertainty(
        origin_covariance(attitude.nav_R_body, attitude.tilt_sigma_rad), speed_sigma, attitude.gyro_bias_sigma
    )
    return InitialState(stamp_ns, state, uncertainty, attitude.is_stationary)


def with_free_gravity(initial: InitialState) -> InitialState:
    """Return an initial state whose pose defines nav: uncertainty of roll and pitch becomes that of gravity in nav.

    Later measurements then rotate gravity, and not the poses.
    """
    state, known = initial.state, initial.uncertainty
    tilted = gravity_by_tilt(state.nav_T_body[:3, :3], known.pose, state.gravity_nav)
    return replace(initial, uncertainty=replace(known, pose=certain_origin(), gravity=known.gravity + tilted))


def after_failure(stamp_ns: int, state: RigState, covariance: StateCovariance) -> InitialState:
    """Return the initial state at the predicted one, after a window that has no solution.

    Args:
        stamp_ns: Stamp of the state.
        state: The prediction.
        covariance: Covariance of the last state that was solved for.
    """
    return _reinitialised(stamp_ns, state, covariance.pose + _AFTER_REBUILD, covariance.gravity)


def after_gap(stamp_ns: int, state: RigState, covariance: StateCovariance) -> InitialState:
    """Return the first state of an epoch at the last state, after an unbridged gap; arguments as in `after_failure`."""
    return _at_kept_pose(stamp_ns, state, covariance.pose + AFTER_JUMP, covariance.gravity)


def after_lost(motion: RelativeMotion, state: RigState, covariance: StateCovariance) -> InitialState:
    """Return the first state of an epoch after a lost estimate: the prediction, with the velocity of a first motion.

    Args:
        motion: A motion that ends in the state.
        state: The prediction.
        covariance: Covariance of the prediction.
    """
    return _at_kept_pose(motion.stamp_ns, _with_velocity(state, motion), covariance.pose, covariance.gravity)


def from_vision(
    motion: RelativeMotion,
    nav_T_body: Float,
    state: RigState,
    pose_covariance: Float,
    gravity_covariance: Float | None,
    prediction_failed: bool,
) -> InitialState:
    """Return the initial state at the pose that a chain of refused motions leads to.

    Args:
        motion: The last motion of the chain.
        nav_T_body: (4, 4) pose at its end.
        state: The prediction for the same instant.
        pose_covariance: (6, 6) covariance of the pose at the beginning of the chain, tangent in body; the chain's
            motions are known better than this pose.
        gravity_covariance: (3, 3) covariance of gravity in nav, or None where it is not estimated.
        prediction_failed: Whether the prediction is known to be wrong; else vision may be wrong as well, and the pose
            is uncertain by its difference from the prediction.
    """
    apart = np.zeros(6) if prediction_failed else se3_log(se3_inverse(nav_T_body) @ state.nav_T_body)
    state = _with_velocity(replace(state, nav_T_body=nav_T_body), motion)
    covariance = pose_covariance + motion.covariance + np.diag(apart**2)
    gyro_bias_sigma = _GYRO_BIAS_SIGMA if prediction_failed else _WIDE_GYRO_BIAS_SIGMA
    return _reinitialised(motion.stamp_ns, state, covariance, gravity_covariance, gyro_bias_sigma)


def from_prediction(
    motion: RelativeMotion,
    nav_T_body: Float,
    state: RigState,
    pose_covariance: Float,
    gravity_covariance: Float | None,
) -> InitialState:
    """Return the initial state at the predicted pose, uncertain by its difference from a chain of refused motions.

    Args:
        motion: The last motion of the chain, which agrees with the prediction.
        nav_T_body: (4, 4) pose at the chain's end.
        state: The prediction for the same instant.
        pose_covariance: (6, 6) covariance of the pose at the beginning of the chain, tangent in body.
        gravity_covariance: (3, 3) covariance of gravity in nav, or None where it is not estimated.
    """
    apart = se3_log(se3_inverse(state.nav_T_body) @ nav_T_body)
    covariance = pose_covariance + motion.covariance + np.diag(apart**2)
    return _reinitialised(motion.stamp_ns, _with_velocity(state, motion), covariance, gravity_covariance)


def with_new_imu(motion: RelativeMotion, match: ImuMatch, state: RigState, covariance: StateCovariance) -> InitialState:
    """Return the initial state at the present pose for an IMU that was not used until now.

    Args:
        motion: A motion by vision that ends in the state.
        match: Result of the comparison of the IMU with vision.
        state: The newest state.
        covariance: Covariance of the newest state.
    """
    state = replace(
        _with_velocity(state, motion),
        gyro_bias=match.gyro_bias,
        accel_bias=np.zeros(3),
        gravity_nav=state.nav_T_body[:3, :3] @ match.gravity_body,
    )
    initial = with_wide_attitude(_at_kept_pose(motion.stamp_ns, state, covariance.pose, covariance.gravity))
    return replace(initial, is_known=True)


def with_inertial_state(
    known: InertialState, then: RigState, now_ns: int, now: RigState, blind_s: float, covariance: StateCovariance
) -> InitialState:
    """Return the initial state at the present pose with velocity, biases and gravity that are known from a keyframe.

    Args:
        known: Velocity, biases and gravity at the keyframe.
        then: The estimator's state at the keyframe.
        now_ns: Stamp of the newest state.
        now: The newest state.
        blind_s: Time since vision last constrained the state: over it, the position is corrected with the velocity.
        covariance: Covariance of the newest state.
    """
    since_s = 1e-9 * (now_ns - known.stamp_ns)
    nav_R_then, nav_R_now = then.nav_T_body[:3, :3], now.nav_T_body[:3, :3]
    gravity_nav = nav_R_then @ known.gravity
    by_bias = -nav_R_now @ (known.accel_bias - now.accel_bias)
    gained = now.velocity_nav - then.velocity_nav + since_s * (gravity_nav - now.gravity_nav + by_bias)
    velocity_nav = nav_R_then @ known.velocity + gained
    pose = now.nav_T_body.copy()
    pose[:3, 3] += blind_s * (velocity_nav - now.velocity_nav)
    state = RigState(pose, velocity_nav, known.gyro_bias, known.accel_bias, gravity_nav)
    to_now = np.eye(12)
    to_now[:3, :3] = to_now[9:, 9:] = nav_R_then
    to_now[:3, 3:6], to_now[:3, 9:] = -since_s * nav_R_now, since_s * nav_R_then
    inertial = to_now @ known.covariance @ to_now.T
    sigmas = np.sqrt(np.diag(inertial))
    velocity_sigma, gyro_bias_sigma = float(sigmas[:3].max()), float(sigmas[6:9].max())
    uncertainty = InitialUncertainty(
        certain_origin(), velocity_sigma, gyro_bias_sigma, covariance.pose, inertial=inertial
    )
    return InitialState(now_ns, state, uncertainty)


def with_late_imu(
    initial: InitialState, motion: RelativeMotion, state: RigState, covariance: StateCovariance
) -> InitialState:
    """Return the initial state at the present pose for an IMU whose first samples have come only now.

    Args:
        initial: Initial state at the same instant by the IMU alone, in a nav frame that is level.
        motion: A motion by vision that ends in the state.
        state: The newest state.
        covariance: Covariance of the newest state.
    """
    nav_R_level = state.nav_T_body[:3, :3] @ initial.state.nav_T_body[:3, :3].T
    state = replace(_with_velocity(state, motion), gravity_nav=nav_R_level @ initial.state.gravity_nav)
    uncertainty = InitialUncertainty(
        initial.uncertainty.pose, _REINITIALISED_SPEED_SIGMA, _WIDE_GYRO_BIAS_SIGMA, covariance.pose
    )
    return with_free_gravity(InitialState(motion.stamp_ns, state, uncertainty))


def with_wide_attitude(initial: InitialState) -> InitialState:
    """Return the first state of an epoch with gravity and gyro bias as uncertain as at a first initialisation.

    For a state that is reinitialised soon after the last time: the values that it would take over are probably wrong.
    """
    uncertainty = replace(initial.uncertainty, gyro_bias_rad_s=_WIDE_GYRO_BIAS_SIGMA)
    uncertainty = replace(uncertainty, pose=uncertainty.pose + np.diag([_WIDE_TILT_RAD] * 3 + [0.0] * 3) ** 2)
    return with_free_gravity(replace(initial, uncertainty=uncertainty, is_known=False))


def with_uncertain_position(initial: InitialState, sigma_m: float) -> InitialState:
    """Return the initial state with an additional standard deviation in each coordinate of its position."""
    pose = initial.uncertainty.pose + np.diag([0.0] * 3 + [sigma_m] * 3) ** 2
    return replace(initial, uncertainty=replace(initial.uncertainty, pose=pose))


def _at_kept_pose(
    stamp_ns: int, state: RigState, pose_covariance: Float, gravity_covariance: Float | None
) -> InitialState:
    # The pose defines nav from now on: its uncertainty is reported, but not estimated.
    initial = with_free_gravity(_reinitialised(stamp_ns, state, pose_covariance, gravity_covariance))
    return replace(initial, uncertainty=replace(initial.uncertainty, nav_covariance=pose_covariance))


def _reinitialised(
    stamp_ns: int,
    state: RigState,
    pose_covariance: Float,
    gravity_covariance: Float | None,
    gyro_bias_sigma: float = _GYRO_BIAS_SIGMA,
) -> InitialState:
    # Position and heading must not move when the attitude becomes known better: their uncertainty is reported, but
    # not estimated.
    pose, nav_covariance = as_origin(state.nav_T_body[:3, :3], pose_covariance)
    gravity = np.zeros((3, 3)) if gravity_covariance is None else gravity_covariance
    uncertainty = InitialUncertainty(pose, _REINITIALISED_SPEED_SIGMA, gyro_bias_sigma, nav_covariance, gravity)
    return InitialState(stamp_ns, state, uncertainty)


def _with_velocity(state: RigState, motion: RelativeMotion) -> RigState:
    """Return the state with the mean velocity of a measured motion."""
    nav_R_reference = state.nav_T_body[:3, :3] @ motion.reference_T_current[:3, :3].T
    return replace(state, velocity_nav=nav_R_reference @ motion.reference_T_current[:3, 3] / motion.duration_s)
