"""Writes ROS 1 bags and ROS 2 bags by the ``rosbags`` library, without ROS."""

from __future__ import annotations

import errno
import sqlite3
from pathlib import Path
from typing import Any, Final

from graphvio.errors import MissingExtraError
from graphvio.sessions import cdr, ros1
from graphvio.sessions.storage import exists_error, not_writable_error

_ROS2_VERSION: Final = 8  # of metadata.yaml; the newest whose QoS profiles older distributions read, too


class _Bag:
    """Common part of bags of ROS 1 and ROS 2."""

    has_attachments = False
    is_readable_when_cut = False

    def attach(self, name: str, text: str) -> None:
        """Raise an error: bags have no attachments."""
        raise NotImplementedError


class Ros1Storage(_Bag):
    """A ROS 1 bag; it cannot be read without the index at its end.

    Args:
        path: of the file, which must not exist.

    Raises:
        SessionError: if the file exists or cannot be created.
        MissingExtraError: if the extra ``sessions`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.rosbag1 import Writer, WriterError
        except ImportError:
            raise MissingExtraError("rosbags", "sessions", "writing a bag") from None
        self.path = path
        self._connections: dict[str, tuple[Any, int]] = {}  # topic -> connection, messages so far
        try:
            self._writer = Writer(path)
            self._writer.open()
        except WriterError:
            raise exists_error(path) from None
        except OSError as error:
            raise not_writable_error(path, error) from None

    def write(self, topic: str, stamp_ns: int, message: Any, is_latched: bool) -> None:
        """Store a ROS 2 message as the ROS 1 message: see `Storage`."""
        if topic not in self._connections:
            name = ros1.type_name(message.__msgtype__)
            latching = 1 if is_latched else None
            made = self._writer.add_connection(topic, name, typestore=ros1.types(), latching=latching)
            self._connections[topic] = made, 0
        connection, count = self._connections[topic]
        self._connections[topic] = connection, count + 1
        self._writer.write(connection, stamp_ns, ros1.encode(message, count))

    def finish(self) -> None:
        """Write the index."""
        self._writer.close()

    def close(self) -> None:
        """Close the file if it was not finished."""
        self._writer.abort()


class Ros2Storage(_Bag):
    """A ROS 2 bag: a folder with an SQLite file, which holds its messages once it is finished.

    Args:
        path: of the folder, which must not exist.

    Raises:
        SessionError: if the folder exists or cannot be created.
        MissingExtraError: if the extra ``sessions`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
        except ImportError:
            raise MissingExtraError("rosbags", "sessions", "writing a bag") from None
        self.path = path
        self._connections: dict[str, Any] = {}
        try:
            self._writer = Writer(path, version=_ROS2_VERSION, storage_plugin=StoragePlugin.SQLITE3)
            self._writer.open()
        except WriterError:
            raise exists_error(path) from None
        except (OSError, sqlite3.Error) as error:
            raise not_writable_error(path, _as_os_error(error)) from None

    def write(self, topic: str, stamp_ns: int, message: Any, is_latched: bool) -> None:
        """Store a message: see `Storage`."""
        try:
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(
                    topic,
                    message.__msgtype__,
                    typestore=cdr.types(),
                    offered_qos_profiles=[_latched()] if is_latched else [],
                )
            self._writer.write(self._connections[topic], stamp_ns, cdr.encode(message))
        except sqlite3.Error as error:
            raise _as_os_error(error) from None

    def finish(self) -> None:
        """Commit the messages, and write ``metadata.yaml``."""
        try:
            self._writer.close()
        except sqlite3.Error as error:
            raise _as_os_error(error) from None

    def close(self) -> None:
        """Close the file if it was not finished."""
        try:
            self._writer.abort()
        except sqlite3.Error as error:
            raise _as_os_error(error) from None


def _as_os_error(error: OSError | sqlite3.Error) -> OSError:
    return error if isinstance(error, OSError) else OSError(errno.EIO, str(error))


def _latched() -> Any:
    """The quality of service of ROS 2 that corresponds to a latched topic of ROS 1."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    forever = QosTime(9223372036, 854775807)  # as ROS writes it
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL,
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )
