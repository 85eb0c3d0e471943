"""Reader of sessions, other MCAP files, and bags of ROS 1 and ROS 2."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from graphvio.arrays import Image, Int
from graphvio.errors import SessionError, SourceError
from graphvio.image_decoding import ImageError
from graphvio.measurements.events import EventKind
from graphvio.rig import Camera, Rig
from graphvio.rig_files.native import parse
from graphvio.sessions import cdr
from graphvio.sessions.messages import COMPRESSED, IMAGE, IMU, TEXT, imu_sample, stamp_of
from graphvio.sessions.pixels import grey
from graphvio.sessions.rig_of_topics import rig_of_topics
from graphvio.sessions.stamps import header_stamps
from graphvio.sessions.topics import (
    RIG_ATTACHMENT,
    RIG_TOPIC,
    Store,
    Topic,
    camera_of,
    image_topic,
    is_mask,
    mask_topic,
    of_type,
    preference,
    sides_of,
)
from graphvio.sessions.truth import truth_topic
from graphvio.sources.faults import FaultLog
from graphvio.sources.index import Index
from graphvio.sources.tables import ImuTable, clean_stamps
from graphvio.wording import listed

_IMU_NAME = "imu"
_MASKS = "/mask"  # after a camera's name


def rig_in(store: Store) -> Rig | None:
    """Return the rig that is stored in a session, or that its messages describe; None if there is neither."""
    damaged = SessionError(f"{store.path}: the rig in it is damaged; copy the file again, or give a rig of your own")
    attached = store.attachments.get(RIG_ATTACHMENT)
    if attached is not None:
        try:
            return parse(attached.decode("utf-8"), store.path)
        except UnicodeDecodeError:
            raise damaged from None
    if store.has_damaged_attachment:
        raise damaged
    topic = store.topics.get(RIG_TOPIC)
    if topic is not None and topic.type_name == TEXT and topic.places:
        return parse(cdr.decode(store.read(topic.places[0]), TEXT, store.path).data, store.path)
    return rig_of_topics(store, store.path.stem)


def read_index(store: Store, rig: Rig, faults: FaultLog, topics: Mapping[str, str]) -> Index:
    """Index the cameras of a rig, and the IMU if it has one; ``topics``: camera or ``imu`` -> topic of another name."""
    chosen = {name: _named(store, topic) for name, topic in topics.items()}
    names = {camera.name for camera in rig.cameras}
    unknown = set(chosen) - names - {name + _MASKS for name in names} - {_IMU_NAME}
    if unknown:
        known = ", ".join([*(camera.name for camera in rig.cameras), _IMU_NAME])
        raise SourceError(f"{store.path}: the rig has no {min(unknown)} to be mapped to a topic; it has {known}")
    if not store.is_whole:
        detail = f"{store.path} was not finished, or is damaged: it is read as far as it goes"
        faults.add(EventKind.SESSION_CUT, 0, detail)
    for detail in store.damages:
        faults.add(EventKind.SESSION_DAMAGED, 0, detail)
    images, masks = {}, {}
    for group in rig.groups:
        for side, camera in zip(sides_of(group), group.cameras, strict=True):
            topic = chosen.get(camera.name) or _topic_of(store, group.name, side, camera)
            images[camera.name] = _Images(store, topic, faults)
            mask = chosen.get(camera.name + _MASKS) or _topic_of_masks(store, group.name, side, topic)
            if mask is not None:
                masks[camera.name] = _Images(store, mask, faults)
    imu = _read_imu(store, chosen.get(_IMU_NAME), faults) if rig.imu is not None else None
    return Index(faults.name, images, imu, store.path if truth_topic(store.topics) is not None else None, masks)


def _named(store: Store, name: str) -> Topic:
    if name not in store.topics:
        raise SourceError(f"{store.path}: has no topic {name}; it has {listed(sorted(store.topics))}")
    return store.topics[name]


class _Images:
    """An `ImageSequence` of the images of one topic."""

    def __init__(self, store: Store, topic: Topic, faults: FaultLog) -> None:
        self._store, self._topic = store, topic
        stamps = header_stamps(store, topic)
        order = np.argsort(stamps, kind="stable")
        kept = order[clean_stamps(stamps[order], "frame", store.path, faults)]
        self.stamps_ns: Int = stamps[kept]
        self._places = [topic.places[k] for k in kept.tolist()]

    def read(self, row: int) -> Image:
        stamp_ns = int(self.stamps_ns[row])
        where = f"{self._store.path}, {self._topic.name} at {stamp_ns}"
        try:
            message = cdr.decode(self._store.read(self._places[row]), self._topic.type_name, self._store.path)
            image = grey(message, where)
        except (SessionError, IndexError, ValueError, cv2.error) as error:
            raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{where} cannot be decoded ({error})") from None
        if stamp_of(message.header) != stamp_ns:
            detail = f"{where} is damaged: it has the stamp {stamp_of(message.header)}"
            raise ImageError(EventKind.IMAGE_UNDECODABLE, detail)
        return image


def _topic_of(store: Store, pair: str, side: str, camera: Camera) -> Topic:
    """Return the topic of a camera's images: the one that graphvio uses, or one whose name has the camera's in it."""
    for name in (image_topic(pair, side, "raw"), image_topic(pair, side, "png"), camera.name):
        if name in store.topics:
            return store.topics[name]
    images = [t for t in store.topics.values() if t.type_name in (IMAGE, COMPRESSED) and not is_mask(t.name)]
    named = [topic for topic in images if camera.name in topic.name.split("/")]
    if not named:
        has = ", ".join(topic.name for topic in images) or "none"
        raise SourceError(f"{store.path}: has no images of camera {camera.name}; topics with images: {has}")
    return min(named, key=lambda topic: preference(topic.name))


def _topic_of_masks(store: Store, pair: str, side: str, images: Topic) -> Topic | None:
    """Return the topic of the masks of a camera's images: the one that graphvio uses, or one beside the images'."""
    beside = camera_of(images.name, sides=()) + _MASKS
    for name in (mask_topic(pair, side, "raw"), mask_topic(pair, side, "png"), beside, f"{beside}/compressed"):
        topic = store.topics.get(name)
        if topic is not None and topic.type_name in (IMAGE, COMPRESSED) and topic.places:
            return topic
    return None


def _read_imu(store: Store, chosen: Topic | None, faults: FaultLog) -> ImuTable | None:
    """Return the samples of the chosen topic, or if none is chosen of the first topic that has any."""
    found = of_type(store.topics, IMU)
    if chosen is None and len(found) > 1:
        names = ", ".join(each.name for each in found)
        detail = f"{store.path}: has samples on {names}; the first is used, unless --topics imu=TOPIC names another"
        faults.add(EventKind.IMU_SEVERAL, 0, detail)
    topic = chosen or next(iter(found), None)
    if topic is None:
        return None
    stamps: list[int] = []
    values: list[list[float]] = []
    for place, logged_ns in zip(topic.places, topic.logged_ns, strict=True):
        try:
            sample = imu_sample(cdr.decode(store.read(place), IMU, store.path))
        except SessionError as error:
            faults.add(EventKind.IMU_GARBAGE, logged_ns, str(error))
            continue
        row = [*sample.angular_velocity.tolist(), *sample.linear_acceleration.tolist()]
        if not np.isfinite(row).all() or sample.stamp_ns < 0:
            detail = f"{store.path}: the sample of stamp {sample.stamp_ns} holds NaN, infinity or an impossible stamp"
            faults.add(EventKind.IMU_GARBAGE, sample.stamp_ns, detail)
            continue
        stamps.append(sample.stamp_ns)
        values.append(row)
    table = ImuTable(np.array(stamps, dtype=np.int64), np.array(values, dtype=np.float64).reshape(-1, 6))
    kept = clean_stamps(table.stamps_ns, "imu", store.path, faults)
    return ImuTable(table.stamps_ns[kept], table.values[kept])
