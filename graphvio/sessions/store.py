"""Sessions and bags, whatever their file format."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path

from graphvio.sessions.topics import Place, Topic

SUFFIXES = (".mcap", ".bag", ".db3")
"""Of files that are sessions or bags by themselves: MCAP, ROS 1, and ROS 2 with SQLite."""


class Store(ABC):
    """A session or bag, for any number of threads; a `graphvio.sessions.topics.MessageReader`."""

    def __init__(self, path: Path) -> None:
        self.path = path  # of the file, or of the folder of a ROS 2 bag
        self.topics: dict[str, Topic] = {}  # by name
        self.library = ""  # that wrote it; empty for bags
        self.attachments: dict[str, bytes] = {}  # by name; none in bags
        self.is_whole = True  # whether its writing was finished
        self.damages: list[str] = []  # one line for each record that cannot be used
        self.has_damaged_attachment = False  # whether an attachment is among them

    @abstractmethod
    def read(self, place: Place) -> bytes:
        """Return a message as CDR.

        Raises:
            SessionError: if it is damaged.
        """

    @property
    def damaged_chunks(self) -> int:
        """How many of the chunks that have been read so far are damaged; bags have none."""
        return 0


def is_store(path: Path) -> bool:
    """Return whether a path is a session or a bag."""
    return path.suffix in SUFFIXES if path.is_file() else (path / "metadata.yaml").is_file()


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
