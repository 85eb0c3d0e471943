"""The calibration of the rig file, taken as it is."""

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
    """An `OnlineCalibration` that estimates nothing, and allows for no errors."""

    @property
    def estimate(self) -> None:
        """Nothing."""

    @property
    def findings(self) -> list[Finding]:
        """None."""
        return []

    @property
    def warnings(self) -> list[str]:
        """None."""
        return []

    def on_full_window(self, on_window: Callable[[FullWindow], None]) -> None:
        """Collect no windows."""

    def add_sample(self, sample: ImuSample) -> None:
        """Ignore the sample."""

    def restart_imu(self) -> None:
        """Do nothing: there are no windows with samples."""

    def with_calibration_covariance(self, visual: VisualResult) -> VisualResult:
        """Return what vision measured, as it is."""
        return visual

    def add(self, stamp_ns: int, quality: Quality, status: Status) -> None:
        """Ignore the frameset."""

    def update(self, stamp_ns: int) -> None:
        """Change nothing."""

    def correct_pose(self, turned: Float) -> None:
        """Do nothing: no pose is changed."""

    def pose_covariance(self, odom_T_body: Float) -> Float:
        """Return zero."""
        return np.zeros((6, 6))

    def close(self) -> None:
        """Do nothing: nothing runs."""
