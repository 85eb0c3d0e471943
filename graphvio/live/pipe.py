"""A bounded queue from one stage to the next, of which either end can go without the other's waiting for ever."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Pipe(Generic[T]):
    """Between those that bring items and the one that takes them.

    Args:
        most: that may wait.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._changed = threading.Condition()
        self._waiting: deque[T] = deque()
        self._is_closed = False

    def put(self, item: T, waits: bool) -> bool:
        """Bring an item; whether it was taken in: not if it is closed, or there is no room and it is not waited for."""
        with self._changed:
            if waits:
                self._changed.wait_for(lambda: len(self._waiting) < self._most or self._is_closed)
            if self._is_closed or len(self._waiting) >= self._most:
                return False
            self._waiting.append(item)
            self._changed.notify_all()
            return True

    def take(self, timeout_s: float | None = None) -> T | None:
        """The oldest item, or None when there is none by the end of the time or there will be none."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed, timeout_s)
            if not self._waiting:
                return None
            item = self._waiting.popleft()
            self._changed.notify_all()
            return item

    def close(self) -> None:
        """Nothing more will be brought; what waits can still be taken."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def abandon(self) -> None:
        """Nothing more will be taken: whoever waits for room goes on, and what waits is forgotten."""
        with self._changed:
            self._waiting.clear()
            self.close()

    @property
    def is_finished(self) -> bool:
        """Whether it is closed, and all has been taken."""
        with self._changed:
            return self._is_closed and not self._waiting

    def __len__(self) -> int:
        return len(self._waiting)
