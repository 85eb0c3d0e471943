"""Opening of sessions and bags of any file format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from graphvio.sessions.topics import Store

SUFFIXES = (".mcap", ".bag", ".db3")
"""Suffixes of files that are sessions or bags by themselves: MCAP, ROS 1, and ROS 2 with SQLite."""


def is_store(path: Path) -> bool:
    """Return whether a path is a session or a bag."""
    return path.suffix in SUFFIXES if path.is_file() else (path / "metadata.yaml").is_file()


def open_store(path: Path, is_wanted: Callable[[str], bool] = lambda topic: True) -> Store:
    """Open a session or bag.

    Args:
        path: path of the file, or of the folder of a ROS 2 bag.
        is_wanted: returns whether a topic of a bag is read; fewer topics take less time.

    Raises:
        SessionError: if it cannot be read.
        MissingExtraError: if the extra ``sessions`` is not installed.
    """
    if path.is_file() and path.suffix == ".mcap":
        from graphvio.sessions.mcap_file import McapFile

        return McapFile(path)
    from graphvio.sessions.bag_file import BagFile

    return BagFile(path, is_wanted)
