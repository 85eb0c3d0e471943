"""Log of the motions that vision measures, and their comparison with the truth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2, norm

from graphvio.arrays import Float
from graphvio.backend.estimator import MeasurementUpdate
from graphvio.frontend.tracking.rolling_shutter import ReadoutMotion
from graphvio.frontend.tracking_frontend import MotionPredictor
from graphvio.geometry import se3_inverse, se3_log
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.motion import RelativeMotion, VisualResult
from graphvio.measurements.sensors import FrameSet
from graphvio.odometry import Odometry

BREAK_SIGMA = 5.0
BREAK_STATISTIC = float(chi2.isf(2.0 * norm.sf(BREAK_SIGMA), 6))
"""Squared Mahalanobis distance with 6 degrees of freedom that is exceeded with the probability of 5 sigma in one
dimension, 5.7e-7."""


class TruthNoise(NamedTuple):
    """Standard deviations of true poses.

    Attributes:
        angle_rad: standard deviation of the orientation, about each axis.
        position_m: standard deviation of the position, along each axis.
    """

    angle_rad: float = 0.0
    position_m: float = 0.0


EXACT = TruthNoise()


class MotionError(NamedTuple):
    """Error of a motion.

    Attributes:
        statistic: squared Mahalanobis distance of the error by the motion's covariance, 6 degrees of freedom.
        error_m: error of the translation.
        error_deg: error of the rotation.
    """

    statistic: float
    error_m: float
    error_deg: float


class VisionLog(NamedTuple):
    """The front-end's results of a run.

    Attributes:
        results: stamp -> the front-end's result.
        used: stamp -> the motion that went into the estimate: that of the result, or one of its alternatives.
    """

    results: dict[int, VisualResult]
    used: dict[int, RelativeMotion]


def log_vision(odometry: Odometry) -> VisionLog:
    """Return a log that the front-end's results enter while the odometry runs.

    Results are logged between front-end and estimator: an estimate has only the pose, in which IMU and earlier motions
    hide errors of the motion that vision measured.
    """
    process, apply = odometry._frontend.process, odometry._estimator.apply
    vision_log = VisionLog({}, {})

    def processed(
        frameset: FrameSet,
        motion_since: MotionPredictor,
        readout: ReadoutMotion | None = None,
        rotation_since: MotionPredictor | None = None,
    ) -> VisualResult:
        result = vision_log.results[frameset.stamp_ns] = process(frameset, motion_since, readout, rotation_since)
        return result

    def applied(visual: VisualResult, is_stationary: bool) -> MeasurementUpdate:
        update = apply(visual, is_stationary)
        if update.motion is not None:
            vision_log.used[update.motion.stamp_ns] = update.motion
        return update

    odometry._frontend.process = processed  # type: ignore[method-assign]
    odometry._estimator.apply = applied  # type: ignore[method-assign]
    return vision_log


def uses_vision(estimate: Estimate) -> bool:
    """Whether the odometry used the motion that ends at this estimate."""
    return estimate.status in (Status.TRACKING, Status.INITIALISING)


def motion_error(
    motion: RelativeMotion, world_T_reference: Float, world_T_current: Float, noise: TruthNoise = EXACT
) -> MotionError:
    """Compare a motion with the truth.

    The error is the tangent ``log(true^-1 measured)`` in the body frame of the later instant, like the covariance.

    Args:
        motion: the measured motion.
        world_T_reference: (4, 4) true pose of body at the motion's earlier instant.
        world_T_current: (4, 4) true pose of body at the later instant.
        noise: noise of each of the two true poses.
    """
    true_motion = se3_inverse(world_T_reference) @ world_T_current
    error = se3_log(se3_inverse(true_motion) @ motion.reference_T_current)
    of_truth = np.diag(np.repeat(2.0 * np.square(noise), 3))  # covariance of the difference of two poses, in any frame
    try:
        statistic = float(error @ np.linalg.solve(motion.covariance + of_truth, error))
    except np.linalg.LinAlgError:
        statistic = np.inf  # the covariance is singular
    if not statistic >= 0.0:
        statistic = np.inf
    return MotionError(statistic, float(np.linalg.norm(error[3:])), float(np.rad2deg(np.linalg.norm(error[:3]))))
