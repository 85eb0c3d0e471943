"""The rig of a running ROS 2 system, from its ``camera_info`` and ``tf_static`` topics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from graphvio.arrays import Float
from graphvio.errors import RigError, SessionError
from graphvio.rig import Rig
from graphvio.ros2.node import Node, Publication, Reader
from graphvio.ros2.wire import SENSOR_DATA, TF_STATIC_READER
from graphvio.sessions.messages import CAMERA_INFO, COMPRESSED, IMAGE, IMU, TRANSFORMS
from graphvio.sessions.rig_of_topics import info_topics, rig_of_topics, stereo_topics, transforms_of
from graphvio.sessions.topics import Place, Topic
from graphvio.wording import listed

_POLL_S = 0.05


class _FirstMessages:
    """Received messages by topic, with the interface of `graphvio.sessions.topics.MessageReader`."""

    def __init__(self, domain: int) -> None:
        self.path = Path(f"DDS domain {domain}")
        self.topics: dict[str, Topic] = {}
        self._data: list[bytes] = []

    def add(self, topic: str, type_name: str, data: bytes) -> None:
        self.topics.setdefault(topic, Topic(topic, type_name)).places.append(Place(-1, len(self._data)))
        self._data.append(data)

    def read(self, place: Place) -> bytes:
        return self._data[place.offset]


def listen_for_rig(
    node: Node,
    published: list[Publication],
    cameras: Mapping[str, str],
    imu: str | None,
    wait: Callable[[float], bool],
) -> tuple[Rig, dict[str, str]]:
    """Make a rig of the stereo pairs whose images and ``camera_info`` are published.

    Args:
        node: participant of the domain.
        published: publications in the domain.
        cameras: name -> image topic of the cameras to be used; empty for all.
        imu: topic of the IMU, or None.
        wait: sleeps for a number of seconds, and returns False when the time for receiving is over.

    Returns:
        The rig, and name -> image topic of its cameras.

    Raises:
        RigError: if the messages received within the time do not make a rig.
    """
    types = {each.topic: each.type_name for each in published}
    images = [name for name, kind in types.items() if kind in (IMAGE, COMPRESSED)]
    if cameras:
        images = [name for name in images if name in cameras.values()]
    infos = set()
    for image in {image for pair in stereo_topics(images).values() for image in pair}:
        infos.update([name for name in info_topics(image) if types.get(name) == CAMERA_INFO][:1])
    readers = [Reader(node, name, CAMERA_INFO, SENSOR_DATA) for name in sorted(infos)]
    readers += [Reader(node, imu, IMU, SENSOR_DATA)] if imu is not None else []
    received = _receive(node, readers, published, wait)
    for name in images:
        received.add(name, types[name], b"")
    try:
        rig = rig_of_topics(received, f"ros2-domain{node.domain}")
    except SessionError as error:
        raise RigError(f"{received.path}: {error}") from None
    if rig is None:
        described = listed(sorted(name for name, kind in types.items() if kind == CAMERA_INFO))
        raise RigError(
            f"{received.path}: no stereo pair has images and camera_info of both cameras; give a rig by --rig. Images: "
            f"{listed(sorted(images))}; camera_info: {described}"
        )
    return _rename_cameras(rig, cameras)


def listen_for_transforms(
    node: Node, published: list[Publication], wait: Callable[[float], bool]
) -> dict[tuple[str, str], Float]:
    """Receive all static transforms, in the form of `graphvio.sessions.rig_of_topics.transforms_of`.

    See `listen_for_rig` for the arguments.
    """
    return transforms_of(_receive(node, [], published, wait))


def _receive(
    node: Node, readers: list[Reader], published: list[Publication], wait: Callable[[float], bool]
) -> _FirstMessages:
    """Receive the first message of each reader, and static transforms until there is one per publisher."""
    received = _FirstMessages(node.domain)
    expected = Counter(
        each.topic for each in published if each.type_name == TRANSFORMS and each.topic.endswith("tf_static")
    )
    readers = readers + [Reader(node, topic, TRANSFORMS, TF_STATIC_READER) for topic in sorted(expected)]
    counts = {reader.topic: 0 for reader in readers}
    while True:
        for reader in readers:
            for data in reader.take():
                if not counts[reader.topic] or reader.topic in expected:
                    received.add(reader.topic, reader.type_name, data)
                counts[reader.topic] += 1
        if all(count >= expected.get(topic, 1) for topic, count in counts.items()) or not wait(_POLL_S):
            return received


def _rename_cameras(rig: Rig, cameras: Mapping[str, str]) -> tuple[Rig, dict[str, str]]:
    """Rename cameras, whose names are their topics, to the user's names; return the rig, and each camera's topic."""
    names = {topic: name for name, topic in cameras.items()}
    topics = {names.get(camera.name, camera.name): camera.name for camera in rig.cameras}
    unused = sorted(set(cameras.values()) - set(topics.values()))
    if unused:
        raise RigError(f"{rig.name}: {unused[0]} belongs to no stereo pair; give a rig of your own")
    return rig.with_cameras(lambda camera: replace(camera, name=names.get(camera.name, camera.name))), topics
