"""Reading of trajectories in a session or bag: the true one, or that of any topic with poses."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.errors import SessionError, TrajectoryError
from graphvio.sessions import cdr
from graphvio.sessions.messages import ODOMETRY, POSE, POSE_WITH_COVARIANCE, TRANSFORM, pose_of, stamp_of
from graphvio.sessions.store import open_store
from graphvio.sessions.topics import TRUTH_TOPIC, Topic, of_type

_log = logging.getLogger(__name__)
_TYPES = (POSE, POSE_WITH_COVARIANCE, ODOMETRY, TRANSFORM)


def truth_topic(topics: Mapping[str, Topic]) -> Topic | None:
    """Return the topic with the true trajectory, or None."""
    topic = topics.get(TRUTH_TOPIC)
    return topic if topic is not None and topic.type_name in (POSE, ODOMETRY) and topic.places else None


def read_poses(path: Path, topic: str | None = None) -> tuple[Int, Float]:
    """Return stamps (N,), increasing, and poses ``world_T_body`` (N, 4, 4) of a topic.

    Args:
        path: path of the session or bag.
        topic: topic with poses, an odometry or transforms; None takes the true trajectory, or the only such topic.

    Raises:
        TrajectoryError: if there is no such topic, or there are several and no true trajectory.
        SessionError: if the session or bag cannot be read.
    """
    wanted = TRUTH_TOPIC if topic is None else topic
    store = open_store(path, lambda each: each == wanted)
    chosen = truth_topic(store.topics) if topic is None else store.topics.get(topic)
    if chosen is None or not chosen.places:
        store = open_store(path)
        chosen = _only_topic(path, of_type(store.topics, *_TYPES), topic)
    if chosen.type_name not in _TYPES:
        raise TrajectoryError(f"{path}: {chosen.name} has messages of {chosen.type_name}; give a topic with poses")
    poses: dict[int, Float] = {}
    damaged: list[SessionError] = []
    for place in chosen.places:
        try:
            message = cdr.decode(store.read(place), chosen.type_name, path)
        except SessionError as error:
            damaged.append(error)
        else:
            poses[stamp_of(message.header)] = pose_of(message)
    if damaged:
        _log.warning("%s: %d poses are left out; the first: %s", path, len(damaged), damaged[0])
    if not poses:
        raise TrajectoryError(f"{path}: not one pose on {chosen.name} can be read; copy the file again")
    stamps = sorted(poses)
    return np.array(stamps, dtype=np.int64), np.array([poses[stamp] for stamp in stamps])


def _only_topic(path: Path, found: Sequence[Topic], asked: str | None) -> Topic:
    """Return the only topic with poses, where there is no true trajectory.

    Raises:
        TrajectoryError: if there is none or there are several, or if a topic without poses was asked for.
    """
    names = ", ".join(each.name for each in found) or "none"
    if asked is not None:
        raise TrajectoryError(f"{path}: has no poses on {asked}; topics with poses: {names}")
    if not found:
        raise TrajectoryError(f"{path}: holds no trajectory, which would be poses or an odometry on some topic")
    if len(found) > 1:
        raise TrajectoryError(f"{path}: has poses on several topics ({names}); give one as {path}:TOPIC")
    return found[0]
