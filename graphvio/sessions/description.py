"""What a session holds, and how regular it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphvio.rig_files.native import parse
from graphvio.sessions import cdr
from graphvio.sessions.mcap_file import McapFile, Topic, stamps_of
from graphvio.sessions.messages import COMPRESSED, IMAGE, IMU, ODOMETRY
from graphvio.sessions.topics import RIG_ATTACHMENT

_WITH_HEADER = (IMAGE, COMPRESSED, IMU, ODOMETRY)
_GAP_PERIODS = 1.5
_FEWEST = 3
_COMPARED = 50  # messages of a topic whose headers are held against the log's times
_NS_PER_MS, _NS_PER_S = 1e6, 1e9


@dataclass(frozen=True)
class TopicDescription:
    """Messages of one topic; None where there are too few to tell.

    Attributes:
        name: of the topic.
        type_name: of its messages.
        messages: how many.
        rate_hz: by the median interval.
        jitter_ms: standard deviation of the intervals, but for gaps.
        gaps: intervals longer than one and a half median ones.
        longest_ms: interval.
        latency_ms: median of when messages were recorded after their headers' stamps.
    """

    name: str
    type_name: str
    messages: int
    rate_hz: float | None
    jitter_ms: float | None
    gaps: int | None
    longest_ms: float | None
    latency_ms: float | None


@dataclass(frozen=True)
class Description:
    """A session.

    Attributes:
        path: of the file.
        size_bytes: of it.
        duration_s: from the first to the last message.
        library: that wrote it.
        is_whole: whether its writing was finished.
        rig: one line on the rig in it, or empty.
        topics: by name.
    """

    path: Path
    size_bytes: int
    duration_s: float
    library: str
    is_whole: bool
    rig: str
    topics: tuple[TopicDescription, ...]


def describe(path: Path) -> Description:
    """Describe a session.

    Raises:
        SessionError: if it cannot be read.
        RigError: if the rig in it is not usable.
    """
    file = McapFile(path)
    stamps = [stamps_of(topic) for topic in file.topics.values() if topic.places]
    begin, end = (min(each.min() for each in stamps), max(each.max() for each in stamps)) if stamps else (0, 0)
    text, rig = file.attachments.get(RIG_ATTACHMENT), ""
    if text is not None:
        given = parse(text.decode("utf-8"), path)
        pairs = ", ".join(pair.name for pair in given.pairs)
        rig = f"{given.name}, pairs {pairs}, {'with' if given.imu else 'without'} IMU"
    return Description(
        path=path,
        size_bytes=path.stat().st_size,
        duration_s=float(end - begin) / _NS_PER_S,
        library=file.library,
        is_whole=file.is_whole,
        rig=rig,
        topics=tuple(_topic(file, topic) for _, topic in sorted(file.topics.items())),
    )


def _topic(file: McapFile, topic: Topic) -> TopicDescription:
    stamps = np.sort(stamps_of(topic))
    count = len(stamps)
    if count < _FEWEST or stamps[0] == stamps[-1]:
        return TopicDescription(topic.name, topic.type_name, count, None, None, None, None, None)
    steps = np.diff(stamps).astype(np.float64)
    median = float(np.median(steps))
    within = steps[steps <= _GAP_PERIODS * median]
    latency = None
    if topic.type_name in _WITH_HEADER:
        rows = np.unique(np.linspace(0, count - 1, _COMPARED).astype(int)).tolist()
        late = [topic.logged_ns[k] - cdr.stamp_ns(file.read(topic.places[k])) for k in rows]
        latency = float(np.median(late)) / _NS_PER_MS
    return TopicDescription(
        topic.name,
        topic.type_name,
        count,
        _NS_PER_S / median if median else None,
        float(np.std(within)) / _NS_PER_MS,
        int(np.sum(steps > _GAP_PERIODS * median)),
        float(steps.max()) / _NS_PER_MS,
        latency,
    )
