"""The interfaces of writers of recordings, and of the file formats in which a session is written."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, Self

from graphvio.arrays import Float
from graphvio.errors import SessionError
from graphvio.measurements.events import Event
from graphvio.measurements.sensors import Measurement
from graphvio.rig import Rig

_log = logging.getLogger(__name__)


class RecordingWriter(ABC):
    """Base class of writers of a source's measurements; a context manager that closes the file or folder.

    When the disk is full or nothing can be written any more, writing stops; this is logged, `stopped` has the reason,
    and later calls do nothing.

    Attributes:
        path: path of the file or folder.
        rig: the rig of the framesets, as written: without stamp offsets, as the stamps of framesets are corrected.
        stopped: why writing stopped, or None.
    """

    _work = "writing"
    _remainder = "what was written until then can be read"

    def __init__(self, path: Path, rig: Rig) -> None:
        self.path = path
        self.rig = rig.without_stamp_offsets()
        self.stopped: str | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def add(self, measurement: Measurement) -> None:
        """Write an IMU sample or a frameset."""

    @abstractmethod
    def add_true_pose(self, stamp_ns: int, world_T_body: Float) -> None:
        """Write a pose ``world_T_body`` (4, 4) of the true trajectory."""

    @abstractmethod
    def add_event(self, event: Event) -> None:
        """Write an event if the format has a place for it."""

    @abstractmethod
    def close(self) -> None:
        """Finish the file or folder; a second time does nothing."""

    def _guarded(self, write: Callable[[], None]) -> None:
        if self.stopped is None:
            try:
                write()
            except OSError as error:
                self._stop(error)

    def _stop(self, error: OSError) -> None:
        if self.stopped is None:
            self.stopped = f"{self.path}: {self._work} stopped ({error.strerror}); {self._remainder}"
            _log.error("%s", self.stopped)


class Storage(Protocol):
    """Interface of a file or folder to which messages are written by topic; methods raise `OSError` if that fails.

    Attributes:
        path: path of the file or folder.
        has_attachments: whether it can hold texts in addition to messages.
        is_readable_when_cut: whether it can be read if its writing was not finished.
    """

    path: Path
    has_attachments: bool
    is_readable_when_cut: bool

    def attach(self, name: str, text: str) -> None:
        """Store a text before all messages, if it `has_attachments`."""

    def write(self, topic: str, stamp_ns: int, message: Any, is_latched: bool) -> None:
        """Store a ROS 2 message of rosbags' types; late subscribers still get the last message of a latched topic."""

    def finish(self) -> None:
        """Write the end of the file."""

    def close(self) -> None:
        """Close the file, finished or not."""


def exists_error(path: Path) -> SessionError:
    """Return the error for a session that would be overwritten."""
    return SessionError(f"{path}: exists, and sessions are never overwritten; name another file")


def not_writable_error(path: Path, error: OSError) -> SessionError:
    """Return the error for a session that cannot be created."""
    return SessionError(f"{path}: cannot be written ({error.strerror}); choose another place")
