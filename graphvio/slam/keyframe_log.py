"""The newest keyframes, for any number of readers that may disconnect and resume."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator
from dataclasses import fields

from graphvio.slam.keyframe import Keyframe

_MAX_BYTES = 256 * 2**20


class KeyframeLog:
    """Keyframes in the order of their ids; the oldest are dropped beyond a limit of memory. Thread-safe.

    Attributes:
        is_closed: whether no keyframe will follow.
    """

    def __init__(self, max_bytes: int = _MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._changed = threading.Condition()
        self._kept: deque[Keyframe] = deque()
        self._bytes = 0
        self._next_id = 0
        self.is_closed = False

    @property
    def oldest_id(self) -> int:
        """Id of the oldest keyframe that is kept; `next_id` if there is none."""
        with self._changed:
            return self._kept[0].id if self._kept else self._next_id

    @property
    def next_id(self) -> int:
        """Id of the newest keyframe, plus one."""
        with self._changed:
            return self._next_id

    def add(self, keyframe: Keyframe) -> None:
        """Append the next keyframe, and wake waiting readers."""
        with self._changed:
            self._kept.append(keyframe)
            self._next_id = keyframe.id + 1
            self._bytes += _size(keyframe)
            while self._bytes > self._max_bytes and len(self._kept) > 1:
                self._bytes -= _size(self._kept.popleft())
            self._changed.notify_all()

    def read(self, from_id: int, timeout_s: float | None = None) -> Keyframe | None:
        """Wait for and return the first kept keyframe from an id on; None after the timeout, or if none will come."""
        with self._changed:
            self._changed.wait_for(lambda: self._next_id > from_id or self.is_closed, timeout_s)
            if self._next_id <= from_id or not self._kept:
                return None
            return self._kept[bisect_left(self._kept, from_id, key=lambda kept: kept.id)]

    def follow(self, from_id: int) -> Iterator[Keyframe]:
        """Yield keyframes from an id on as they come, until the log is closed; dropped ones are skipped."""
        while (keyframe := self.read(from_id)) is not None:
            yield keyframe
            from_id = keyframe.id + 1

    def close(self) -> None:
        """End the log; keyframes that are kept can still be read."""
        with self._changed:
            self.is_closed = True
            self._changed.notify_all()


def _size(keyframe: Keyframe) -> int:
    columns = (getattr(keyframe.landmarks, each.name) for each in fields(keyframe.landmarks))
    images = (image for both in keyframe.images.values() for image in both)
    return sum(array.nbytes for array in (*columns, *images))
