"""Storage of the places' features and images on disk."""

from __future__ import annotations

import os
import shutil
import sqlite3
import threading
from collections.abc import Mapping
from contextlib import closing
from errno import ENOSPC
from functools import partial
from pathlib import Path

from graphvio.arrays import AnyArray
from graphvio.errors import MapError
from graphvio.measurements.sensors import FrameSet
from graphvio.optimization.loops.database import FeatureDatabase, image_name
from graphvio.optimization.loops.features import PairFeatures, store_place
from graphvio.optimization.loops.place_images import read_place, write_place
from graphvio.optimization.loops.verification import StoredView
from graphvio.rig import Rig

DATABASE = "features.db"
_IMAGES = "images"
_MIN_FREE_BYTES = 20_000_000  # free space required to store a place: COLMAP aborts the process when the disk is full


class PlaceStore:
    """COLMAP's database of the places' features, and the images of the places that were added in this session.

    Args:
        folder: Folder for the database and the images.
        rig: The rig with the cameras of the images.

    Attributes:
        rig: The rig whose calibration is used for stored places; may be replaced by one with the same camera names.

    Raises:
        OptimizationError: If the database cannot be opened.
        MissingExtraError: If the extra ``maps`` is not installed.
    """

    def __init__(self, folder: Path, rig: Rig) -> None:
        self._folder = folder
        self.rig = rig
        self._database = FeatureDatabase(folder / DATABASE)
        self._lock = threading.Lock()

    def add(self, session: str, frameset: FrameSet, seen: Mapping[int, PairFeatures]) -> None:
        """Store a place; if it cannot be written, its session's images are deleted, and a `MapError` is raised."""
        try:
            if shutil.disk_usage(self._folder).free < _MIN_FREE_BYTES:
                raise OSError(ENOSPC, os.strerror(ENOSPC))
            # The database comes last: unlike the images, it becomes a part of saved maps.
            write_place(self._folder / _IMAGES, self.rig, session, frameset)
            with self._lock:
                store_place(self._database, self.rig, session, frameset.stamp_ns, seen)
        except (OSError, RuntimeError) as error:
            # Nothing more can be stored; without the images, a map on the same disk may have room.
            shutil.rmtree(self._folder / _IMAGES, ignore_errors=True)
            raise MapError(f"{self._folder}: a place cannot be stored ({error}); is the disk full?") from None

    def view(self, session: str, stamp_ns: int) -> StoredView:
        """Return a stored place, for verification."""
        frameset_at = partial(read_place, self._folder / _IMAGES, self.rig, session)
        return StoredView(self.rig, session, stamp_ns, self._database, self._lock, frameset_at)

    def descriptors(self, session: str, stamp_ns: int, j: int) -> AnyArray:
        """Return the descriptors (K, 128), uint8, of the left or only image of the rig's group j at a place."""
        with self._lock:
            return self._database.descriptors(self.name(session, stamp_ns, j))

    def name(self, session: str, stamp_ns: int, j: int) -> str:
        """Return the name of the left or only image of the rig's group j at a place."""
        return image_name(session, self.rig.groups[j].left.name, stamp_ns)

    def copy_to(self, folder: Path) -> None:
        """Copy the database, complete as it is now, to another folder."""
        with self._lock:
            copy_database(self._folder / DATABASE, folder / DATABASE)

    def close(self) -> None:
        """Close the database."""
        with self._lock:
            self._database.close()


def copy_database(source: Path, target: Path) -> None:
    """Copy a database that may be open, by SQLite's backup: the file alone may lack the last changes."""
    try:
        with closing(sqlite3.connect(source)) as one, closing(sqlite3.connect(target)) as other:
            one.backup(other)
    except sqlite3.Error as error:
        raise MapError(f"{source}: cannot be copied to {target} ({error}); is it damaged, or the disk full?") from None
