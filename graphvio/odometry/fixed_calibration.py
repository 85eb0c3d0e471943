"""A calibration that keeps the values of the rig file."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from graphvio.arrays import Float
from graphvio.measurements.estimate import Status
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.measurements.sensors import ImuSample
from graphvio.self_calibration.collector import FullWindow
from graphvio.self_calibration.findings import Finding


class FixedCalibration:
    """An `OnlineCalibration` that estimates nothing, and assumes no calibration errors."""

    @property
    def estimate(self) -> None:
        """None, as nothing is estimated."""

    @property
    def findings(self) -> list[Finding]:
        """An empty list."""
        return []

    @property
    def warnings(self) -> list[str]:
        """An empty list."""
        return []

    def on_full_window(self, on_window: Callable[[FullWindow], None]) -> None:
        """Do nothing: there are no windows."""

    def add_sample(self, sample: ImuSample) -> None:
        """Ignore the sample."""

    def restart_imu(self) -> None:
        """Do nothing: there are no windows with samples."""

    def with_calibration_covariance(self, visual: VisualResult) -> VisualResult:
        """Return the front-end's result unchanged."""
        return visual

    def add(self, stamp_ns: int, quality: Quality, status: Status) -> None:
        """Ignore the frameset."""

    def update(self, stamp_ns: int) -> None:
        """Do nothing: the calibration does not change."""

    def correct_pose(self, turned: Float) -> None:
        """Do nothing: no pose is changed."""

    def pose_covariance(self, odom_T_body: Float) -> Float:
        """Return zero."""
        return np.zeros((6, 6))

    def close(self) -> None:
        """Do nothing: nothing runs beside the odometry."""
