"""Readings of several threads in the order in which they came, for the one thread that takes them."""

from __future__ import annotations

import threading
from collections import deque

from graphvio.live.counts import Counts
from graphvio.measurements.readings import Notice, Reading

_LONGEST_NS = 2_000_000_000


class Mailbox:
    """A queue that never holds up who puts in; what nobody takes for two seconds is dropped, save notices.

    Two seconds of images are some tens of megabytes. Who falls further behind than that must start anew in any case.
    """

    def __init__(self, longest_ns: int = _LONGEST_NS) -> None:
        self._longest_ns = longest_ns
        self._changed = threading.Condition()
        self._kept: deque[Notice] = deque()
        self._waiting: deque[tuple[str, Reading]] = deque()
        self._is_closed = False
        self._dropped = Counts()

    def put(self, owner: str, reading: Reading) -> None:
        """Add a reading of a device; returns at once, and does nothing after `close`."""
        with self._changed:
            if self._is_closed:
                return
            self._waiting.append((owner, reading))
            while reading.arrival_ns - self._waiting[0][1].arrival_ns > self._longest_ns:
                of, oldest = self._waiting.popleft()
                if isinstance(oldest, Notice):
                    self._kept.append(oldest)
                else:
                    self._dropped.add(of)
            self._changed.notify()

    def get(self) -> Reading | None:
        """The oldest reading, waited for; None after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._kept or self._waiting or self._is_closed)
            if self._is_closed:
                return None
            return self._kept.popleft() if self._kept else self._waiting.popleft()[1]

    def close(self) -> None:
        """Nothing more is wanted; what waits is forgotten."""
        with self._changed:
            self._is_closed = True
            self._kept.clear()
            self._waiting.clear()
            self._changed.notify_all()

    def dropped(self, owner: str) -> int:
        """How many readings of a device were not taken in time."""
        return self._dropped.totals().get(owner, 0)
