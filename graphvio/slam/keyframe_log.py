"""The newest keyframes, for any number of readers that come, go and come back."""

from __future__ import annotations

import threading
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator

from graphvio.slam.keyframe import Keyframe

_OLD_BYTES = 256 * 2**20


class KeyframeLog:
    """Keeps keyframes in the order of their ids; the oldest go when they take more than a share of memory.

    Args:
        most_bytes: of landmarks and images that are kept.
    """

    def __init__(self, most_bytes: int = _OLD_BYTES) -> None:
        self._most_bytes = most_bytes
        self._changed = threading.Condition()
        self._kept: deque[Keyframe] = deque()
        self._bytes = 0
        self._next_id = 0
        self._is_closed = False

    @property
    def oldest_id(self) -> int:
        """Of the oldest keyframe that can still be read; the next one's, when there is none."""
        with self._changed:
            return self._kept[0].id if self._kept else self._next_id

    @property
    def next_id(self) -> int:
        """The newest keyframe's, plus one."""
        with self._changed:
            return self._next_id

    def add(self, keyframe: Keyframe) -> None:
        """Take the next keyframe; readers that wait go on."""
        with self._changed:
            self._kept.append(keyframe)
            self._next_id = keyframe.id + 1
            self._bytes += _size(keyframe)
            while self._bytes > self._most_bytes and len(self._kept) > 1:
                self._bytes -= _size(self._kept.popleft())
            self._changed.notify_all()

    def read(self, from_id: int, timeout_s: float | None = None) -> Keyframe | None:
        """The oldest keyframe from an id on; its own id tells how many are gone.

        Returns:
            None when there is none by the end of the time, or there will be none.
        """
        until = None if timeout_s is None else time.monotonic() + timeout_s
        with self._changed:
            while self._next_id <= from_id and not self._is_closed:
                left = None if until is None else until - time.monotonic()
                if left is not None and left <= 0.0:
                    return None
                self._changed.wait(left)
            if self._next_id <= from_id or not self._kept:
                return None
            return self._kept[bisect_left(self._kept, from_id, key=lambda kept: kept.id)]

    def follow(self, from_id: int) -> Iterator[Keyframe]:
        """Keyframes from an id on as they come, until the log is closed; ids that are gone are passed over."""
        while (keyframe := self.read(from_id)) is not None:
            yield keyframe
            from_id = keyframe.id + 1

    def close(self) -> None:
        """There will be no more; what is kept can still be read."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    @property
    def is_closed(self) -> bool:
        """Whether there will be no more."""
        return self._is_closed


def _size(keyframe: Keyframe) -> int:
    marks = keyframe.landmarks
    columns = (
        marks.pair,
        marks.track_id,
        marks.points_body,
        marks.covariances,
        marks.left_px,
        marks.right_px,
        marks.descriptors,
    )
    images = [image for both in keyframe.images.values() for image in both]
    return sum(column.nbytes for column in (*columns, *images))
