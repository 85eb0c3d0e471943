"""Live source of cameras and an IMU that publish on ROS 2, received over DDS; ROS need not be installed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

from graphvio.arrays import Float
from graphvio.errors import SourceError
from graphvio.live.source import DeviceInfo, LiveSource
from graphvio.live.sources import SourceSpec, check_options
from graphvio.live.sources.spec_options import choice_of, number_of
from graphvio.measurements.readings import DeviceHealth, ImuReading, Reading
from graphvio.rig import Rig
from graphvio.ros2.node import Node, Publication, domain_of
from graphvio.ros2.rig import listen_for_rig, listen_for_transforms
from graphvio.ros2.sensor_topic import BodyRotation, SensorTopic
from graphvio.ros2.wire import require_dds
from graphvio.sessions import cdr
from graphvio.sessions.messages import COMPRESSED, IMAGE, IMU
from graphvio.sessions.rig_of_topics import stereo_topics
from graphvio.sessions.topics import image_topic, preference, sides_of
from graphvio.wording import listed

_NODE: Final = "/graphvio_source"
_OPTIONS: Final = ("domain", "imu", "body", "reliable", "wait_s")
_WAIT_S: Final = 10.0
_DISCOVERY_S: Final = 1.0  # time without a new publication after which discovery is complete
_POLL_S: Final = 0.05
_LIVENESS_S: Final = 0.2  # time between checks of the publishers


def list_devices() -> Sequence[DeviceInfo]:
    """See `SourceKind.list_devices`: the domain of ``ROS_DOMAIN_ID``, if images are published there."""
    domain = domain_of(None)
    node = Node(domain)
    time.sleep(_DISCOVERY_S)
    types = {each.topic: each.type_name for each in node.publications()}
    images = _images(types)
    if not images:
        return []
    pairs = [f"pair {name}: {left}, {right}" for name, (left, right) in stereo_topics(images).items()]
    imus = [f"IMU: {name}" for name, kind in sorted(types.items()) if kind == IMU]
    described = "; ".join([*(pairs or [f"images: {', '.join(images)}"]), *imus])
    return [DeviceInfo(f"ros2:?domain={domain}", described)]


def open_source(spec: SourceSpec, rig: Rig | None) -> LiveSource:
    """See `SourceKind.open_source`; such as ``ros2:?domain=0&CAMERA=/TOPIC&imu=/imu``.

    Options are ``domain``; ``imu``, the topic of the samples; a topic for each camera that is not found by its name;
    ``body``, the frame that is the rig's body where that is not the IMU's: samples are then rotated by ``tf_static``;
    ``reliable=1`` to have lost samples sent again; ``wait_s``, how long to wait for topics.
    """
    require_dds()
    cdr.types()
    if spec.what:
        raise SourceError(f"ros2:{spec.what}: topics are named by options, such as ros2:?imu=/{spec.what.lstrip('/')}")
    if rig is not None:
        check_options(spec, [*_OPTIONS, *(camera.name for camera in rig.cameras)])
    for name, topic in spec.options.items():
        if (name not in _OPTIONS or name == "imu") and not topic.startswith("/"):
            raise SourceError(f"ros2: {name}={topic} is no topic; topics begin with a slash, such as /{topic}")
    if rig is not None and rig.imu is None and {"imu", "body"} & spec.options.keys():
        raise SourceError(f"ros2: {rig.name} has no IMU; leave out imu and body, or give a rig that has one")
    if rig is None and "body" in spec.options:
        raise SourceError("ros2: body is an option for a rig file (--rig); without one, body is the IMU's frame")
    return Ros2Source(spec, rig)


class Ros2Source:
    """Topics of ROS 2 as a `LiveSource`; stamps are those of the messages, assumed to be of one clock.

    Args:
        spec: the topics and options, see `open_source`.
        rig: the rig, or None to receive it from ``camera_info`` and ``tf_static``.
    """

    is_realtime = True

    def __init__(self, spec: SourceSpec, rig: Rig | None) -> None:
        options = spec.options
        self._rig, self._domain = rig, domain_of(options.get("domain"))
        self._chosen = {name: topic for name, topic in options.items() if name not in _OPTIONS}
        self._imu, self._body = options.get("imu"), options.get("body")
        self._is_reliable = choice_of(spec, "reliable", ("0", "1")) == "1"
        wait_s = number_of(spec, "wait_s", 0.0, 1e6)
        self._wait_s = _WAIT_S if wait_s is None else wait_s
        self._closing = threading.Event()
        self._node: Node | None = None
        self._topics: list[SensorTopic] = []
        self._last_health: Sequence[DeviceHealth] = []
        self._transforms: dict[tuple[str, str], Float] = {}

    @property
    def name(self) -> str:
        """Name for people, which can also be used in file names."""
        return f"ros2-domain{self._domain}"

    def open(self) -> Rig:
        """Find the topics and subscribe to them.

        Raises:
            SourceError: if a topic is not published.
            RigError: if no rig is given, and camera_info and transforms do not make one.
        """
        node = Node(self._domain)
        deadline_s = time.monotonic() + self._wait_s

        def wait(seconds: float) -> bool:
            return not self._closing.wait(seconds) and time.monotonic() < deadline_s

        published = self._published(node, wait)
        types = {each.topic: each.type_name for each in published}
        imus = sorted(name for name, kind in types.items() if kind == IMU)
        imu = self._imu if self._imu is not None else next(iter(imus), None)
        if self._rig is None:
            rig, cameras = listen_for_rig(node, published, self._chosen, imu, wait)
            if imu is not None and rig.imu is None:
                raise SourceError(f"{self.name}: no sample came on {imu}, though it is published; start the IMU")
        else:
            rig = self._rig
            cameras = _topics_of(rig, self._chosen, types, self.name)
            if rig.imu is not None and imu is None:
                raise SourceError(
                    f"{self.name}: no topic has samples of an IMU, but the rig has one; start its publisher, or "
                    "give a rig without"
                )
        if self._body is not None:
            self._transforms = listen_for_transforms(node, published, wait)
        topics = [SensorTopic(node, cameras[each.name], types, each.name, self._is_reliable) for each in rig.cameras]
        if rig.imu is not None and imu is not None:
            topics.insert(0, SensorTopic(node, imu, types, None, self._is_reliable))
        while silent := [each for each in topics if not each.reader.writers]:
            if silent[0].reader.refused_writers or not wait(_POLL_S):
                raise _no_writer(silent[0], self.name)
        for each in topics:
            each.poll()
        node.announce(_NODE)
        self._node, self._topics = node, topics
        return rig

    def readings(self) -> Iterator[Reading]:
        """Yield readings in the order of arrival until `close`."""
        node, topics = self._node, self._topics
        if node is None:
            return
        wait = node.waiter([each.reader for each in topics])
        rotation = None if self._body is None else BodyRotation(self._body, self._transforms)
        polled_s = time.monotonic()
        while not self._closing.is_set():
            wait(_LIVENESS_S)
            for topic in topics:
                for reading in topic.take():
                    if rotation is not None and isinstance(reading, ImuReading):
                        yield from rotation.apply(reading, topic)
                    else:
                        yield reading
            if time.monotonic() - polled_s >= _LIVENESS_S:
                polled_s = time.monotonic()
                yield from filter(None, [each.poll() for each in topics])

    def health(self) -> Sequence[DeviceHealth]:
        """Return the state of each topic; may be called from any thread."""
        return [each.health for each in self._topics] or self._last_health

    def close(self) -> None:
        """Leave the domain; may be called from any thread."""
        self._closing.set()
        node, self._node = self._node, None
        if node is not None:
            node.stop()
            self._last_health, self._topics = self.health(), []  # DDS entities are released with the topics

    def _published(self, node: Node, wait: Callable[[float], bool]) -> list[Publication]:
        """Wait until all named topics are published and, unless these suffice, discovery is complete."""
        named = {*self._chosen.values(), *filter(None, [self._imu])}
        has_all = self._rig is not None and self._chosen.keys() >= {each.name for each in self._rig.cameras}
        has_all = has_all and self._body is None and (self._imu is not None or self._rig is None or not self._rig.imu)
        count, since_s = -1, time.monotonic()
        while True:
            published = node.publications()
            if len(published) != count:
                count, since_s = len(published), time.monotonic()
            missing = named - {each.topic for each in published}
            is_complete = has_all or time.monotonic() - since_s >= _DISCOVERY_S
            if is_complete and not missing and self._suffices({each.topic: each.type_name for each in published}):
                return published
            if not wait(_POLL_S):
                break
        if missing or not published:
            topics = listed(sorted({each.topic for each in published}))
            raise SourceError(
                f"{self.name}: no publisher of {min(missing, default='any topic')}; start it, or check ROS_DOMAIN_ID "
                f"and the network. Topics on domain {self._domain}: {topics}"
            )
        return published

    def _suffices(self, types: Mapping[str, str]) -> bool:
        """Return whether each sensor has a topic; otherwise its publisher may not have started yet."""
        if self._rig is None:
            return bool(stereo_topics(_images(types)))
        try:
            _topics_of(self._rig, self._chosen, types, self.name)
        except SourceError:
            return False
        return self._rig.imu is None or self._imu is not None or IMU in types.values()


def _images(types: Mapping[str, str]) -> list[str]:
    return sorted(name for name, kind in types.items() if kind in (IMAGE, COMPRESSED))


def _topics_of(rig: Rig, chosen: Mapping[str, str], types: Mapping[str, str], where: str) -> dict[str, str]:
    """Find the topic of each camera: as given, as graphvio names it, or the one whose name contains the camera's.

    Raises:
        SourceError: if a camera has none.
    """
    images = _images(types)
    found = dict(chosen)
    for group in rig.groups:
        for side, camera in zip(sides_of(group), group.cameras, strict=True):
            usual = [image_topic(group.name, side, "raw"), image_topic(group.name, side, "png"), camera.name]
            named = [name for name in usual if name in images]
            named += sorted((name for name in images if camera.name in name.split("/")), key=preference)
            if camera.name not in found and not named:
                raise SourceError(
                    f"{where}: no topic has a name that fits the images of {camera.name}; give {camera.name}=/TOPIC. "
                    f"Topics with images: {listed(images)}"
                )
            if camera.name not in found:
                found[camera.name] = named[0]
    return found


def _no_writer(topic: SensorTopic, where: str) -> SourceError:
    if topic.reader.refused_writers:
        return SourceError(
            f"{where}: the publisher of {topic.name} does not send lost samples again (best effort); leave out "
            "reliable=1"
        )
    return SourceError(f"{where}: {topic.name} has no publisher any more; start its publisher again")
