"""Search for loop closures among the places of sessions: retrieval, matching, verification, resection."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from graphvio.arrays import AnyArray, Int
from graphvio.config import Config
from graphvio.optimization.loops.closures import LoopClosure, Place, closure_of
from graphvio.optimization.loops.database import FeatureDatabase, image_name
from graphvio.optimization.loops.motion_depth import NEIGHBOURS, PlaceMotion, place_motion
from graphvio.optimization.loops.places import PairObserver
from graphvio.optimization.loops.retrieval import candidates, describe, vocabulary
from graphvio.optimization.loops.verification import PlaceView, StoredView, crossings, verified
from graphvio.optimization.record import SessionRecord
from graphvio.rig import Rig
from graphvio.sources import Source


@dataclass(frozen=True, eq=False)
class SessionInput:
    """A session to search."""

    name: str  # unique name of the session
    source: Source  # recording with its images
    rig: Rig  # rig of its cameras
    places: Sequence[Place]  # places to search, in the order of time
    record: SessionRecord  # record of its motions, with which single cameras' features are triangulated


def find_loops(
    sessions: Sequence[SessionInput],
    database: FeatureDatabase,
    config: Config,
    on_progress: Callable[[int, int], None] = lambda *_: None,
) -> list[LoopClosure]:
    """Find loop closures between places that are far apart in time or of different sessions.

    The places are in the database already; verified matches are added to it. ``on_progress`` is called with the number
    of finished candidates and of all candidates.
    """
    places = [place for session in sessions for place in session.places]
    images = _described(sessions, places, database, config.motion.seed)
    if not images:
        return []
    apart_ns = round(config.optimization.loop_interval_s * 1e9)

    def may(earlier: int, later: int) -> bool:
        one, other = places[earlier], places[later]
        return one.session != other.session or abs(other.stamp_ns - one.stamp_ns) > apart_ns

    tried = candidates(images.vectors, images.place, may, config.optimization.loop_candidates)
    verifier = _Verifier(sessions, places, images, database, config)
    found: list[LoopClosure] = []
    with ThreadPoolExecutor(2, thread_name_prefix="graphvio-loops") as pool:
        for done, closure in enumerate(pool.map(verifier.verify, tried), start=1):
            if closure is not None:
                found.append(closure)
            on_progress(done, len(tried))
    verifier.store()
    return found


@dataclass(frozen=True, eq=False)
class _Images:
    """N left or single images: number of the place (N,), index in the rig's groups (N,), names, VLAD vectors (N, D)."""

    place: Int
    pair: Int
    names: Sequence[str]
    vectors: AnyArray

    def __len__(self) -> int:
        return len(self.names)


def _described(
    sessions: Sequence[SessionInput], places: Sequence[Place], database: FeatureDatabase, seed: int
) -> _Images:
    listed = [
        (number, j, image_name(sessions[place.session].name, group.left.name, place.stamp_ns))
        for number, place in enumerate(places)
        for j, group in enumerate(sessions[place.session].rig.groups)
    ]
    listed = [each for each in listed if each[2] in database.names]
    names = [each[2] for each in listed]
    words = vocabulary(map(database.descriptors, names), len(names), seed)
    vectors = np.zeros((len(names), words.size), dtype=np.float32)
    for k, name in enumerate(names):
        vectors[k] = describe(database.descriptors(name), words)
    return _Images(
        np.array([each[0] for each in listed], dtype=np.int64),
        np.array([each[1] for each in listed], dtype=np.int64),
        names,
        vectors,
    )


class _Verifier:
    """Verifies candidate pairs of places; may be called from any thread."""

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
        """Return the loop closure of an earlier and a later place, or None."""
        earlier, later = (self._places[number] for number in candidate)
        then, now = self._view(earlier), self._view(later)
        seed = [self._config.motion.seed, *candidate]
        observers = self._observers(later.session) if then.rig is now.rig else None

        def keep(a: int, b: int, rows: Int, geometry: Any) -> None:
            with self._lock:
                self._verified.append((then.name(a), now.name(b), rows, geometry))

        neighbours = partial(self._neighbours, candidate[0])
        found = verified(then, now, self._crossings(*candidate), observers, self._config, seed, neighbours, keep)
        return None if found is None else closure_of(earlier, later, found)

    def store(self) -> None:
        """Write the verified matches to the database, in an order that does not depend on threads."""
        for first, second, rows, geometry in sorted(self._verified, key=lambda each: each[:2]):
            if not self._database.has_matches(first, second):
                self._database.add_matches(first, second, rows, geometry)

    def _neighbours(self, number: int) -> list[tuple[PlaceView, PlaceMotion]]:
        """Return the places next to a place in its session to which the motion is known, and these motions."""
        place = self._places[number]
        found: list[tuple[PlaceView, PlaceMotion]] = []
        for step in NEIGHBOURS:
            if not 0 <= number + step < len(self._places) or self._places[number + step].session != place.session:
                continue
            other = self._places[number + step]
            motion = place_motion(self._sessions[place.session].record, place.row, other.row)
            if motion is not None:
                found.append((self._view(other), motion))
        return found

    def _view(self, place: Place) -> StoredView:
        session = self._sessions[place.session]
        return StoredView(
            session.rig, session.name, place.stamp_ns, self._database, self._lock, session.source.frameset_at
        )

    def _crossings(self, earlier: int, later: int) -> list[tuple[int, int]]:
        images = self._images
        ones, others = np.flatnonzero(images.place == earlier), np.flatnonzero(images.place == later)
        return crossings(images.pair[ones], images.vectors[ones], images.pair[others], images.vectors[others])

    def _observers(self, session: int) -> list[PairObserver]:
        known: dict[int, list[PairObserver]] = self._of_thread.__dict__.setdefault("observers", {})
        if session not in known:
            known[session] = [PairObserver(pair, self._config) for pair in self._sessions[session].rig.pairs]
        return known[session]
