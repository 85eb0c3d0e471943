"""Stamps of messages: those of their headers, and how the clock that gave them compares with the recorder's."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Int
from graphvio.errors import SessionError
from graphvio.sessions import cdr
from graphvio.sessions.mcap_storage import LIBRARY
from graphvio.sessions.store import Store
from graphvio.sessions.topics import Place, Topic

_BLOCKS = 10
_FEWEST = 5 * _BLOCKS
_SHORTEST_NS = 10_000_000_000
_JUMP_NS = 1_000_000_000
_NS_PER_MS, _NS_PER_MINUTE = 1e6, 60e9


@dataclass(frozen=True)
class Clock:
    """Stamps of one topic's headers against the times at which the messages were recorded.

    Attributes:
        backward: messages whose stamp is not after that of the message before.
        jumps: messages whose stamp is a second or more off what the recorder's clock says since the message before.
        latency_ms: median of when messages were recorded after their stamps.
        drift_ms_per_minute: by how much that grows, or None where the recording is too short to tell, or where both
            are the same.
        drift_sigma: its standard deviation, or None.
    """

    backward: int
    jumps: int
    latency_ms: float
    drift_ms_per_minute: float | None
    drift_sigma: float | None


@dataclass(frozen=True)
class Offset:
    """Stamps of one topic against those of another.

    Attributes:
        matched: messages for which the other has one that is nearer than half the interval of messages.
        median_ms: of how much later the other's are.
        largest_ms: difference, without its sign.
    """

    matched: int
    median_ms: float
    largest_ms: float


def header_stamps(store: Store, topic: Topic) -> Int:
    """Stamps (N,) of the headers of a topic's messages, in the order of the file.

    graphvio's own sessions are logged by them, and bags have been read for them; other files are read here. A message
    that is damaged has the time at which it was recorded.
    """
    return all_header_stamps(store, [topic])[topic.name]


def all_header_stamps(store: Store, topics: Iterable[Topic]) -> dict[str, Int]:
    """Name of a topic -> its `header_stamps`; messages are read in the order of the file, so each chunk but once."""
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
        except SessionError:  # told by who reads it
            continue
    return found


def compare_clocks(header_ns: Int, logged_ns: Int) -> Clock:
    """Compare stamps (N,) with the times (N,) at which they were recorded, both in the order of recording; N > 0."""
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
    """Compare stamps (N,) with the nearest ones (M,) of another topic; None where too few belong together."""
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
    """Slope of the lateness and its standard deviation, milliseconds a minute, by a line through medians of blocks."""
    if len(header_ns) < _FEWEST or header_ns.max() - header_ns.min() < _SHORTEST_NS or not late_ns.any():
        return None, None
    blocks = np.array_split(np.argsort(header_ns, kind="stable"), _BLOCKS)
    minutes = np.array([np.median(header_ns[block] - header_ns.min()) for block in blocks]) / _NS_PER_MINUTE
    late_ms = np.array([np.median(late_ns[block] - late_ns[0]) for block in blocks]) / _NS_PER_MS
    centred = minutes - minutes.mean()
    spread = float(centred @ centred)
    slope = float(centred @ late_ms) / spread
    residuals = late_ms - late_ms.mean() - slope * centred
    return slope, float(np.sqrt(residuals @ residuals / (_BLOCKS - 2) / spread))
