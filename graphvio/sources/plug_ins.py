"""Layouts of recordings that other packages add with entry points of the group ``graphvio.sources``."""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import NamedTuple, Protocol

from graphvio.rig import Rig
from graphvio.sources.faults import FaultLog
from graphvio.sources.index import Index

GROUP = "graphvio.sources"


class Layout(Protocol):
    """Reader of recordings of one layout: a module, or any object, with these members.

    Attributes:
        LAYOUT: Description of the layout for messages, such as ``KITTI odometry: image_0/*.png, times.txt``.
    """

    LAYOUT: str

    def matches(self, path: Path) -> bool:
        """Return whether a folder has this layout, judging by the names of files in it."""

    def read_index(self, path: Path, rig: Rig, faults: FaultLog) -> Index:
        """Index the images of a rig's cameras, and the IMU if it has one.

        Args:
            path: Folder of the recording.
            rig: Rig with the cameras to read.
            faults: Collects faults of single files or lines.

        Raises:
            SourceError: If the folder cannot be read.
        """


class PlugIns(NamedTuple):
    """The layouts of installed packages.

    Attributes:
        layouts: The layouts that could be loaded, sorted by name.
        failures: For each of the others, why it could not be loaded.
    """

    layouts: tuple[Layout, ...]
    failures: tuple[str, ...]


@cache
def plug_ins() -> PlugIns:
    """Load the layouts of installed packages, once per process."""
    layouts: list[Layout] = []
    failures: list[str] = []
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name):
        try:
            layout = entry.load()
        except Exception as error:  # the module of another package may raise anything
            failures.append(f"the plug-in {entry.name} ({entry.value}) cannot be loaded: {error}")
            continue
        missing = [name for name in ("LAYOUT", "matches", "read_index") if not hasattr(layout, name)]
        if missing:
            failures.append(f"the plug-in {entry.name} ({entry.value}) has no {', '.join(missing)}")
        else:
            layouts.append(layout)
    return PlugIns(tuple(layouts), tuple(failures))
