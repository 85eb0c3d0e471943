"""Writer of ROS 1 bags and ROS 2 bags with the ``rosbags`` library, without ROS."""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from graphvio.errors import importing
from graphvio.sessions import cdr, ros1
from graphvio.sessions.storage import exists_error, not_writable_error

with importing("rosbags", "sessions", "writing a bag"):
    from rosbags import rosbag1, rosbag2
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

_ROS2_VERSION: Final = 8  # of metadata.yaml; the newest version whose QoS profiles older distributions read, too
_FOREVER = QosTime(9223372036, 854775807)  # as ROS writes it
_LATCHED = Qos(  # the quality of service of ROS 2 that corresponds to a latched topic of ROS 1
    history=QosHistory.KEEP_LAST,
    depth=1,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.TRANSIENT_LOCAL,
    deadline=_FOREVER,
    lifespan=_FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_FOREVER,
    avoid_ros_namespace_conventions=False,
)


class _Bag:
    """Common part of bags of ROS 1 and ROS 2: see `Storage`; raises a `SessionError` if the target exists."""

    has_attachments = False
    is_readable_when_cut = False

    def __init__(self, path: Path, writer: Callable[[], Any]) -> None:
        self.path = path
        try:
            with _os_errors():
                self._writer = writer()
                self._writer.open()
        except (rosbag1.WriterError, rosbag2.WriterError):
            raise exists_error(path) from None
        except OSError as error:
            raise not_writable_error(path, error) from None

    def attach(self, name: str, text: str) -> None:
        """Raise an error: bags have no attachments."""
        raise NotImplementedError

    def finish(self) -> None:
        """Write the index."""
        with _os_errors():
            self._writer.close()

    def close(self) -> None:
        """Close the file if it was not finished."""
        with _os_errors():
            self._writer.abort()


class Ros1Storage(_Bag):
    """A ROS 1 bag; it cannot be read without the index at its end."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, lambda: rosbag1.Writer(path))
        self._connections: dict[str, tuple[Any, int]] = {}  # topic -> connection, messages so far

    def write(self, topic: str, stamp_ns: int, message: Any, is_latched: bool) -> None:
        """Store a ROS 2 message as the corresponding ROS 1 message: see `Storage`."""
        if topic not in self._connections:
            name = ros1.type_name(message.__msgtype__)
            latching = 1 if is_latched else None
            made = self._writer.add_connection(topic, name, typestore=ros1.types(), latching=latching)
            self._connections[topic] = made, 0
        connection, count = self._connections[topic]
        self._connections[topic] = connection, count + 1
        self._writer.write(connection, stamp_ns, ros1.encode(message, count))


class Ros2Storage(_Bag):
    """A ROS 2 bag: a folder with an SQLite file, which has all messages only after `finish`."""

    def __init__(self, path: Path) -> None:
        sqlite = rosbag2.StoragePlugin.SQLITE3
        super().__init__(path, lambda: rosbag2.Writer(path, version=_ROS2_VERSION, storage_plugin=sqlite))
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, stamp_ns: int, message: Any, is_latched: bool) -> None:
        """Store a message: see `Storage`."""
        with _os_errors():
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(
                    topic,
                    message.__msgtype__,
                    typestore=cdr.types(),
                    offered_qos_profiles=[_LATCHED] if is_latched else [],
                )
            self._writer.write(self._connections[topic], stamp_ns, cdr.encode(message))


@contextmanager
def _os_errors() -> Iterator[None]:
    """Raise errors of SQLite as OSError."""
    try:
        yield
    except sqlite3.Error as error:
        raise OSError(errno.EIO, str(error)) from None
