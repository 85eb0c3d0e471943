"""Reading of the stamps in messages' headers, and comparison of their clock with the recorder's."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Int
from graphvio.errors import SessionError
from graphvio.sessions import cdr
from graphvio.sessions.mcap_storage import LIBRARY
from graphvio.sessions.topics import Place, Store, Topic

_BLOCKS = 10
_MIN_MESSAGES = 5 * _BLOCKS
_MIN_DURATION_NS = 10_000_000_000
_JUMP_NS = 1_000_000_000
_NS_PER_MS, _NS_PER_MINUTE = 1e6, 60e9


@dataclass(frozen=True)
class Clock:
    """Comparison of the stamps of one topic's headers with the times of recording."""

    backward: int  # number of messages whose stamp is not after that of the previous message
    jumps: int  # number of messages whose stamp advanced a second or more differently from the recorder's clock
    latency_ms: float  # median time from stamp to recording
    # growth of the latency; None if the recording is too short, or both clocks are the same
    drift_ms_per_minute: float | None
    drift_sigma: float | None  # standard deviation of the drift, or None


@dataclass(frozen=True)
class Offset:
    """Comparison of the stamps of two topics."""

    matched: int  # number of messages of the first that have one of the second within half their median interval
    median_ms: float  # median of the second's stamp minus the first's
    largest_ms: float  # largest absolute difference


def header_stamps(store: Store, topic: Topic) -> Int:
    """Return the stamps (N,) of the headers of a topic's messages, in the order of the file.

    In graphvio's own sessions, the times of recording are these stamps, and bags were read when they were opened; other
    files are read here. A damaged message gets the time of its recording.
    """
    return all_header_stamps(store, [topic])[topic.name]


def all_header_stamps(store: Store, topics: Iterable[Topic]) -> dict[str, Int]:
    """Return topic -> `header_stamps` of several topics; the file is read in order, to unpack each chunk only once."""
    found: dict[str, Int] = {}
    waiting: list[tuple[Place, str, int]] = []
    for topic in topics:
        if store.library.startswith(LIBRARY):
            found[topic.name] = topic.logged_stamps_ns
        elif topic.header_ns:
            found[topic.name] = np.array(topic.header_ns, dtype=np.int64)
        else:
            found[topic.name] = topic.logged_stamps_ns
            waiting += [(place, topic.name, row) for row, place in enumerate(topic.places)]
    for place, name, row in sorted(waiting):
        try:
            found[name][row] = cdr.stamp_ns(store.read(place))
        except SessionError:  # counted where the message itself is read
            continue
    return found


def compare_clocks(header_ns: Int, logged_ns: Int) -> Clock:
    """Compare stamps of headers (N,), N > 0, in the order of recording, with the times of recording (N,)."""
    late_ns = logged_ns - header_ns
    drift, sigma = _drift(header_ns, late_ns)
    return Clock(
        backward=int(np.sum(np.diff(header_ns) <= 0)),
        jumps=int(np.sum(np.abs(np.diff(late_ns)) >= _JUMP_NS)),
        latency_ms=float(np.median(late_ns)) / _NS_PER_MS,
        drift_ms_per_minute=drift,
        drift_sigma=sigma,
    )


def compare_topics(first_ns: Int, second_ns: Int) -> Offset | None:
    """Compare stamps (N,) with the nearest stamps of another topic (M,); None if too few belong together."""
    first, second = np.unique(first_ns), np.unique(second_ns)
    if len(first) < 2 or len(second) < 2:
        return None
    after = np.clip(np.searchsorted(second, first), 1, len(second) - 1)
    before_ns, after_ns = second[after - 1] - first, second[after] - first
    nearest = np.where(np.abs(before_ns) < np.abs(after_ns), before_ns, after_ns)
    matched = nearest[2 * np.abs(nearest) < np.median(np.diff(first))]
    if not len(matched):
        return None
    return Offset(len(matched), float(np.median(matched)) / _NS_PER_MS, float(np.abs(matched).max()) / _NS_PER_MS)


def _drift(header_ns: Int, late_ns: Int) -> tuple[float | None, float | None]:
    """Return the slope of the latency and its standard deviation, ms per minute, of a line through block medians."""
    if len(header_ns) < _MIN_MESSAGES or header_ns.max() - header_ns.min() < _MIN_DURATION_NS or not late_ns.any():
        return None, None
    blocks = np.array_split(np.argsort(header_ns, kind="stable"), _BLOCKS)
    minutes = np.array([np.median(header_ns[block] - header_ns.min()) for block in blocks]) / _NS_PER_MINUTE
    late_ms = np.array([np.median(late_ns[block] - late_ns[0]) for block in blocks]) / _NS_PER_MS
    centred = minutes - minutes.mean()
    spread = float(centred @ centred)
    slope = float(centred @ late_ms) / spread
    residuals = late_ms - late_ms.mean() - slope * centred
    return slope, float(np.sqrt(residuals @ residuals / (_BLOCKS - 2) / spread))
