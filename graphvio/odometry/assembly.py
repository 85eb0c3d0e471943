"""Functions that assemble estimates, keyframe data and views for the calibration from the stages' results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from graphvio.arrays import Float
from graphvio.backend.estimator import StateEstimator
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.tracking_frontend import TrackingFrontend
from graphvio.geometry import se3_inverse
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.motion import VisualResult
from graphvio.measurements.sensors import FrameSet
from graphvio.odometry.nav_frame import NavFrame
from graphvio.odometry.online_calibration import OnlineCalibration
from graphvio.odometry.step import NewKeyframe
from graphvio.odometry.time_offset_correction import TimeOffsetCorrection
from graphvio.self_calibration.window import View


def estimate_without_pose(stamp_ns: int, visual: VisualResult, stage_ms: Mapping[str, float]) -> Estimate:
    """Return the estimate of a frameset before the state is initialised."""
    return Estimate(
        stamp_ns,
        Status.INITIALISING,
        None,
        None,
        vision=visual.quality,
        vision_reason=visual.reason,
        pairs=visual.pairs,
        stage_ms=stage_ms,
    )


def estimate_by_measurements(
    stamp_ns: int,
    status: Status,
    visual: VisualResult,
    is_stationary: bool,
    rates: Mapping[str, Float],
    time_offset: TimeOffsetCorrection,
    stage_ms: Mapping[str, float],
) -> Estimate:
    """Return the estimate of a frameset without the state, which `with_state` adds.

    Args:
        stamp_ns: Stamp of the frameset.
        status: What the pose is based on.
        visual: The front-end's result.
        is_stationary: Whether images, and the IMU if there is one, show a standstill.
        rates: Angular rates (3,) rad/s of body by source.
        time_offset: Estimate of the offset between cameras and IMU.
        stage_ms: Processing time by stage.
    """
    return Estimate(
        stamp_ns,
        status,
        None,
        None,
        time_offset_s=time_offset.offset_s,
        time_offset_sigma_s=time_offset.sigma_s,
        rates=rates,
        vision=visual.quality,
        vision_reason=visual.reason,
        vision_sigmas=None if visual.motion is None else visual.motion.weakest_sigmas,
        is_stationary=is_stationary,
        pairs=visual.pairs,
        stage_ms=stage_ms,
    )


def with_state(
    estimate: Estimate, estimator: StateEstimator, calibration: OnlineCalibration, nav: NavFrame
) -> Estimate:
    """Return an estimate with the estimator's state added, but without a pose where it is lost.

    Args:
        estimate: Estimate of a frameset by its measurements.
        estimator: State estimator, updated by these measurements.
        calibration: Calibration, whose errors add to the covariance of the pose.
        nav: Frame of the estimate.
    """
    calibration_covariance = calibration.pose_covariance(estimator.state().nav_T_body)
    state, covariance = nav.state(estimator.state()), nav.covariance(estimator.covariance)
    has_pose, has_imu = estimate.status is not Status.LOST, estimator.has_imu
    return replace(
        estimate,
        nav_T_body=state.nav_T_body if has_pose else None,
        covariance=covariance.pose + calibration_covariance if has_pose else None,
        epoch=estimator.epoch,
        velocity_nav=state.velocity_nav if has_pose else None,
        gyro_bias=state.gyro_bias if has_imu else None,
        accel_bias=state.accel_bias if has_imu else None,
        velocity_covariance=covariance.velocity if has_pose else None,
        gyro_bias_covariance=covariance.gyro_bias,
        accel_bias_covariance=covariance.accel_bias,
        gravity_nav=state.gravity_nav if has_imu and has_pose else None,
        gravity_covariance=covariance.gravity if has_pose else None,
        tilt_covariance=covariance.tilt if has_pose else None,
        innovations=estimator.gate_results,
    )


def at_stamp(estimate: Estimate, body_T_stamped: Float) -> Estimate:
    """Return an estimate with the pose at its stamp, where that is not the instant of its images.

    Args:
        estimate: Estimate with the state at the instant of the images.
        body_T_stamped: (4, 4) motion of body from then until the stamp.
    """
    if estimate.nav_T_body is None:
        return estimate
    return replace(estimate, nav_T_body=estimate.nav_T_body @ body_T_stamped)


def keyframe_of(
    frameset: FrameSet, frontend: TrackingFrontend, estimator: StateEstimator, nav: NavFrame, previous_ns: int | None
) -> NewKeyframe:
    """Return the data of a frameset from which later motions are measured.

    Args:
        frameset: The newest frameset.
        frontend: Front-end that has tracked the frameset.
        estimator: State estimator, updated by the frameset.
        nav: Frame of the estimates, in which body may have turned since the previous keyframe.
        previous_ns: Stamp of the previous keyframe, or None.
    """
    previous_T_body = covariance = None
    if previous_ns is not None:
        body_T_previous, covariance = estimator.motion_since(previous_ns), estimator.covariance_since(previous_ns)
        if body_T_previous is not None and covariance is not None:
            estimator_T_body = estimator.state().nav_T_body
            nav_T_previous = nav.pose(previous_ns, estimator_T_body @ body_T_previous)
            previous_T_body = se3_inverse(nav_T_previous) @ nav.pose(frameset.stamp_ns, estimator_T_body)
        else:
            covariance = None
    return NewKeyframe(
        frames=frontend.frames_at(frameset.stamp_ns),
        images=frameset.images,
        body_T_left=frontend.body_T_left,
        previous_ns=previous_ns,
        previous_T_body=previous_T_body,
        covariance=covariance,
        located_points=estimator.located_points,
    )


def views_of(frames: Mapping[int, TrackedFrame]) -> dict[int, View]:
    """Return the views of pairs and single cameras, by index, of their tracks at one frameset."""
    return {
        j: View(frame.ids, frame.pixels_at_stamp, frame.right_pixels_at_stamp, frame.has_right, frame.points[:, 2])
        for j, frame in frames.items()
    }
