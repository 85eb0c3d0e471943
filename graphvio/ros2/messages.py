"""ROS 2 messages about a running odometry: path, landmarks and diagnostics."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Any, Final

import numpy as np

from graphvio.sessions.cdr import make
from graphvio.sessions.messages import header
from graphvio.slam.keyframe import Keyframe

PATH, POINTS = "nav_msgs/msg/Path", "sensor_msgs/msg/PointCloud2"
DIAGNOSTICS, CORRECTION = "diagnostic_msgs/msg/DiagnosticArray", "geometry_msgs/msg/PoseWithCovarianceStamped"
MAP = "map"
"""Name that REP 105 has for the frame of global corrections."""

_POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("track_id", "<u4"), ("pair", "<u4")])
_DATATYPES: Final = {"<f4": 7, "<u4": 6}  # numpy's type -> constant of sensor_msgs/PointField


class Level(IntEnum):
    """Levels of a ``diagnostic_msgs/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class ThinnedPath:
    """Poses of the whole path; when they become too many, every second one is removed, also of those added later.

    Args:
        max_poses: number of poses at which they are thinned.
    """

    def __init__(self, max_poses: int) -> None:
        self._max_poses = max_poses
        self._poses: list[Any] = []
        self._newest: Any = None
        self._stride, self._count = 1, 0

    def add(self, pose: Any) -> None:
        """Append a pose."""
        self._newest = pose
        if self._count % self._stride == 0:
            self._poses.append(pose)
        self._count += 1
        if len(self._poses) >= self._max_poses:
            self._poses = self._poses[::2]
            self._stride *= 2

    def clear(self) -> None:
        """Remove all poses, at the beginning of another epoch."""
        self._poses, self._newest, self._stride, self._count = [], None, 1, 0

    def poses(self) -> list[Any]:
        """Return the poses that are kept, and the newest pose."""
        if not self._poses or self._poses[-1] is self._newest:
            return list(self._poses)
        return [*self._poses, self._newest]


def landmarks(keyframe: Keyframe, imu: str) -> Any:
    """Make a ``sensor_msgs/PointCloud2`` of a keyframe's landmarks, with track and pair, in the frame named ``imu``."""
    marks = keyframe.landmarks
    points = np.zeros(len(marks), dtype=_POINT)
    for k, axis in enumerate("xyz"):
        points[axis] = marks.points_body[:, k]
    points["track_id"], points["pair"] = marks.track_id, marks.pair
    fields = [
        make("sensor_msgs/msg/PointField", name=name, offset=int(offset), datatype=_DATATYPES[kind.str], count=1)
        for name, (kind, offset, *_) in (_POINT.fields or {}).items()
    ]
    return make(
        POINTS,
        header=header(keyframe.stamp_ns, imu),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=_POINT.itemsize,
        row_step=_POINT.itemsize * len(points),
        data=points.view(np.uint8).reshape(-1),
        is_dense=True,
    )


def diagnosis(name: str, level: Level, message: str, hardware: str, values: Mapping[str, object]) -> Any:
    """Make a ``diagnostic_msgs/DiagnosticStatus``; values that are None are left out."""
    pairs = [
        make("diagnostic_msgs/msg/KeyValue", key=key, value=f"{value:.6g}" if isinstance(value, float) else str(value))
        for key, value in values.items()
        if value is not None
    ]
    kind = "diagnostic_msgs/msg/DiagnosticStatus"
    return make(kind, level=int(level), name=name, message=message, hardware_id=hardware, values=pairs)
