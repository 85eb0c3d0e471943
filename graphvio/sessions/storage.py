"""The interface of the file formats to which a session is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from graphvio.errors import SessionError


class Storage(Protocol):
    """A file or folder to which messages are written by topic; an `OSError` where it cannot be written.

    Attributes:
        path: of the file or folder.
        has_attachments: whether it can hold texts in addition to messages.
        is_readable_when_cut: whether it can be read if its writing was not finished.
    """

    path: Path
    has_attachments: bool
    is_readable_when_cut: bool

    def attach(self, name: str, text: str) -> None:
        """Store a text before all messages, if it `has_attachments`."""

    def write(self, topic: str, stamp_ns: int, message: Any, is_latched: bool) -> None:
        """Store a ROS 2 message of rosbags' types; late subscribers still get the last one of a latched topic."""

    def finish(self) -> None:
        """Write the end of the file."""

    def close(self) -> None:
        """Close the file, finished or not."""


def exists_error(path: Path) -> SessionError:
    """Return the error that a session would be overwritten."""
    return SessionError(f"{path}: exists, and sessions are never overwritten; name another file")


def not_writable_error(path: Path, error: OSError) -> SessionError:
    """Return the error that a session cannot be created."""
    return SessionError(f"{path}: cannot be written ({error.strerror}); choose another place")
