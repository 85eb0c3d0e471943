"""Reads the true trajectory in a session or bag."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.errors import SessionError, TrajectoryError
from graphvio.sessions import cdr
from graphvio.sessions.messages import ODOMETRY, POSE, pose_of, stamp_of
from graphvio.sessions.store import open_store
from graphvio.sessions.topics import TRUTH_TOPIC, Topic

_log = logging.getLogger(__name__)


def truth_topic(topics: Mapping[str, Topic]) -> Topic | None:
    """Return the topic with the true trajectory, or None."""
    topic = topics.get(TRUTH_TOPIC)
    return topic if topic is not None and topic.type_name in (POSE, ODOMETRY) and topic.places else None


def read_truth(path: Path) -> tuple[Int, Float]:
    """Return stamps (N,), increasing, and poses ``world_T_body`` (N, 4, 4) of the true trajectory.

    Raises:
        TrajectoryError: if it holds none.
        SessionError: if it cannot be read.
    """
    store = open_store(path, lambda topic: topic == TRUTH_TOPIC)
    topic = truth_topic(store.topics)
    if topic is None:
        raise TrajectoryError(f"{path}: holds no true trajectory, which would be poses on the topic {TRUTH_TOPIC}")
    poses: dict[int, Float] = {}
    damaged: list[SessionError] = []
    for place in topic.places:
        try:
            message = cdr.decode(store.read(place), topic.type_name, path)
        except SessionError as error:
            damaged.append(error)
        else:
            poses[stamp_of(message.header)] = pose_of(message)
    if damaged:
        _log.warning("%s: %d true poses are left out; the first: %s", path, len(damaged), damaged[0])
    if not poses:
        raise TrajectoryError(f"{path}: not one pose on {TRUTH_TOPIC} can be read; copy the file again")
    stamps = sorted(poses)
    return np.array(stamps, dtype=np.int64), np.array([poses[stamp] for stamp in stamps])
