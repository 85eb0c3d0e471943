"""Sessions and others' MCAP files, ROS 2 bags and ROS 1 bags."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from graphvio.arrays import Image, Int
from graphvio.errors import SessionError, SourceError
from graphvio.image_decoding import ImageError
from graphvio.rig import Camera, Rig
from graphvio.rig_files.native import parse
from graphvio.sessions import cdr
from graphvio.sessions.messages import COMPRESSED, IMAGE, IMU, TEXT, imu_sample, stamp_of
from graphvio.sessions.pixels import grey
from graphvio.sessions.rig_of_topics import rig_of_topics
from graphvio.sessions.stamps import header_stamps
from graphvio.sessions.store import Store, is_store
from graphvio.sessions.topics import RIG_ATTACHMENT, RIG_TOPIC, Place, Topic, image_topic, of_type, preference
from graphvio.sessions.truth import truth_topic
from graphvio.sources.faults import FaultLog
from graphvio.sources.recording import Index
from graphvio.sources.tables import ImuTable, clean_stamps

_IMU_NAME = "imu"
LAYOUT = "sessions and bags: NAME.mcap, NAME.bag, a folder with metadata.yaml"


def matches(path: Path) -> bool:
    """Whether a path is a session or a bag."""
    return is_store(path)


def rig_in(file: Store) -> Rig | None:
    """The rig that a session carries, or that a bag's messages tell; None if there is none.

    Raises:
        RigError: if its rig describes none that is usable.
        SessionError: if its rig is damaged.
    """
    attached = file.attachments.get(RIG_ATTACHMENT)
    if attached is not None:
        try:
            text = attached.decode("utf-8")
        except UnicodeDecodeError:
            raise _damaged_rig(file) from None
        return parse(text, file.path)
    if file.has_damaged_attachment:
        raise _damaged_rig(file)
    told = file.topics.get(RIG_TOPIC)
    if told is not None and told.type_name == TEXT and told.places:
        return parse(cdr.decode(file.read(told.places[0]), TEXT, file.path).data, file.path)
    return rig_of_topics(file, file.path.stem)


def _damaged_rig(file: Store) -> SessionError:
    return SessionError(f"{file.path}: the rig in it is damaged; copy the file anew, or give a rig of your own")


def read_index(file: Store, rig: Rig, faults: FaultLog, topics: Mapping[str, str]) -> Index:
    """Index the cameras of a rig, and the IMU if it has one.

    Args:
        file: the session or bag.
        rig: whose cameras are looked for.
        faults: goes on to count.
        topics: name of a camera, or ``imu`` -> its topic, where names do not tell.

    Raises:
        SourceError: if a camera of the rig has no images in it.
    """
    chosen = {name: _named(file, topic) for name, topic in topics.items()}
    unknown = set(chosen) - {camera.name for camera in rig.cameras} - {_IMU_NAME}
    if unknown:
        names = ", ".join([*(camera.name for camera in rig.cameras), _IMU_NAME])
        raise SourceError(f"{file.path}: the rig has no {min(unknown)} to be mapped to a topic; it has {names}")
    if not file.is_whole:
        faults.add("session_cut", 0, f"{file.path} was not finished, or is damaged: it is read as far as it goes")
    for detail in file.damages:
        faults.add("session_damaged", 0, detail)
    tracks = {}
    for pair in rig.pairs:
        for side, camera in (("left", pair.left), ("right", pair.right)):
            topic = chosen.get(camera.name) or _topic_of(file, pair.name, side, camera)
            tracks[camera.name] = _Images(file, topic, faults)
    of_imu = of_type(file.topics, IMU)
    imu = chosen.get(_IMU_NAME) or next(iter(of_imu), None)
    if len(of_imu) > 1 and _IMU_NAME not in chosen and rig.imu is not None:
        names = ", ".join(each.name for each in of_imu)
        detail = f"{file.path}: has samples on {names}; the first is taken, or what --topics imu=TOPIC says"
        faults.add("imu_several", 0, detail)
    table = None if imu is None or rig.imu is None else _imu(file, imu, faults)
    return Index(faults.name, tracks, table, file.path if truth_topic(file.topics) is not None else None)


def _named(file: Store, name: str) -> Topic:
    if name not in file.topics:
        raise SourceError(f"{file.path}: has no topic {name}; it has {', '.join(sorted(file.topics))}")
    return file.topics[name]


class _Images:
    """Images of one topic."""

    def __init__(self, file: Store, topic: Topic, faults: FaultLog) -> None:
        self._file, self._type, self._name = file, topic.type_name, topic.name
        stamps = header_stamps(file, topic)
        order = np.argsort(stamps, kind="stable")
        kept = order[clean_stamps(stamps[order], "frame", file.path, faults)]
        self.stamps_ns: Int = stamps[kept]
        self._places: Sequence[Place] = [topic.places[k] for k in kept.tolist()]

    def read(self, row: int) -> Image:
        """The image of a row."""
        where = f"{self._file.path}, {self._name} at {self.stamps_ns[row]}"
        try:
            message = cdr.decode(self._file.read(self._places[row]), self._type, self._file.path)
            image = grey(message, where)
        except (SessionError, IndexError, ValueError, cv2.error) as error:
            raise ImageError("image_undecodable", f"{where} cannot be decoded ({error})") from None
        if stamp_of(message.header) != self.stamps_ns[row]:
            raise ImageError("image_undecodable", f"{where} is damaged: it has the stamp {stamp_of(message.header)}")
        return image


def _topic_of(file: Store, pair: str, side: str, camera: Camera) -> Topic:
    """The topic of a camera's images: as graphvio names it, or whose name has the camera's."""
    for name in (image_topic(pair, side, "raw"), image_topic(pair, side, "png"), camera.name):
        if name in file.topics:
            return file.topics[name]
    images = [topic for topic in file.topics.values() if topic.type_name in (IMAGE, COMPRESSED)]
    named = [topic for topic in images if camera.name in topic.name.split("/")]
    if not named:
        has = ", ".join(topic.name for topic in images) or "none"
        raise SourceError(f"{file.path}: has no images of camera {camera.name}; topics with images: {has}")
    return min(named, key=lambda topic: preference(topic.name))


def _imu(file: Store, topic: Topic, faults: FaultLog) -> ImuTable:
    stamps: list[int] = []
    values: list[list[float]] = []
    for place, logged_ns in zip(topic.places, topic.logged_ns, strict=True):
        try:
            sample = imu_sample(cdr.decode(file.read(place), IMU, file.path))
        except SessionError as error:
            faults.add("imu_garbage", logged_ns, str(error))
            continue
        row = [*sample.angular_velocity.tolist(), *sample.linear_acceleration.tolist()]
        if not np.isfinite(row).all() or sample.stamp_ns < 0:
            detail = f"{file.path}: the sample of stamp {sample.stamp_ns} holds NaN, infinity or an impossible stamp"
            faults.add("imu_garbage", sample.stamp_ns, detail)
            continue
        stamps.append(sample.stamp_ns)
        values.append(row)
    table = ImuTable(np.array(stamps, dtype=np.int64), np.array(values, dtype=np.float64).reshape(-1, 6))
    kept = clean_stamps(table.stamps_ns, "imu", file.path, faults)
    return ImuTable(table.stamps_ns[kept], table.values[kept])
