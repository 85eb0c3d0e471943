"""Where features and images of the places are kept: a folder on disk, so that hours of them fit."""

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
_ROOM_BYTES = 20_000_000  # must be free for a place: COLMAP aborts the process when its database finds no room


class PlaceStore:
    """COLMAP's database of the places' features, and the images of those that were added here beside it.

    Args:
        folder: that holds them; what is missing is made.
        rig: of all places.

    Raises:
        OptimizationError: if the database cannot be opened.
        MissingExtraError: if the extra ``maps`` is not installed.
    """

    def __init__(self, folder: Path, rig: Rig) -> None:
        self._folder = folder
        self._rig = rig
        self._database = FeatureDatabase(folder / DATABASE)
        self._lock = threading.Lock()

    def add(self, session: str, frameset: FrameSet, seen: Mapping[int, PairFeatures]) -> None:
        """Keep a place.

        Raises:
            MapError: if it cannot be written; images that were kept are gone then.
        """
        try:
            if shutil.disk_usage(self._folder).free < _ROOM_BYTES:
                raise OSError(ENOSPC, os.strerror(ENOSPC))
            # The database comes last: unlike images, all that is in it is saved.
            write_place(self._folder / _IMAGES, self._rig, session, frameset)
            with self._lock:
                store_place(self._database, self._rig, session, frameset.stamp_ns, seen)
        except (OSError, RuntimeError) as error:
            # Nothing more can be kept; without the images, a map on the same disk may have room.
            shutil.rmtree(self._folder / _IMAGES, ignore_errors=True)
            raise MapError(f"{self._folder}: a place cannot be kept ({error}); is the disk full?") from None

    def view(self, session: str, stamp_ns: int) -> StoredView:
        """A place that was kept, for verification."""
        frameset_at = partial(read_place, self._folder / _IMAGES, self._rig, session)
        return StoredView(self._rig, session, stamp_ns, self._database, self._lock, frameset_at)

    def descriptors(self, session: str, stamp_ns: int, j: int) -> AnyArray:
        """Descriptors (K, 128), uint8, of pair j's left image at a place."""
        with self._lock:
            return self._database.descriptors(self.name(session, stamp_ns, j))

    def name(self, session: str, stamp_ns: int, j: int) -> str:
        """Of pair j's left image at a place."""
        return image_name(session, self._rig.pairs[j].left.name, stamp_ns)

    def copy_to(self, folder: Path) -> None:
        """Write the database as it is now, whole, into another folder.

        Raises:
            MapError: if it cannot be written.
        """
        with self._lock:
            copy_database(self._folder / DATABASE, folder / DATABASE)

    def close(self) -> None:
        """Nothing more is kept or read."""
        with self._lock:
            self._database.__exit__(None, None, None)


def copy_database(source: Path, target: Path) -> None:
    """Copy a database that may be open: its file alone may lack what was written last.

    Raises:
        MapError: if it cannot be copied.
    """
    try:
        with closing(sqlite3.connect(source)) as one, closing(sqlite3.connect(target)) as other:
            one.backup(other)
    except sqlite3.Error as error:
        raise MapError(f"{source}: cannot be copied to {target} ({error}); is it damaged, or the disk full?") from None
