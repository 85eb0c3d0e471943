"""Keeps the path of a live run, to be written at its end."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from graphvio.arrays import Float
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.events import Event
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import save_trajectory


class PathOutput:
    """An output (`graphvio.live.output.Output`) that keeps poses in odom, and in the map as it was known by then.

    Args:
        map_T_odom: gives it, or None where it is not known yet.
    """

    def __init__(self, map_T_odom: Callable[[], Float | None]) -> None:
        self._map_T_odom = map_T_odom
        self._odom: list[tuple[int, Float]] = []
        self._map: list[tuple[int, Float]] = []

    def add_measurement(self, measurement: Measurement) -> None:
        """Measurements leave no trace."""

    def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
        """See `Output`."""
        if estimate.nav_T_body is None:
            return
        self._odom.append((estimate.stamp_ns, estimate.nav_T_body))
        map_T_odom = self._map_T_odom()
        if map_T_odom is not None:
            self._map.append((estimate.stamp_ns, map_T_odom @ estimate.nav_T_body))

    def add_event(self, event: Event) -> None:
        """Events leave no trace."""

    def status(self) -> Mapping[str, float | int | str | None]:
        """How many poses there are."""
        return {"poses_kept": len(self._odom)}

    def write(self, folder: Path) -> None:
        """``odometry.txt``, and ``online.txt`` with the poses in the map, if there are any.

        Raises:
            TrajectoryError: if a file cannot be written.
        """
        for name, poses in (("odometry.txt", self._odom), ("online.txt", self._map)):
            if poses:
                stamps = np.array([stamp for stamp, _ in poses], dtype=np.int64)
                save_trajectory(Trajectory(stamps, np.array([pose for _, pose in poses])), folder / name)
