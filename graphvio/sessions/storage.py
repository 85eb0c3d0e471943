"""Where a session's messages go: one file format each, all alike to the writer."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from graphvio.errors import SessionError


class Storage(Protocol):
    """A file, or folder, that takes messages by topic.

    Attributes:
        path: of it.
        has_attachments: whether it takes texts besides messages.
        is_readable_when_cut: whether what was written can be read where the writing was not finished.
    """

    path: Path
    has_attachments: bool
    is_readable_when_cut: bool

    def attach(self, name: str, text: str) -> None:
        """Store a text before all messages, where there `has_attachments`.

        Raises:
            OSError: if it cannot be written.
        """

    def write(self, topic: str, stamp_ns: int, message: Any, is_latched: bool) -> None:
        """Store a ROS 2 message; of a latched topic, subscribers that come late still get the last one.

        Raises:
            OSError: if it cannot be written.
        """

    def finish(self) -> None:
        """Write what stands at the end.

        Raises:
            OSError: if it cannot be written.
        """

    def close(self) -> None:
        """Let go of the file, finished or not.

        Raises:
            OSError: if the last bytes cannot be written.
        """


def exists_error(path: Path) -> SessionError:
    """That a session would be overwritten."""
    return SessionError(f"{path}: exists, and sessions are never overwritten; name another file")


def not_writable_error(path: Path, error: OSError) -> SessionError:
    """That a session cannot be begun."""
    return SessionError(f"{path}: cannot be written ({error.strerror}); choose another place")
