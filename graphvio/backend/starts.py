"""Where the smoother starts: at first, from what the IMU says, and again after each kind of break."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.initialisation import InitialAttitude, initial_attitude, level
from graphvio.backend.states import RigState, StartUncertainty, as_origin, origin_covariance
from graphvio.config.stages import InitialisationConfig
from graphvio.geometry import se3, se3_inverse, se3_log
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import RelativeMotion
from graphvio.rig import Rig

_UNKNOWN_SPEED_SIGMA = 30.0  # without an IMU the first motion is believed whatever it is, on foot or on the road
_MOVING_START_SPEED_SIGMA = 5.0  # with one, too: the gate lets five times as much pass
_RESTING_START_SPEED_SIGMA = 0.02
_RESTART_SPEED_SIGMA = 1.0
_GYRO_BIAS_SIGMA = 0.01
_WIDE_GYRO_BIAS_SIGMA = 0.1
_DOUBTFUL_TILT_RAD = 0.3
_AFTER_REBUILD = np.diag([0.05] * 3 + [0.1] * 3) ** 2  # added to the pose's covariance, radians and metres
AFTER_JUMP = np.diag([0.2] * 3 + [1.0] * 3) ** 2
"""Added to a pose's covariance (6, 6) after a gap that nothing bridges."""
MAX_UNBRIDGED_S = 3.0
"""A longer gap without an IMU is not bridged by constant velocity."""


@dataclass(frozen=True, eq=False)
class Start:
    """What the smoother starts from.

    Attributes:
        stamp_ns: of the first state.
        state: the rig then.
        uncertainty: how well it is known.
        is_known: whether nothing is left that the first motions must tell.
    """

    stamp_ns: int
    state: RigState
    uncertainty: StartUncertainty
    is_known: bool = True


def first_start(
    stamp_ns: int, position: Float, found: tuple[ImuInterval, float] | None, rig: Rig, config: InitialisationConfig
) -> Start:
    """A start at a position (3,) in nav, with the attitude that the IMU tells.

    Args:
        stamp_ns: of the first state.
        position: metres.
        found: the IMU around the first state and that state's place in it, seconds. Without it, the first pair's left
            camera is taken to be upright, and nothing is known of the speed.
        rig: cameras.
        config: of this stage.
    """
    if found is None:
        at = InitialAttitude(level(-rig.pairs[0].left.body_T_cam[:3, 1]), 1e-3, np.zeros(3), 1.0, False)
        speed_sigma = _UNKNOWN_SPEED_SIGMA
    else:
        at = initial_attitude(*found, config)
        speed_sigma = _RESTING_START_SPEED_SIGMA if at.at_rest else _MOVING_START_SPEED_SIGMA
    state = RigState(se3(at.nav_R_body, position), np.zeros(3), at.gyro_bias, np.zeros(3))
    pose_covariance = origin_covariance(at.nav_R_body, at.tilt_sigma_rad)
    return Start(stamp_ns, state, StartUncertainty(pose_covariance, speed_sigma, at.gyro_bias_sigma), at.at_rest)


def after_failure(stamp_ns: int, state: RigState, pose_covariance: Float) -> Start:
    """A start at the predicted state, after a window that has no solution.

    Args:
        stamp_ns: of the state.
        state: the prediction.
        pose_covariance: (6, 6) of the last pose that was known, tangent in body.
    """
    return _restart(stamp_ns, state, pose_covariance + _AFTER_REBUILD)


def after_gap(stamp_ns: int, state: RigState, pose_covariance: Float) -> Start:
    """A start at the last state, after a gap that nothing bridges. For arguments see `after_failure`."""
    return _restart(stamp_ns, state, pose_covariance + AFTER_JUMP)


def after_lost(motion: RelativeMotion, state: RigState, pose_covariance: Float) -> Start:
    """A start at the predicted state with the velocity of the first motion that vision sees again.

    Args:
        motion: it ends in the state.
        state: the prediction.
        pose_covariance: (6, 6) of it, tangent in body.
    """
    return _restart(motion.stamp_ns, _with_velocity(state, motion), pose_covariance)


def by_vision(
    motion: RelativeMotion, nav_T_body: Float, state: RigState, pose_covariance: Float, prediction_failed: bool
) -> Start:
    """A start at the pose (4, 4) that vision has.

    Args:
        motion: the last one of a chain, it ends in the pose.
        nav_T_body: the pose.
        state: the prediction.
        pose_covariance: (6, 6) of the pose that the chain begins at, tangent in body; the chain is better known.
        prediction_failed: whether that is known; else vision may be wrong, too, and the pose is as uncertain as it
            differs from the prediction.
    """
    apart = np.zeros(6) if prediction_failed else se3_log(se3_inverse(nav_T_body) @ state.nav_T_body)
    state = _with_velocity(replace(state, nav_T_body=nav_T_body), motion)
    covariance = pose_covariance + motion.covariance + np.diag(apart**2)
    gyro_bias_sigma = _GYRO_BIAS_SIGMA if prediction_failed else _WIDE_GYRO_BIAS_SIGMA
    return _restart(motion.stamp_ns, state, covariance, gyro_bias_sigma)


def doubtful(start: Start) -> Start:
    """The same start, but for what it takes over: attitude and gyro bias are as little known as at a first start.

    For where a start soon leads to the next: then what was taken over is wrong.
    """
    nav_R_body = start.state.nav_T_body[:3, :3]
    pose = start.uncertainty.pose.copy()
    pose[:3, :3] += nav_R_body.T @ np.diag([_DOUBTFUL_TILT_RAD, _DOUBTFUL_TILT_RAD, 0.0]) ** 2 @ nav_R_body
    known = replace(start.uncertainty, pose=pose, gyro_bias_rad_s=_WIDE_GYRO_BIAS_SIGMA)
    return replace(start, uncertainty=known, is_known=False)


def _restart(
    stamp_ns: int, state: RigState, pose_covariance: Float, gyro_bias_sigma: float = _GYRO_BIAS_SIGMA
) -> Start:
    """A start's place and heading must not move when its attitude becomes known better: what they are uncertain by is
    told, but not estimated."""
    pose, beside = as_origin(state.nav_T_body[:3, :3], pose_covariance)
    return Start(stamp_ns, state, StartUncertainty(pose, _RESTART_SPEED_SIGMA, gyro_bias_sigma, beside))


def _with_velocity(state: RigState, motion: RelativeMotion) -> RigState:
    """The state with the mean velocity of a measured motion."""
    nav_R_reference = state.nav_T_body[:3, :3] @ motion.reference_T_current[:3, :3].T
    return replace(state, velocity_nav=nav_R_reference @ motion.reference_T_current[:3, 3] / motion.duration_s)
