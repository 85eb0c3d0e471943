"""Features of the places, by COLMAP's SIFT on the CPU, and their depth by our own stereo matching."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphvio.arrays import AnyArray, Float, Image, Int
from graphvio.config import Config
from graphvio.measurements.sensors import FrameSet
from graphvio.optimization.loops.database import CENTRE_PX, FeatureDatabase, colmap, image_name
from graphvio.optimization.loops.places import PairObserver
from graphvio.rig import Rig
from graphvio.sources import Source

_FIRST_OCTAVE = 0  # the image itself; twice its size, COLMAP's default, costs three times as much
_AHEAD = 4  # places that are worked on at a time


class Extractor:
    """SIFT features of images, in any thread.

    Args:
        most: features of an image, the largest ones.
    """

    def __init__(self, most: int) -> None:
        library = colmap()
        self._options = library.FeatureExtractionOptions()
        self._options.num_threads = 1
        self._options.sift.max_num_features = most
        self._options.sift.first_octave = _FIRST_OCTAVE
        self._options.sift.max_num_orientations = 1
        self._of_thread = threading.local()

    def extract(self, image: Image) -> tuple[Float, AnyArray]:
        """Pixels (K, 2) and descriptors (K, 128), uint8."""
        library = colmap()
        if not hasattr(self._of_thread, "made"):
            self._of_thread.made = library.FeatureExtractor.create(self._options, library.Device.cpu)
        keypoints, descriptors = self._of_thread.made.extract_from_uint8_array(np.ascontiguousarray(image))
        pixels = np.asarray(library.keypoints_to_matrix(keypoints)[:, :2], dtype=np.float64) - CENTRE_PX
        return pixels.reshape(-1, 2), np.asarray(descriptors.data, dtype=np.uint8).reshape(-1, 128)


@dataclass(frozen=True, eq=False)
class PairFeatures:
    """What one pair shows at a place.

    Attributes:
        left: (K, 2) pixels in its left image.
        descriptors: (K, 128) uint8 of them.
        right: (M, 2) pixels in its right image, of those that are found there.
        in_right: (M,) which of the K they are.
    """

    left: Float
    descriptors: AnyArray
    right: Float
    in_right: Int

    @property
    def rows(self) -> Int:
        """(M, 2) features of the left image and of the right one that are one."""
        return np.column_stack([self.in_right, np.arange(len(self.in_right))])


class PlaceObserver:
    """Finds the features of a place's images, in any thread, and where they are in the right ones.

    Args:
        rig: of the cameras.
        config: of this stage and of the stereo matching.
    """

    def __init__(self, rig: Rig, config: Config) -> None:
        self._rig = rig
        self._config = config
        self._extractor = Extractor(config.optimization.features)
        self._of_thread = threading.local()

    @property
    def pairs(self) -> Sequence[PairObserver]:
        """Of each pair of the rig; those of the calling thread."""
        if not hasattr(self._of_thread, "pairs"):
            self._of_thread.pairs = [PairObserver(pair, self._config) for pair in self._rig.pairs]
        made: Sequence[PairObserver] = self._of_thread.pairs
        return made

    def look(self, frameset: FrameSet) -> dict[int, PairFeatures]:
        """Pair -> what it shows."""
        seen = {}
        for j, images in frameset.images.items():
            observer = self.pairs[j]
            pixels, descriptors = self._extractor.extract(images[0])
            usable = observer.usable(pixels)
            pixels, descriptors = pixels[usable], descriptors[usable]
            frame = observer.observe(frameset.stamp_ns, images, pixels)
            right, _ = observer.pair.right.project(np.column_stack([frame.right, np.ones(len(pixels))]))
            seen[j] = PairFeatures(pixels, descriptors, right[frame.has_depth], np.flatnonzero(frame.has_depth))
        return seen


def extract_places(
    source: Source,
    rig: Rig,
    session: str,
    stamps_ns: Sequence[int],
    database: FeatureDatabase,
    config: Config,
    on_progress: Callable[[int], None] | None = None,
) -> None:
    """Put the places of a session into the database: features of left images, and where they are in the right ones.

    Places that are in the database already are left as they are, so that an interrupted run goes on.

    Args:
        source: of the images.
        rig: their cameras.
        session: its name, unique in the database.
        stamps_ns: of the places.
        database: to write.
        config: of this stage and of the stereo matching.
        on_progress: called with the number of places done.
    """
    observer = PlaceObserver(rig, config)

    def look(stamp_ns: int) -> dict[int, PairFeatures]:
        return observer.look(source.frameset_at(stamp_ns))

    missing = [ns for ns in stamps_ns if not _is_there(database, rig, session, ns)]
    done = len(stamps_ns) - len(missing)
    with ThreadPoolExecutor(2, thread_name_prefix="graphvio-features") as pool:
        pending: list[Any] = []
        for at, stamp_ns in enumerate(missing):
            while len(pending) < _AHEAD and at + len(pending) < len(missing):
                pending.append(pool.submit(look, missing[at + len(pending)]))
            store_place(database, rig, session, stamp_ns, pending.pop(0).result())
            done += 1
            if on_progress is not None:
                on_progress(done)


def _is_there(database: FeatureDatabase, rig: Rig, session: str, stamp_ns: int) -> bool:
    return any(image_name(session, pair.left.name, stamp_ns) in database.names for pair in rig.pairs)


def store_place(
    database: FeatureDatabase, rig: Rig, session: str, stamp_ns: int, seen: Mapping[int, PairFeatures]
) -> None:
    """Put a place into the database, as a whole: what its pairs show.

    Args:
        database: to write.
        rig: that looked around.
        session: its name, unique in the database.
        stamp_ns: of the place.
        seen: by pair.
    """
    names = {
        camera.name: image_name(session, camera.name, stamp_ns)
        for j in seen
        for camera in (rig.pairs[j].left, rig.pairs[j].right)
    }
    with database.transaction():
        rig_id, cameras = database.rig_of(session, rig) or database.add_rig(rig)
        database.add_place(rig_id, {cameras[camera]: name for camera, name in names.items()})
        for j, found in seen.items():
            left, right = names[rig.pairs[j].left.name], names[rig.pairs[j].right.name]
            database.add_features(left, found.left, found.descriptors)
            database.add_features(right, found.right)
            database.add_matches(left, right, found.rows)


def merge_places(
    part: FeatureDatabase, whole: FeatureDatabase, session: str, rig: Rig, stamps_ns: Sequence[int]
) -> None:
    """Copy places from one database into another.

    Parts that are copied in the order of time give the rows that `extract_places` gives for all places at once.

    Args:
        part: holds some of the places.
        whole: to write.
        session: name of the session.
        rig: its cameras.
        stamps_ns: of the places, in the order of time; those that the part does not hold are skipped.
    """
    for stamp_ns in stamps_ns:
        seen = {}
        for j, pair in enumerate(rig.pairs):
            left, right = (image_name(session, camera.name, stamp_ns) for camera in (pair.left, pair.right))
            if left in part.names and left not in whole.names:
                in_right = part.matches(left, right)[:, 0]
                seen[j] = PairFeatures(part.pixels(left), part.descriptors(left), part.pixels(right), in_right)
        if seen:
            store_place(whole, rig, session, stamp_ns, seen)
