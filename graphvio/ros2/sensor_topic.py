"""Sensor readings from the ROS 2 topic of a camera or of an IMU."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Final

import cv2
import numpy as np

from graphvio.arrays import Float, Image
from graphvio.errors import SessionError, SourceError
from graphvio.image_decoding import ImageError
from graphvio.measurements.events import EventKind
from graphvio.measurements.readings import CameraFrame, DeviceHealth, ImuReading, Notice, Reading, host_ns
from graphvio.ros2.node import Node, Reader
from graphvio.ros2.wire import Profile
from graphvio.sessions import cdr
from graphvio.sessions.messages import COMPRESSED, IMAGE, IMU, imu_sample
from graphvio.sessions.pixels import grey
from graphvio.sessions.rig_of_topics import path_between

_IMAGES: Final = 10  # images that are kept until they are taken: half a second
_SAMPLES: Final = 500
_MAX_LEVER_M: Final = 0.005


class SensorTopic:
    """The topic of a camera or of the IMU: its readings, publishers and losses.

    Args:
        node: participant of the domain.
        name: name of the topic.
        types: type of the messages of each topic.
        camera: name of the camera in the rig, or None for the IMU.
        is_reliable: whether lost messages are requested again.

    Attributes:
        frame: frame of the newest sample of the IMU.
        health: state at the last call of `poll`.

    Raises:
        SourceError: if the messages of a camera's topic are no images, or those of the IMU's topic no IMU samples.
    """

    def __init__(self, node: Node, name: str, types: Mapping[str, str], camera: str | None, is_reliable: bool) -> None:
        self.name, self.camera, self.type_name = name, camera, types[name]
        expected = (IMU,) if camera is None else (IMAGE, COMPRESSED)
        if self.type_name not in expected:
            raise SourceError(f"{name}: has messages of type {self.type_name}; it takes {' or '.join(expected)}")
        self.depth = _SAMPLES if camera is None else _IMAGES
        self.reader = Reader(node, name, self.type_name, Profile(self.depth, is_reliable=is_reliable))
        self.counts: Counter[str] = Counter()
        self.frame = ""
        self.health = DeviceHealth(name, True, self.type_name)
        self._newest_ns: int | None = None

    def notice(self, kind: EventKind, detail: str) -> Notice:
        """Return a notice about this topic."""
        return Notice(kind, f"{self.name}: {detail}", host_ns())

    def poll(self) -> Notice | None:
        """Update `health`; return a notice if the topic has lost its last publisher or has one again, else None."""
        was_connected, is_connected = self.health.connected, self.reader.writers > 0
        counts = {"lost": self.reader.lost, **self.counts}
        self.health = DeviceHealth(self.name, is_connected, self.type_name, counts)
        if was_connected == is_connected:
            return None
        if is_connected:
            return self.notice(EventKind.DEVICE_BACK, "is published again")
        return self.notice(EventKind.DEVICE_LOST, "has no publisher any more")

    def take(self) -> Iterator[ImuReading | CameraFrame]:
        """Yield the readings received since the last call."""
        samples = self.reader.take()
        if len(samples) >= self.depth:  # as many as are kept: there may have been more
            self.counts["overrun"] += 1
        arrival_ns = host_ns()
        for data in samples:
            try:
                reading = self._reading(data, arrival_ns)
            except SessionError:
                self.counts["damaged"] += 1
                continue
            if self._newest_ns is not None and reading.stamp_ns <= self._newest_ns:
                self.counts["late"] += 1
            else:
                self._newest_ns = reading.stamp_ns
            yield reading

    def _reading(self, data: bytes, arrival_ns: int) -> ImuReading | CameraFrame:
        if self.camera is not None:
            return CameraFrame(self.camera, cdr.stamp_ns(data), self._decoder(data), arrival_ns)
        message = cdr.decode(data, IMU, self.name)
        self.frame = message.header.frame_id
        sample = imu_sample(message)
        return ImuReading(sample.stamp_ns, sample.angular_velocity, sample.linear_acceleration, arrival_ns)

    def _decoder(self, data: bytes) -> Callable[[], Image]:
        def decode() -> Image:
            try:
                return grey(cdr.decode(data, self.type_name, self.name), self.name)
            except (ImageError, SessionError, IndexError, ValueError, cv2.error) as error:
                raise SourceError(f"{self.name}: an image cannot be decoded ({error})") from None

        return decode


class BodyRotation:
    """Rotates IMU samples into body, with transforms in the form of `graphvio.sessions.rig_of_topics.transforms_in`."""

    def __init__(self, body: str, transforms: dict[tuple[str, str], Float]) -> None:
        self._body, self._transforms = body, transforms
        self._body_R_imu: dict[str, Float | None] = {}

    def apply(self, reading: ImuReading, topic: SensorTopic) -> Iterator[Reading]:
        """Yield the reading in body.

        Before the first reading of a frame, a notice is yielded if the frame has no transform to body or is more than
        5 mm away from it. Readings of frames without a transform are left out and counted.
        """
        frame = topic.frame
        if frame not in self._body_R_imu:
            body_T_imu = path_between(self._transforms, self._body, frame)
            self._body_R_imu[frame] = None if body_T_imu is None else body_T_imu[:3, :3]
            if body_T_imu is None:
                yield topic.notice(EventKind.IMU_NO_TRANSFORM, f"no transform leads from {self._body} to {frame}")
            elif (lever_m := float(np.linalg.norm(body_T_imu[:3, 3]))) > _MAX_LEVER_M:
                yield topic.notice(
                    EventKind.IMU_LEVER_ARM,
                    f"{frame} is {1e3 * lever_m:.0f} mm from {self._body}: samples are rotated only, so that "
                    "accelerations are wrong while the rig turns; give a rig whose body is the IMU's frame",
                )
        R = self._body_R_imu[frame]
        if R is None:
            topic.counts["no_transform"] += 1
            return
        yield ImuReading(
            reading.stamp_ns, R @ reading.angular_velocity, R @ reading.linear_acceleration, reading.arrival_ns
        )
