"""Reads ROS 1 bags, and ROS 2 bags (folders with ``metadata.yaml``), by the ``rosbags`` library, without ROS."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from graphvio.errors import MissingExtraError, SessionError
from graphvio.sessions import cdr
from graphvio.sessions.mcap_file import Place, Topic

_READ = ("sensor_msgs/msg/", "tf2_msgs/msg/")


class BagFile:
    """A bag, for any number of threads; its messages are read as ROS 2 ones.

    The whole bag is read once for the stamps in its messages' headers; messages are then read where they are asked for.

    Args:
        path: ``NAME.bag``, or the folder of a ROS 2 bag.

    Attributes:
        path: of the bag.
        library: nothing is told.
        topics: name -> messages, of sensors and transforms only.
        attachments: none.
        is_whole: always.

    Raises:
        SessionError: if it cannot be read.
        MissingExtraError: if the extra ``sessions`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.highlevel import AnyReader, AnyReaderError
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise MissingExtraError("rosbags", "sessions", "reading a bag") from None
        self.path = path
        self.library = ""
        self.topics: dict[str, Topic] = {}
        self.attachments: dict[str, bytes] = {}
        self.is_whole = True
        self._lock = threading.Lock()
        try:
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
            self._connections = [each for each in self._reader.connections if each.msgtype.startswith(_READ)]
            self._scan()
        except (AnyReaderError, OSError, ValueError, KeyError, AssertionError) as error:
            raise SessionError(f"{path}: cannot be read as a bag ({str(error) or type(error).__name__})") from None

    def read(self, place: Place) -> bytes:
        """A message as CDR.

        Raises:
            SessionError: if it cannot be read any more.
        """
        connection, logged_ns = self._connections[place.chunk], place.offset
        with self._lock:
            found = self._reader.messages([connection], start=logged_ns, stop=logged_ns + 1)
            data = next((raw for _, _, raw in found), None)
        if data is None:
            raise SessionError(f"{self.path}: has no message of {connection.topic} at {logged_ns} any more")
        return self._as_cdr(connection, data)

    def _as_cdr(self, connection: Any, data: bytes) -> bytes:
        if self._reader.is2:
            return bytes(data)
        return cdr.encode(_modern(self._reader.typestore.deserialize_ros1(data, connection.msgtype)))

    def _scan(self) -> None:
        numbers = {id(each): number for number, each in enumerate(self._connections)}
        for each in self._connections:
            self.topics.setdefault(each.topic, Topic(each.topic, each.msgtype, "cdr"))
        if not self._connections:
            return
        for connection, logged_ns, data in self._reader.messages(self._connections):
            topic = self.topics[connection.topic]
            if topic.logged_ns and topic.logged_ns[-1] == logged_ns:
                continue  # it could not be told from the one before
            topic.logged_ns.append(logged_ns)
            topic.places.append(Place(numbers[id(connection)], logged_ns))
            if connection.msgtype.startswith("sensor_msgs/"):
                topic.header_ns.append(cdr.stamp_ns(data) if self._reader.is2 else _ros1_stamp_ns(data))


def _modern(message: Any) -> Any:
    """A ROS 1 message as ROS 2 has it: headers have no sequence number, and names of fields are lower case."""
    if isinstance(message, list):
        return [_modern(each) for each in message]
    type_name = getattr(message, "__msgtype__", None)
    if type_name is None:
        return message
    fields = {name.lower(): value for name, value in vars(message).items() if name != "__msgtype__"}
    if type_name == "std_msgs/msg/Header":
        fields.pop("seq", None)
    return cdr.make(type_name, **{name: _modern(value) for name, value in fields.items()})


def _ros1_stamp_ns(data: bytes) -> int:
    """ROS 1's header begins with a sequence number."""
    return int.from_bytes(data[4:8], "little") * 1_000_000_000 + int.from_bytes(data[8:12], "little")
