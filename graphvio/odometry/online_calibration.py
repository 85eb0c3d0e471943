"""The interface between the odometry and the calibration during the run, however that is estimated."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from graphvio.arrays import Float
from graphvio.measurements.estimate import Status
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.measurements.sensors import ImuSample
from graphvio.self_calibration.collector import FullWindow
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.findings import Finding


class OnlineCalibration(Protocol):
    """The calibration of the rig while the odometry runs.

    It is called once for each frameset: `with_calibration_covariance` before the state is updated with the motion by
    vision, then `add` and `update`. `update` passes a corrected calibration to the other stages. Contradictions to the
    rig file are reported as events to a function that is passed to the constructor.
    """

    @property
    def estimate(self) -> CalibrationEstimate | None:
        """The present estimate of the calibration, or None where it is not estimated, or not yet."""

    @property
    def findings(self) -> list[Finding]:
        """The present findings for each part of the calibration; empty where `estimate` is None."""

    @property
    def warnings(self) -> list[str]:
        """Warnings where the images contradict the rig file and it is not corrected, a sentence each."""

    def on_full_window(self, on_window: Callable[[FullWindow], None]) -> None:
        """Register a function that receives windows of keyframes, from which a whole recording can be calibrated.

        Args:
            on_window: Called within `add` with each full window; never called where nothing is estimated.
        """

    def add_sample(self, sample: ImuSample) -> None:
        """Add an IMU sample, in time order.

        Args:
            sample: Sample as measured, with the rig file's scale and axes, on the IMU's clock; not yet corrected.
        """

    def restart_imu(self) -> None:
        """Forget the IMU samples until now, as the IMU is left out, or its clock has been corrected."""

    def with_calibration_covariance(self, visual: VisualResult) -> VisualResult:
        """Return the front-end's result with the covariance that errors of the calibration add to its innovations.

        Args:
            visual: Result for a frameset, to which the state has been predicted.

        Returns:
            The same motions, with their ``calibration_covariance``, see `RelativeMotion`.
        """

    def add(self, stamp_ns: int, quality: Quality, status: Status) -> None:
        """Update the estimation by a frameset, with its pose and its tracks.

        Args:
            stamp_ns: Stamp of the frameset, by which the state has been updated.
            quality: Quality of the motion by vision.
            status: What the pose is based on.
        """

    def update(self, stamp_ns: int) -> Float | None:
        """Pass the calibration that comes into force after a frameset to the other stages.

        Args:
            stamp_ns: Stamp of the frameset, for events.

        Returns:
            (3, 3) rotation ``old_R_new`` of the corrected body frame relative to the previous one, with the first
            pair's left camera held fixed. None if it does not change, or after a knock, which turns the cameras and not
            body.
        """

    def correct_pose(self, turned: Float) -> None:
        """Account for a change of the newest pose that `update` has asked for.

        Args:
            turned: (6,) tangent ``[rotation, translation]`` of the change, radians and metres, in body.
        """

    def pose_covariance(self, odom_T_body: Float) -> Float:
        """Return the covariance that errors of the calibration add to that of the newest pose.

        Args:
            odom_T_body: (4, 4) newest pose in the state estimator's frame.

        Returns:
            (6, 6), tangent ``[rotation, translation]`` in body, radians and metres; zero where none is known.
        """

    def close(self) -> None:
        """Stop threads that run beside the odometry: no frameset follows."""
