"""Sessions and bags, whatever their file format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from graphvio.sessions.topics import MessageReader


class Store(MessageReader, Protocol):
    """A session or bag, for any number of threads.

    Attributes:
        path: of the file, or of the folder of a ROS 2 bag.
        topics: name -> topic.
        library: that wrote it; empty for bags.
        attachments: name -> content; none in bags.
        is_whole: whether its writing was finished.
        damages: one line for each record that cannot be used.
        has_damaged_attachment: whether an attachment is among them.
    """

    library: str
    attachments: dict[str, bytes]
    is_whole: bool
    damages: list[str]
    has_damaged_attachment: bool

    @property
    def damaged_chunks(self) -> int:
        """How many of the chunks that have been read so far are damaged."""


def is_store(path: Path) -> bool:
    """Return whether a path is a session or a bag."""
    return path.suffix in (".mcap", ".bag") if path.is_file() else (path / "metadata.yaml").is_file()


def open_store(path: Path, is_wanted: Callable[[str], bool] = lambda topic: True) -> Store:
    """Open a session or bag.

    Args:
        path: of the file, or of the folder of a ROS 2 bag.
        is_wanted: whether a topic of a bag is read; fewer topics take less time.

    Raises:
        SessionError: if it cannot be read.
        MissingExtraError: if the extra ``sessions`` is not installed.
    """
    if path.is_file() and path.suffix == ".mcap":
        from graphvio.sessions.mcap_file import McapFile

        return McapFile(path)
    from graphvio.sessions.bag_file import BagFile

    return BagFile(path, is_wanted)
