"""Samples of an IMU in the axes of another frame."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from graphvio.arrays import Float
from graphvio.measurements.readings import ImuReading, Reading
from graphvio.ros2.sensor_topic import SensorTopic
from graphvio.sessions.rig_of_topics import path_between

_LEVER_M: Final = 0.005


class Turn:
    """Turns samples into body, as transforms tell where the IMU's frame is.

    Args:
        body: name of the frame.
        transforms: see `graphvio.sessions.rig_of_topics.transforms_in`.
    """

    def __init__(self, body: str, transforms: dict[tuple[str, str], Float]) -> None:
        self._body, self._transforms = body, transforms
        self._rotations: dict[str, Float | None] = {}

    def __call__(self, reading: ImuReading, topic: SensorTopic) -> Iterator[Reading]:
        """The reading in body, and what is to be told at a frame's first; nothing where its place is not known."""
        frame = topic.frame
        if frame not in self._rotations:
            body_T_imu = path_between(self._transforms, self._body, frame)
            self._rotations[frame] = None if body_T_imu is None else body_T_imu[:3, :3]
            if body_T_imu is None:
                yield topic.notice("imu_no_transform", f"no transform leads from {self._body} to {frame}")
            elif (lever_m := float(np.linalg.norm(body_T_imu[:3, 3]))) > _LEVER_M:
                yield topic.notice(
                    "imu_lever_arm",
                    f"{frame} is {1e3 * lever_m:.0f} mm from {self._body}: samples are turned only, so that "
                    "accelerations are wrong while the rig turns; give a rig whose body is the IMU's frame",
                )
        R = self._rotations[frame]
        if R is None:
            topic.count("no_transform")
            return
        yield ImuReading(
            reading.stamp_ns, R @ reading.angular_velocity, R @ reading.linear_acceleration, reading.arrival_ns
        )
