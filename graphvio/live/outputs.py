"""Consumers of a live run's measurements and results: the interface, the viewer and the trajectory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from graphvio.arrays import Float
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.events import Event
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import save_trajectory
from graphvio.viewer import Viewer


class Output:
    """Base class of consumers, which ignores everything. No consumer may block the threads that call its methods."""

    def add_measurement(self, measurement: Measurement) -> None:
        """Add an IMU sample or a frameset as it comes; called from several threads."""

    def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
        """Add an estimate, and its images if they are still kept."""

    def add_event(self, event: Event) -> None:
        """Add an event; called from several threads."""

    def status(self) -> Mapping[str, float | int | str | None]:
        """Return the output's figures by name; called from any thread."""
        return {}


class ViewOutput(Output):
    """Shows a live run in a viewer; images are left out if the viewer has no time for them.

    Args:
        viewer: the viewer.
        calibration: returns the present estimate of the calibration, or None where it is not estimated.
    """

    def __init__(self, viewer: Viewer, calibration: Callable[[], CalibrationEstimate | None] = lambda: None) -> None:
        self._viewer = viewer
        self._calibration = calibration
        self._shown: CalibrationEstimate | None = None

    def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
        """See `Output`."""
        self._viewer.show(frameset, estimate)
        calibration = self._calibration()
        if calibration is not None and calibration is not self._shown:
            self._shown = calibration
            self._viewer.show_calibration(estimate.stamp_ns, calibration)

    def add_event(self, event: Event) -> None:
        """See `Output`."""
        self._viewer.show_event(event)

    def status(self) -> Mapping[str, float | int | str | None]:
        """See `Output`."""
        return {"framesets_not_shown": self._viewer.dropped}


class PathOutput(Output):
    """Keeps the poses in odom, and in map with the correction in force when they were estimated.

    Args:
        map_T_odom: returns the correction in force, (4, 4), or None before the first.
    """

    def __init__(self, map_T_odom: Callable[[], Float | None]) -> None:
        self._map_T_odom = map_T_odom
        self._odom: list[tuple[int, Float]] = []
        self._map: list[tuple[int, Float]] = []

    def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
        """See `Output`."""
        if estimate.nav_T_body is None:
            return
        self._odom.append((estimate.stamp_ns, estimate.nav_T_body))
        map_T_odom = self._map_T_odom()
        if map_T_odom is not None:
            self._map.append((estimate.stamp_ns, map_T_odom @ estimate.nav_T_body))

    def status(self) -> Mapping[str, float | int | str | None]:
        """See `Output`."""
        return {"poses_kept": len(self._odom)}

    def write(self, folder: Path) -> None:
        """Write ``odometry.txt``, and ``online.txt`` with the poses in the map, if there are any.

        Raises:
            TrajectoryError: if a file cannot be written.
        """
        for name, poses in (("odometry.txt", self._odom), ("online.txt", self._map)):
            if poses:
                stamps = np.array([stamp for stamp, _ in poses], dtype=np.int64)
                save_trajectory(Trajectory(stamps, np.array([pose for _, pose in poses])), folder / name)
