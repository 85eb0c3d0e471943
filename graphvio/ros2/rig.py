"""The rig that a ROS 2 system tells while it runs: ``camera_info`` beside the images, and ``tf_static``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from graphvio.arrays import Float
from graphvio.errors import RigError, SessionError
from graphvio.rig import Rig
from graphvio.ros2.node import Node, Publication, Reader
from graphvio.ros2.qos import SENSOR_DATA, TF_STATIC_READER
from graphvio.sessions import cdr
from graphvio.sessions.messages import CAMERA_INFO, COMPRESSED, IMAGE, IMU, TRANSFORMS
from graphvio.sessions.rig_of_topics import info_topics, rig_of_topics, stereo_topics, transforms_in
from graphvio.sessions.topics import Place, Topic


class Heard:
    """First messages of topics, as `graphvio.sessions.rig_of_topics` reads a file."""

    def __init__(self, domain: int) -> None:
        self.path = Path(f"DDS domain {domain}")
        self.topics: dict[str, Topic] = {}
        self._data: list[bytes] = []

    def add(self, topic: str, type_name: str, data: bytes) -> None:
        """Keep a message."""
        self.topics.setdefault(topic, Topic(topic, type_name, "cdr")).places.append(Place(-1, len(self._data)))
        self._data.append(data)

    def read(self, place: Place) -> bytes:
        """A message."""
        return self._data[place.offset]


def listen_for_rig(
    node: Node,
    published: list[Publication],
    cameras: Mapping[str, str],
    imu: str | None,
    wait: Callable[[float], bool],
) -> tuple[Rig, dict[str, str]]:
    """The rig of the stereo pairs that are published.

    Args:
        node: takes part in the domain.
        published: there.
        cameras: name -> topic with its images, of those that are to be taken; all, where there are none.
        imu: topic of its samples, or None without one.
        wait: sleeps for so many seconds; false when the time is over.

    Returns:
        It, and for each of its cameras the topic with the images.

    Raises:
        RigError: if what is told by the end of the time makes none.
    """
    types = {each.topic: each.type_name for each in published}
    images = [name for name, kind in types.items() if kind in (IMAGE, COMPRESSED)]
    if cameras:
        images = [name for name in images if name in cameras.values()]
    wanted = {name for both in stereo_topics(images).values() for image in both for name in _info_of(image, types)}
    readers = [node.reader(name, CAMERA_INFO, SENSOR_DATA) for name in sorted(wanted)]
    readers += [node.reader(imu, IMU, SENSOR_DATA)] if imu is not None else []
    heard = _heard(node, readers, published, wait)
    for name in images:
        heard.add(name, types[name], b"")
    try:
        rig = rig_of_topics(heard, f"ros2-domain{node.domain}")
    except SessionError as error:
        raise RigError(f"{heard.path}: {error}") from None
    if rig is None:
        raise RigError(
            f"{heard.path}: no rig is told: it takes images and camera_info of a left and a right camera; topics with "
            f"images are {', '.join(sorted(images)) or 'none'}, with camera_info {_names(published, CAMERA_INFO)}. "
            "Give a rig of your own"
        )
    return _renamed(rig, cameras)


def listen_for_transforms(node: Node, published: list[Publication], wait: Callable[[float], bool]) -> Any:
    """All static transforms, see `transforms_in`."""
    made: dict[tuple[str, str], Float] = {}
    heard = _heard(node, [], published, wait)
    for topic in heard.topics.values():
        for place in topic.places:
            made.update(transforms_in(cdr.decode(heard.read(place), TRANSFORMS, heard.path)))
    return made


def _heard(node: Node, readers: list[Reader], published: list[Publication], wait: Callable[[float], bool]) -> Heard:
    """The first message of each reader's topic, and one of static transforms for each who publishes some."""
    heard = Heard(node.domain)
    least = Counter(
        each.topic for each in published if each.type_name == TRANSFORMS and each.topic.endswith("tf_static")
    )
    readers = readers + [node.reader(topic, TRANSFORMS, TF_STATIC_READER) for topic in sorted(least)]
    counts = {reader.topic: 0 for reader in readers}
    while True:
        for reader in readers:
            for sample in reader.take():
                if not counts[reader.topic] or reader.topic in least:
                    heard.add(reader.topic, reader.type_name, sample.data)
                counts[reader.topic] += 1
        if all(count >= least.get(topic, 1) for topic, count in counts.items()) or not wait(0.05):
            return heard


def _info_of(image: str, types: Mapping[str, str]) -> list[str]:
    return [name for name in info_topics(image) if types.get(name) == CAMERA_INFO][:1]


def _names(published: list[Publication], type_name: str) -> str:
    return ", ".join(sorted({each.topic for each in published if each.type_name == type_name})) or "none"


def _renamed(rig: Rig, cameras: Mapping[str, str]) -> tuple[Rig, dict[str, str]]:
    """Cameras are named by their topics, but where the user has names for them."""
    names = {topic: name for name, topic in cameras.items()}
    topics = {names.get(camera.name, camera.name): camera.name for camera in rig.cameras}
    unused = sorted(set(cameras.values()) - set(topics.values()))
    if unused:
        raise RigError(f"{rig.name}: {unused[0]} belongs to no stereo pair that is told; give a rig of your own")
    pairs = tuple(
        replace(
            pair,
            left=replace(pair.left, name=names.get(pair.left.name, pair.left.name)),
            right=replace(pair.right, name=names.get(pair.right.name, pair.right.name)),
        )
        for pair in rig.pairs
    )
    return replace(rig, pairs=pairs), topics
