"""Reader of ROS 1 bags, and of ROS 2 bags as folders or SQLite files, with the ``rosbags`` library, without ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from graphvio.errors import SessionError, importing
from graphvio.sessions import cdr, ros1
from graphvio.sessions.messages import STAMPED
from graphvio.sessions.topics import Place, Store, Topic

with importing("rosbags", "sessions", "reading a bag"):
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore


class BagFile(Store):
    """A bag: ``NAME.bag``, ``NAME.db3`` or the folder of a ROS 2 bag.

    Messages of the wanted topics are read as those of ROS 2. The whole bag is read once for the stamps of its messages'
    headers; single messages are read again by `read`.
    """

    def __init__(self, path: Path, is_wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(path)
        self._lock = threading.Lock()
        try:
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
            self._connections: list[Any] = [each for each in self._reader.connections if is_wanted(each.topic)]
            self._indexes = [] if self._reader.is2 else [each.owner.indexes[each.id] for each in self._connections]
            self._scan()
        except (AnyReaderError, OSError, ValueError, KeyError, AssertionError) as error:
            raise SessionError(f"{path}: cannot be read as a bag ({str(error) or type(error).__name__})") from None

    def read(self, place: Place) -> bytes:
        """Return a message as CDR."""
        connection = self._connections[place.chunk]
        with self._lock:
            data = next((raw for _, _, raw in self._found(connection, place)), None)
        if data is None:
            raise SessionError(f"{self.path}: a message of {connection.topic} is missing now; open the bag again")
        return self._as_cdr(connection, data)

    def _found(self, connection: Any, place: Place) -> Any:
        """Return the messages of a connection from the one at a place on: by row in ROS 1, by time in ROS 2."""
        if self._reader.is2:
            return self._reader.messages([connection], start=place.offset, stop=place.offset + 1)
        rows = self._indexes[place.chunk]
        # The library would read all messages before the wanted one, so it is given an index of that one only.
        connection.owner.indexes[connection.id] = rows[place.offset : place.offset + 1]
        return self._reader.messages([connection])

    def _as_cdr(self, connection: Any, data: bytes) -> bytes:
        if self._reader.is2:
            return bytes(data)
        return cdr.encode(ros1.modern(self._reader.typestore.deserialize_ros1(data, connection.msgtype)))

    def _scan(self) -> None:
        numbers = {id(each): number for number, each in enumerate(self._connections)}
        rows = [0] * len(self._connections)
        for each in self._connections:
            self.topics.setdefault(each.topic, Topic(each.topic, each.msgtype))
        if not self._connections:
            return
        for connection, logged_ns, data in self._reader.messages(self._connections):
            topic, number = self.topics[connection.topic], numbers[id(connection)]
            row = rows[number]
            rows[number] += 1
            if self._reader.is2 and topic.logged_ns and topic.logged_ns[-1] == logged_ns:
                continue  # it could not be distinguished from the previous message
            topic.logged_ns.append(logged_ns)
            topic.places.append(Place(number, logged_ns if self._reader.is2 else row))
            if connection.msgtype in STAMPED:
                topic.header_ns.append(cdr.stamp_ns(data) if self._reader.is2 else ros1.stamp_ns(data))
