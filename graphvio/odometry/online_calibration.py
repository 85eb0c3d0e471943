"""What the calibration during the run does for the odometry, whoever estimates it."""

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

    Once for each frameset: `with_calibration_covariance` before the state takes what vision measured, then `add` and
    `update`. Other stages get a corrected calibration within `update`. What contradicts the rig file is reported as an
    event to the function that the calibration is made with.
    """

    @property
    def estimate(self) -> CalibrationEstimate | None:
        """What is known of the calibration now, or None where nothing is: it is not estimated, or not yet."""

    @property
    def findings(self) -> list[Finding]:
        """What is known of each part of the calibration; empty where `estimate` is None."""

    @property
    def warnings(self) -> list[str]:
        """What the images say against the rig file that is not corrected, a sentence each."""

    def on_full_window(self, on_window: Callable[[FullWindow], None]) -> None:
        """Register a function that gets windows of keyframes, from which a whole recording can be calibrated.

        Args:
            on_window: Called within `add` with each window that is full. There is none where nothing is estimated.
        """

    def add_sample(self, sample: ImuSample) -> None:
        """Add an IMU sample, in time order.

        Args:
            sample: As it was measured, by the rig file's scale and axes and on the IMU's clock; not yet corrected.
        """

    def restart_imu(self) -> None:
        """Forget the IMU samples until now: the IMU is left out, or those that follow are of another clock."""

    def with_calibration_covariance(self, visual: VisualResult) -> VisualResult:
        """Return what vision measured, with the covariance that errors of the calibration add to its innovations.

        Args:
            visual: Of a frameset, to which the state has been predicted.

        Returns:
            The same motions, with their ``calibration_covariance``, see `RelativeMotion`.
        """

    def add(self, stamp_ns: int, quality: Quality, status: Status) -> None:
        """Update the estimation by a frameset, with its pose and its tracks.

        Args:
            stamp_ns: Of the frameset, by which the state has been updated.
            quality: Of what vision measured.
            status: What the pose is based on.
        """

    def update(self, stamp_ns: int) -> Float | None:
        """Let the other stages use the calibration that comes into force after a frameset.

        Args:
            stamp_ns: Of the frameset, for events.

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
        """End what runs beside the odometry: no frameset follows."""
