"""Opens sessions and bags, whatever their format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from graphvio.sessions.bag_file import BagFile
from graphvio.sessions.mcap_file import McapFile


def is_store(path: Path) -> bool:
    """Whether a path is a session or a bag."""
    return path.suffix in (".mcap", ".bag") if path.is_file() else (path / "metadata.yaml").is_file()


def open_store(path: Path, is_wanted: Callable[[str], bool] = lambda topic: True) -> McapFile | BagFile:
    """The messages in a session or bag.

    Args:
        path: of it.
        is_wanted: which topics of a bag are looked at, to save time.

    Raises:
        SessionError: if it cannot be read.
        MissingExtraError: if the extra ``sessions`` is not installed.
    """
    return McapFile(path) if path.is_file() and path.suffix == ".mcap" else BagFile(path, is_wanted)
