"""What waits for the odometry: samples and framesets in the order in which they came."""

from __future__ import annotations

import threading
from collections import deque

from graphvio.measurements.readings import host_ns
from graphvio.measurements.sensors import FrameSet, Measurement

_MOST_SAMPLES = 50_000  # minutes: when so many wait, whoever takes them is dead


class Inbox:
    """Between the threads that bring measurements and the one that takes them.

    Args:
        most_framesets: that may wait.
        waits: whether `put` waits for room; else the oldest frameset goes, and samples are lost only where whoever
            takes them is dead.

    Attributes:
        dropped_framesets: for which there was no room.
        dropped_samples: likewise.
    """

    def __init__(self, most_framesets: int, waits: bool) -> None:
        self._most = most_framesets
        self._waits = waits
        self._changed = threading.Condition()
        self._waiting: deque[tuple[Measurement, int]] = deque()
        self._framesets = 0
        self._is_closed = False
        self.dropped_framesets = 0
        self.dropped_samples = 0

    def put(self, measurement: Measurement, arrival_ns: int | None = None) -> None:
        """Bring a measurement that came just now, or then; once it is closed nothing is taken in."""
        is_frameset = isinstance(measurement, FrameSet)
        with self._changed:
            if self._waits:
                self._changed.wait_for(lambda: self._has_room(is_frameset) or self._is_closed)
            if self._is_closed:
                return
            if is_frameset:
                if self._framesets >= self._most:
                    self._drop_oldest_frameset()
                self._framesets += 1
            elif not self._has_room(is_frameset):
                self.dropped_samples += 1
                return
            self._waiting.append((measurement, host_ns() if arrival_ns is None else arrival_ns))
            self._changed.notify_all()

    def take(self, timeout_s: float) -> tuple[Measurement, int] | None:
        """The oldest measurement and when it came, or None when there is none by the end of the time."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed, timeout_s)
            if not self._waiting:
                return None
            measurement, arrival_ns = self._waiting.popleft()
            self._framesets -= isinstance(measurement, FrameSet)
            if self._waits:
                self._changed.notify_all()
            return measurement, arrival_ns

    def close(self) -> None:
        """Nothing more will come; what waits can still be taken."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def abandon(self) -> None:
        """Nothing more will be taken: whoever waits for room goes on, and what waits is forgotten."""
        with self._changed:
            self._waiting.clear()
            self._framesets = 0
            self.close()

    @property
    def is_finished(self) -> bool:
        """Whether it is closed, and all has been taken."""
        with self._changed:
            return self._is_closed and not self._waiting

    @property
    def framesets(self) -> int:
        """That wait."""
        return self._framesets

    def __len__(self) -> int:
        return len(self._waiting)

    def _has_room(self, is_frameset: bool) -> bool:
        return self._framesets < self._most if is_frameset else len(self._waiting) < _MOST_SAMPLES

    def _drop_oldest_frameset(self) -> None:
        at = next(i for i, (measurement, _) in enumerate(self._waiting) if isinstance(measurement, FrameSet))
        del self._waiting[at]
        self._framesets -= 1
        self.dropped_framesets += 1
