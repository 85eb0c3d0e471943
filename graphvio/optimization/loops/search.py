"""Loop closures among the places of one or several sessions: retrieved, matched, verified, resected."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphvio.arrays import AnyArray, Float, Int
from graphvio.config import Config
from graphvio.frontend.stereo import triangulate
from graphvio.frontend.tracks import PairFrame
from graphvio.geometry import se3_inverse
from graphvio.optimization.loops.database import FeatureDatabase, image_name
from graphvio.optimization.loops.matching import alike, estimated_geometry
from graphvio.optimization.loops.places import PairObserver
from graphvio.optimization.loops.resection import Resection, register_again, resect_features
from graphvio.optimization.loops.retrieval import candidates, describe, vocabulary
from graphvio.rig import Camera, Rig, StereoPair
from graphvio.sources import Source

_LEAST_MATCHES = 20
_MOST_CROSSINGS = 2  # pairs of images of a candidate that are matched
_INDEPENDENT_POINTS = 10  # errors of lenses' calibrations are alike across much of an image: more points help no more


@dataclass(frozen=True, eq=False)
class Place:
    """Where a session looked around.

    Attributes:
        session: its number.
        row: of the session's record.
        stamp_ns: of the frameset.
    """

    session: int
    row: int
    stamp_ns: int


@dataclass(frozen=True, eq=False)
class SessionInput:
    """What the search takes of a session.

    Attributes:
        name: of it, unique.
        source: of its images.
        rig: their cameras.
        places: in the order of time.
    """

    name: str
    source: Source
    rig: Rig
    places: Sequence[Place]


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """One place seen from another.

    Attributes:
        reference: the earlier place.
        current: the later one.
        reference_T_current: (4, 4) of body.
        covariance: (6, 6), tangent ``[rotation, translation]`` in body at the current place.
        inliers: points that it rests on.
        pairs: which pair's points which pair saw.
        is_registered: whether it rests on patches, not on features alone.
    """

    reference: Place
    current: Place
    reference_T_current: Float
    covariance: Float
    inliers: int
    pairs: tuple[tuple[int, int], ...]
    is_registered: bool


def find_loops(
    sessions: Sequence[SessionInput],
    database: FeatureDatabase,
    config: Config,
    on_progress: Callable[[int, int], None] | None = None,
) -> list[LoopClosure]:
    """Loop closures between places that are far apart in time, or of different sessions.

    Args:
        sessions: whose places are in the database.
        database: of features; verified matches are added to it.
        config: of the search and the motion.
        on_progress: called with the candidates that were tried, and how many there are.
    """
    places = [place for session in sessions for place in session.places]
    images = _described(sessions, places, database, config.motion.seed)
    if not images:
        return []
    apart_ns = round(config.optimization.loop_interval_s * 1e9)

    def may(earlier: int, later: int) -> bool:
        one, other = places[earlier], places[later]
        return one.session != other.session or abs(other.stamp_ns - one.stamp_ns) > apart_ns

    offered = candidates(images.vectors, images.place, may, config.optimization.loop_candidates)
    verifier = _Verifier(sessions, places, images, database, config)
    found: list[LoopClosure] = []
    with ThreadPoolExecutor(2, thread_name_prefix="graphvio-loops") as pool:
        for done, closure in enumerate(pool.map(verifier.verify, offered), start=1):
            if closure is not None:
                found.append(closure)
            if on_progress is not None:
                on_progress(done, len(offered))
    verifier.store()
    return found


@dataclass(frozen=True, eq=False)
class _Images:
    """N left images of the places: number of the place (N,), pair (N,), name, and what they look like (N, D)."""

    place: Int
    pair: Int
    names: Sequence[str]
    vectors: AnyArray

    def __len__(self) -> int:
        return len(self.names)


class _Descriptors(Sequence[AnyArray]):
    """Those of some images, read when they are asked for: all of an hour would not fit."""

    def __init__(self, database: FeatureDatabase, names: Sequence[str]) -> None:
        self._database = database
        self._names = names

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, k: Any) -> Any:
        return self._database.descriptors(self._names[k])


def _described(
    sessions: Sequence[SessionInput], places: Sequence[Place], database: FeatureDatabase, seed: int
) -> _Images:
    listed = [
        (number, j, image_name(sessions[place.session].name, pair.left.name, place.stamp_ns))
        for number, place in enumerate(places)
        for j, pair in enumerate(sessions[place.session].rig.pairs)
    ]
    listed = [each for each in listed if each[2] in database.names]
    names = [each[2] for each in listed]
    descriptors = _Descriptors(database, names)
    words = vocabulary(descriptors, seed)
    vectors = np.zeros((len(names), words.size), dtype=np.float32)
    for k, rows in enumerate(descriptors):
        vectors[k] = describe(rows, words)
    return _Images(
        np.array([each[0] for each in listed], dtype=np.int64),
        np.array([each[1] for each in listed], dtype=np.int64),
        names,
        vectors,
    )


class _Verifier:
    """Tries candidates, from any thread."""

    def __init__(
        self,
        sessions: Sequence[SessionInput],
        places: Sequence[Place],
        images: _Images,
        database: FeatureDatabase,
        config: Config,
    ) -> None:
        self._sessions = sessions
        self._places = places
        self._images = images
        self._database = database
        self._config = config
        self._lock = threading.Lock()
        self._of_thread = threading.local()
        self._verified: list[tuple[str, str, Int, Any]] = []

    def verify(self, candidate: tuple[int, int]) -> LoopClosure | None:
        """The loop closure of an earlier and a later place, or None."""
        earlier, later = (self._places[number] for number in candidate)
        crossings = self._crossings(*candidate)
        matches = {}
        for (a, b), names in crossings.items():
            rows = self._matched(earlier, later, a, b, names)
            if len(rows) < _LEAST_MATCHES:
                break  # the others are less alike
            matches[a, b] = rows
        if not matches:
            return None
        reference = {a: self._frame(earlier, a) for a, _ in matches}
        current = {b: self._frame(later, b) for _, b in matches}
        seed = [self._config.motion.seed, *candidate]
        rig = self._sessions[later.session].rig
        found = resect_features(rig, reference, current, matches, self._config, seed)
        if found is None or found.inliers < self._config.optimization.loop_min_inliers:
            return None
        if self._sessions[earlier.session].rig is rig:
            images = (self._frameset(earlier), self._frameset(later))
            found = register_again(self._observers(later.session), found, reference, images, self._config, seed)
        return _closure(earlier, later, found)

    def store(self) -> None:
        """Put the verified matches into the database, in an order that does not depend on threads."""
        for first, second, rows, geometry in sorted(self._verified, key=lambda each: each[:2]):
            if not self._database.has_matches(first, second):
                self._database.add_matches(first, second, rows, geometry)

    def _crossings(self, earlier: int, later: int) -> dict[tuple[int, int], tuple[str, str]]:
        """The images of two places that are most alike: (a, b) -> their names."""
        images = self._images
        ones, others = np.flatnonzero(images.place == earlier), np.flatnonzero(images.place == later)
        alike = images.vectors[ones] @ images.vectors[others].T
        ranked = sorted(
            (-float(alike[row, column]), i, k)
            for row, i in enumerate(ones.tolist())
            for column, k in enumerate(others.tolist())
        )[:_MOST_CROSSINGS]
        return {(int(images.pair[i]), int(images.pair[k])): (images.names[i], images.names[k]) for _, i, k in ranked}

    def _matched(self, earlier: Place, later: Place, a: int, b: int, names: tuple[str, str]) -> Int:
        """Rows (M, 2) of features that are one by their descriptors and COLMAP's two-view geometry."""
        with self._lock:
            pixels = (self._database.pixels(names[0]), self._database.pixels(names[1]))
            descriptors = [self._database.descriptors(name) for name in names]
        rows = alike(*descriptors)
        if len(rows) < _LEAST_MATCHES:
            return np.zeros((0, 2), dtype=np.int64)
        cameras = (self._left(earlier, a), self._left(later, b))
        geometry = estimated_geometry(cameras, pixels, rows)
        verified = np.asarray(geometry.inlier_matches, dtype=np.int64).reshape(-1, 2)
        if len(verified) >= _LEAST_MATCHES:
            with self._lock:
                self._verified.append((*names, rows, geometry))
        return verified

    def _frame(self, place: Place, j: int) -> PairFrame:
        """A pair's features at a place, triangulated."""
        session = self._sessions[place.session]
        pair = session.rig.pairs[j]
        left, right = (image_name(session.name, camera.name, place.stamp_ns) for camera in (pair.left, pair.right))
        with self._lock:
            pixels, in_right = self._database.pixels(left), self._database.pixels(right)
            rows = self._database.matches(left, right)
        return frame_of(pair, place.stamp_ns, pixels, in_right, rows)

    def _left(self, place: Place, j: int) -> Camera:
        return self._sessions[place.session].rig.pairs[j].left

    def _frameset(self, place: Place) -> Any:
        return self._sessions[place.session].source.frameset_at(place.stamp_ns)

    def _observers(self, session: int) -> list[PairObserver]:
        known: dict[int, list[PairObserver]] = self._of_thread.__dict__.setdefault("observers", {})
        if session not in known:
            known[session] = [PairObserver(pair, self._config) for pair in self._sessions[session].rig.pairs]
        return known[session]


def frame_of(pair: StereoPair, stamp_ns: int, pixels: Float, in_right: Float, rows: Int) -> PairFrame:
    """Features (K, 2) of a left image, of which those that rows (M, 2) match to the right one's have a depth."""
    n = len(pixels)
    left, has_ray = pair.left.unproject(pixels)
    right = np.zeros((n, 2))
    right[rows[:, 0]], seen = pair.right.unproject(in_right[rows[:, 1]])
    has_depth = np.zeros(n, dtype=bool)
    has_depth[rows[:, 0]] = seen
    points, covariances, _ = triangulate(left, right, pair.right_T_left, pair.left.focal_px, pair.right.focal_px)
    none = np.zeros(n, dtype=np.int64)
    return PairFrame(
        stamp_ns, np.arange(n), none, pixels, left, right, points, covariances, np.zeros((n, 2)), has_depth & has_ray,
        none,
    )  # fmt: skip


def _closure(earlier: Place, later: Place, found: Resection) -> LoopClosure:
    return LoopClosure(
        earlier,
        later,
        se3_inverse(found.cur_T_ref),
        found.covariance * max(1.0, found.inliers / _INDEPENDENT_POINTS),
        found.inliers,
        found.pairs,
        found.is_registered,
    )
