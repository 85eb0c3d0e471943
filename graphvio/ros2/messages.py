"""What is published of a running odometry, as ROS 2 messages, beside what sessions hold of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any, Final

import numpy as np

from graphvio.sessions.cdr import make
from graphvio.sessions.messages import ODOM, TRANSFORMS, header
from graphvio.slam.keyframe import Keyframe

PATH, POINTS = "nav_msgs/msg/Path", "sensor_msgs/msg/PointCloud2"
DIAGNOSTICS, CORRECTION = "diagnostic_msgs/msg/DiagnosticArray", "geometry_msgs/msg/PoseWithCovarianceStamped"
MAP = "map"
"""REP 105's name of the frame of global corrections."""

_POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("track_id", "<u4"), ("pair", "<u4")])
_DATATYPES: Final = {"<f4": 7, "<u4": 6}  # of sensor_msgs/PointField


class Level(IntEnum):
    """Of a ``diagnostic_msgs/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


def transforms(stamped: Sequence[Any]) -> Any:
    """A ``tf2_msgs/TFMessage`` of ``TransformStamped``."""
    return make(TRANSFORMS, transforms=list(stamped))


def path(stamp_ns: int, poses: Sequence[Any]) -> Any:
    """A ``nav_msgs/Path`` of ``PoseStamped`` in odom."""
    return make(PATH, header=header(stamp_ns, ODOM), poses=list(poses))


def landmarks(keyframe: Keyframe, body: str) -> Any:
    """A keyframe's points as a ``sensor_msgs/PointCloud2`` in body, a frame, with the identities of their tracks."""
    marks = keyframe.landmarks
    points = np.zeros(len(marks), dtype=_POINT)
    for k, axis in enumerate("xyz"):
        points[axis] = marks.points_body[:, k]
    points["track_id"], points["pair"] = marks.track_id, marks.pair
    fields = [
        make(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=int(_POINT.fields[name][1]),
            datatype=_DATATYPES[_POINT.fields[name][0].str],
            count=1,
        )
        for name in _POINT.names or ()
        if _POINT.fields is not None
    ]
    return make(
        POINTS,
        header=header(keyframe.stamp_ns, body),
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
    """A ``diagnostic_msgs/DiagnosticStatus``; what is None is left out."""
    return make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=int(level),
        name=name,
        message=message,
        hardware_id=hardware,
        values=[
            make("diagnostic_msgs/msg/KeyValue", key=key, value=_text(value))
            for key, value in values.items()
            if value is not None
        ],
    )


def diagnostics(stamp_ns: int, statuses: Sequence[Any]) -> Any:
    """A ``diagnostic_msgs/DiagnosticArray``."""
    return make(DIAGNOSTICS, header=header(stamp_ns, ""), status=list(statuses))


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
