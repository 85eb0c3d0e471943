"""SIFT features of places, by COLMAP on the CPU, and their depth by the odometry's stereo matching.

Features of single cameras get no depth here: see `graphvio.optimization.loops.motion_depth`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from graphvio.arrays import AnyArray, Float, Image, Int
from graphvio.config import Config
from graphvio.measurements.sensors import FrameSet
from graphvio.optimization.loops.database import FeatureDatabase, image_name
from graphvio.optimization.loops.places import ImageObserver, PairObserver
from graphvio.optimization.loops.sift import SiftExtractor, SiftProcess
from graphvio.rig import Rig, StereoPair
from graphvio.sources import Source
from graphvio.sources.read_ahead import read_ahead


@dataclass(frozen=True, eq=False)
class PairFeatures:
    """The features of one pair's images, or of one single camera's image, at a place."""

    left: Float  # (K, 2) pixels in the left image, or the only one
    descriptors: AnyArray  # (K, 128) uint8, of the features in the left image
    right: Float  # (M, 2) pixels in the right image of the features with a stereo match; empty for a single camera
    in_right: Int  # (M,) indices of these features among the K

    @property
    def rows(self) -> Int:
        """Stereo matches (M, 2): features of the left and of the right image."""
        return np.column_stack([self.in_right, np.arange(len(self.in_right))])


class PlaceObserver:
    """Extracts the features of a place's images and matches them in stereo, in any thread; a context manager.

    With ``in_processes``, each calling thread has a process that extracts features for it: see `SiftProcess`.
    """

    def __init__(self, rig: Rig, config: Config, *, in_processes: bool = False) -> None:
        self._rig = rig
        self._config = config
        self._of_thread = threading.local()
        self._make = SiftProcess if in_processes else SiftExtractor
        self._made: list[SiftExtractor | SiftProcess] = []  # appending is atomic

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for extractor in self._made:
            extractor.close()

    @property
    def pairs(self) -> Sequence[PairObserver]:
        """Observers of the rig's pairs, for the calling thread."""
        return [observer for observer in self.groups if isinstance(observer, PairObserver)]

    @property
    def groups(self) -> Sequence[ImageObserver]:
        """Observers of the rig's pairs and single cameras, for the calling thread."""
        if not hasattr(self._of_thread, "groups"):
            self._of_thread.groups = [
                PairObserver(group, self._config)
                if isinstance(group, StereoPair)
                else ImageObserver(group.left, self._config)
                for group in self._rig.groups
            ]
        made: Sequence[ImageObserver] = self._of_thread.groups
        return made

    def look(self, frameset: FrameSet) -> dict[int, PairFeatures]:
        """Return the features of a frameset: index in the rig's groups -> features."""
        seen = {}
        for j, images in frameset.images.items():
            observer = self.groups[j]
            pixels, descriptors = self._extract(images[0])
            usable = observer.usable(pixels)
            pixels, descriptors = pixels[usable], descriptors[usable]
            if len(images) == 1 or not isinstance(observer, PairObserver):
                none = np.zeros(0, dtype=np.int64)
                seen[j] = PairFeatures(pixels, descriptors, np.zeros((0, 2)), none)
                continue
            frame = observer.observe(frameset.stamp_ns, (images[0], images[1]), pixels)
            right, _ = observer.pair.right.project(np.column_stack([frame.right_rays, np.ones(len(pixels))]))
            seen[j] = PairFeatures(pixels, descriptors, right[frame.has_depth], np.flatnonzero(frame.has_depth))
        return seen

    def _extract(self, image: Image) -> tuple[Float, AnyArray]:
        """Return pixels (K, 2) and descriptors (K, 128), uint8, of an image's features."""
        if not hasattr(self._of_thread, "extractor"):
            self._of_thread.extractor = self._make(self._config.optimization.features)
            self._made.append(self._of_thread.extractor)
        found: tuple[Float, AnyArray] = self._of_thread.extractor.extract(image)
        return found


def extract_places(
    source: Source,
    rig: Rig,
    session: str,
    stamps_ns: Sequence[int],
    database: FeatureDatabase,
    config: Config,
    on_progress: Callable[[int], None] = lambda _: None,
) -> None:
    """Extract the features of a session's places into the database.

    Places that are in the database already are skipped, so that an interrupted run can be continued.

    Raises:
        OptimizationError: if a process that extracts features ends.
    """
    missing = [ns for ns in stamps_ns if not is_stored(database, rig, session, ns)]
    done = len(stamps_ns) - len(missing)
    with PlaceObserver(rig, config, in_processes=True) as observer:

        def look(stamp_ns: int) -> dict[int, PairFeatures]:
            return observer.look(source.frameset_at(stamp_ns))

        for stamp_ns, seen in zip(missing, read_ahead(look, missing, depth=4), strict=True):
            store_place(database, rig, session, stamp_ns, seen)
            done += 1
            on_progress(done)


def is_stored(database: FeatureDatabase, rig: Rig, session: str, stamp_ns: int) -> bool:
    """Return whether the features of a place are in the database."""
    return any(image_name(session, group.left.name, stamp_ns) in database.names for group in rig.groups)


def store_place(
    database: FeatureDatabase, rig: Rig, session: str, stamp_ns: int, seen: Mapping[int, PairFeatures]
) -> None:
    """Write the features of a place to the database, in one transaction."""
    names = {camera.name: image_name(session, camera.name, stamp_ns) for j in seen for camera in rig.groups[j].cameras}
    with database.transaction():
        rig_id, cameras = database.rig_of(session, rig) or database.add_rig(rig)
        database.add_place(rig_id, {cameras[camera]: name for camera, name in names.items()})
        for j, found in seen.items():
            left, *rights = (names[camera.name] for camera in rig.groups[j].cameras)
            database.add_features(left, found.left, found.descriptors)
            for right in rights:
                database.add_features(right, found.right)
                database.add_matches(left, right, found.rows)


def merge_places(
    part: FeatureDatabase, whole: FeatureDatabase, session: str, rig: Rig, stamps_ns: Sequence[int]
) -> None:
    """Copy places from one database to another.

    If parts are copied in the order of time, the rows are the same as those of `extract_places` for all places at once.
    """
    for stamp_ns in stamps_ns:
        seen = {}
        for j, group in enumerate(rig.groups):
            left, *rights = (image_name(session, camera.name, stamp_ns) for camera in group.cameras)
            if left in part.names and left not in whole.names:
                pixels, in_right = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
                for right in rights:
                    pixels, in_right = part.pixels(right), part.matches(left, right)[:, 0]
                seen[j] = PairFeatures(part.pixels(left), part.descriptors(left), pixels, in_right)
        if seen:
            store_place(whole, rig, session, stamp_ns, seen)
