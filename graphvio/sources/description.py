"""Description of a session or bag: its topics, the regularity of their messages, and a comparison of clocks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphvio.arrays import Int
from graphvio.errors import RigError, SessionError
from graphvio.rig import Rig
from graphvio.sessions.messages import COMPRESSED, IMAGE, STAMPED
from graphvio.sessions.rig_of_topics import stereo_topics
from graphvio.sessions.stamps import Clock, Offset, all_header_stamps, compare_clocks, compare_topics
from graphvio.sessions.store import is_store, open_store
from graphvio.sessions.topics import Store, Topic
from graphvio.sources.session import rig_in

_GAP_PERIODS = 1.5
_MIN_STAMPS = 3
_NS_PER_MS, _NS_PER_S = 1e6, 1e9


@dataclass(frozen=True)
class Regularity:
    """Statistics of the intervals between stamps."""

    rate_hz: float | None  # rate from the median interval; None if that is zero
    jitter_ms: float  # standard deviation of the intervals without gaps
    gaps: int  # number of intervals longer than one and a half median intervals
    longest_ms: float  # longest interval


@dataclass(frozen=True)
class TopicDescription:
    """Description of one topic's messages; values are None if there are too few messages."""

    name: str  # name of the topic
    type_name: str  # type of its messages
    messages: int  # number of messages
    regularity: Regularity | None = None  # regularity of the times of recording
    # comparison of the headers' stamps with the times of recording; None also for messages without header
    clock: Clock | None = None

    @property
    def latency_ms(self) -> float | None:
        """Median time from the headers' stamps to recording."""
        return None if self.clock is None else self.clock.latency_ms


@dataclass(frozen=True)
class Synchronisation:
    """Comparison of the stamps of two cameras' images."""

    first: str  # first camera, such as ``pair0 left``
    second: str  # second camera
    offset: Offset | None  # offset of the second's stamps to the first's, or None if none belong together
    images: int  # number of the first camera's images


@dataclass(frozen=True)
class Description:
    """Description of a session or bag."""

    path: Path  # path of the file or folder
    size_bytes: int  # size of the file or folder
    duration_s: float  # time from the first to the last message
    library: str  # library that wrote it, or empty
    is_whole: bool  # whether its writing was finished
    # number of damaged chunks and other records among those that were read; of graphvio's own sessions, only the first
    # chunk is read
    damaged: int
    rig: str  # one line about the rig in it, or why that is not usable; empty if there is none
    topics: tuple[TopicDescription, ...]  # all topics, by name
    # left and right of each pair, then the first pair and each other one, of the pairs that topics' names show
    synchronisation: tuple[Synchronisation, ...]


def describe(path: Path) -> Description:
    """Describe a session or bag.

    Raises:
        SessionError: if the path is no session or bag, or cannot be read.
        MissingExtraError: if the extra ``sessions`` is not installed.
    """
    if not path.exists():
        raise SessionError(f"{path}: does not exist; give a session or bag")
    if not is_store(path):
        raise SessionError(
            f"{path}: is no session or bag; give NAME.mcap, NAME.bag, NAME.db3 or the folder of a ROS 2 bag, or "
            "convert a recording of another layout by graphvio convert"
        )
    store = open_store(path)
    logged = [topic.logged_stamps_ns for topic in store.topics.values() if topic.places]
    begin, end = (min(each.min() for each in logged), max(each.max() for each in logged)) if logged else (0, 0)
    stamped = [topic for topic in store.topics.values() if topic.type_name in STAMPED and topic.places]
    stamps = all_header_stamps(store, stamped)
    images = {name for name in stamps if store.topics[name].type_name in (IMAGE, COMPRESSED)}
    rig = _rig(store)
    return Description(
        path=path,
        size_bytes=path.stat().st_size if path.is_file() else sum(file.stat().st_size for file in path.iterdir()),
        duration_s=float(end - begin) / _NS_PER_S,
        library=store.library,
        is_whole=store.is_whole,
        damaged=store.damaged_chunks + len(store.damages),
        rig=rig,
        topics=tuple(_topic(topic, stamps.get(name)) for name, topic in sorted(store.topics.items())),
        synchronisation=_synchronisation({name: stamps[name] for name in images}),
    )


def regularity(stamps_ns: Int) -> Regularity | None:
    """Measure the intervals between stamps.

    Args:
        stamps_ns: stamps (N,) in nanoseconds, in any order.

    Returns:
        The figures, or None if there are too few stamps, or all are equal.
    """
    stamps = np.sort(stamps_ns)
    if len(stamps) < _MIN_STAMPS or stamps[0] == stamps[-1]:
        return None
    steps = np.diff(stamps).astype(np.float64)
    median = float(np.median(steps))
    within = steps[steps <= _GAP_PERIODS * median]
    return Regularity(
        rate_hz=_NS_PER_S / median if median else None,
        jitter_ms=float(np.std(within)) / _NS_PER_MS,
        gaps=int(np.sum(steps > _GAP_PERIODS * median)),
        longest_ms=float(steps.max()) / _NS_PER_MS,
    )


def rig_line(rig: Rig) -> str:
    """Describe a rig in one line: its name, its pairs and single cameras, and whether it has an IMU."""
    parts = [f"pairs {', '.join(pair.name for pair in rig.pairs)}"] if rig.pairs else []
    parts += [f"single camera {single.name}" for single in rig.singles]
    return ", ".join([rig.name, *parts, "with IMU" if rig.imu else "without IMU"])


def _rig(store: Store) -> str:
    try:
        rig = rig_in(store)
    except (RigError, SessionError) as error:
        return f"not usable: {error}"
    return "" if rig is None else rig_line(rig)


def _topic(topic: Topic, header_ns: Int | None) -> TopicDescription:
    logged_ns = topic.logged_stamps_ns
    found = regularity(logged_ns)
    if found is None:
        return TopicDescription(topic.name, topic.type_name, len(logged_ns))
    clock = None if header_ns is None else compare_clocks(header_ns, logged_ns)
    return TopicDescription(topic.name, topic.type_name, len(logged_ns), found, clock)


def _synchronisation(stamps: dict[str, Int]) -> tuple[Synchronisation, ...]:
    pairs = stereo_topics(stamps)
    wanted = [(f"{name} left", f"{name} right", left, right) for name, (left, right) in pairs.items()]
    first, *others = pairs or [""]
    wanted += [(f"{first} left", f"{name} left", pairs[first][0], pairs[name][0]) for name in others]
    return tuple(
        Synchronisation(one, other, compare_topics(stamps[a], stamps[b]), len(stamps[a])) for one, other, a, b in wanted
    )
