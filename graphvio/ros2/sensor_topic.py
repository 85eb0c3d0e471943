"""A camera's or an IMU's topic, as readings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Final

import cv2

from graphvio.arrays import Image
from graphvio.errors import SessionError, SourceError
from graphvio.image_decoding import ImageError
from graphvio.measurements.readings import CameraFrame, DeviceHealth, ImuReading, Notice, Reading, host_ns
from graphvio.ros2.node import Node, Reader
from graphvio.ros2.qos import Profile
from graphvio.sessions import cdr
from graphvio.sessions.messages import COMPRESSED, IMAGE, IMU, imu_sample
from graphvio.sessions.pixels import grey

_IMAGES: Final = 10  # that are kept while nobody takes them: half a second
_SAMPLES: Final = 500


class SensorTopic:
    """A topic: what comes, who sends it, and what went wrong.

    Args:
        node: takes part in the domain.
        name: of the topic.
        types: of all topics that are published.
        camera: its name in the rig; None is the IMU.
        is_reliable: whether lost samples are to be sent again.

    Attributes:
        frame: of the newest sample of the IMU.
        health: as it was at the last `look`.

    Raises:
        SourceError: if its messages are of another type.
    """

    def __init__(self, node: Node, name: str, types: Mapping[str, str], camera: str | None, is_reliable: bool) -> None:
        self.name, self.camera, self.type_name = name, camera, types[name]
        wanted = (IMU,) if camera is None else (IMAGE, COMPRESSED)
        if self.type_name not in wanted:
            raise SourceError(f"{name}: has messages of type {self.type_name}; it takes {' or '.join(wanted)}")
        self.depth = _SAMPLES if camera is None else _IMAGES
        self.reader: Reader = node.reader(name, self.type_name, Profile(self.depth, is_reliable=is_reliable))
        self.frame = ""
        self._is_there = True
        self._newest_ns: int | None = None
        self._counts: dict[str, int] = {}
        self.health = DeviceHealth(name, True, self.type_name)

    def count(self, kind: str, count: int = 1) -> None:
        """Something went wrong."""
        self._counts[kind] = self._counts.get(kind, 0) + count

    def notice(self, kind: str, detail: str) -> Notice:
        """Something to tell."""
        return Notice(kind, f"{self.name}: {detail}", host_ns())

    def look(self) -> Notice | None:
        """Who publishes it now."""
        was_there, self._is_there = self._is_there, self.reader.writers > 0
        counts = {"lost": self.reader.lost, **self._counts}
        self.health = DeviceHealth(self.name, self._is_there, self.type_name, counts)
        if was_there == self._is_there:
            return None
        if self._is_there:
            return self.notice("device_back", "is published again")
        return self.notice("device_lost", "nobody publishes it any more")

    def take(self) -> Iterator[Reading]:
        """What came."""
        samples = self.reader.take()
        if len(samples) >= self.depth:  # as many as are kept: there may have been more
            self.count("overrun")
        arrival_ns = host_ns()
        for sample in samples:
            try:
                reading = self._reading(sample.data, arrival_ns)
            except SessionError:
                self.count("damaged")
                continue
            if self._newest_ns is not None and reading.stamp_ns <= self._newest_ns:
                self.count("late")
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
