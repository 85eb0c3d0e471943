"""Counts and latencies of a live run; from any thread."""

from __future__ import annotations

import threading
from collections import Counter, deque

import numpy as np

_NEWEST = 1200  # framesets whose latency is told: a minute at 20 Hz
_RATE_S = 2.0
_BIN_MS = 0.5
_BINS = 4000


class Meter:
    """What came, what was lost, and how long it took."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._latencies_ms: deque[float] = deque(maxlen=_NEWEST)
        self._histogram = np.zeros(_BINS + 1, dtype=np.int64)  # of the whole run
        self._longest_ms = 0.0
        self._came: dict[str, deque[int]] = {}

    def count(self, kind: str, by: int = 1) -> None:
        """Something happened so many times."""
        with self._lock:
            self._counts[kind] += by

    def came(self, what: str, host_ns: int) -> None:
        """Something came that has a rate."""
        with self._lock:
            self._counts[what] += 1
            stamps = self._came.setdefault(what, deque())
            stamps.append(host_ns)
            while host_ns - stamps[0] > _RATE_S * 1e9:
                stamps.popleft()

    def newest_ns(self, what: str) -> int | None:
        """When it came last, or None."""
        with self._lock:
            stamps = self._came.get(what)
            return stamps[-1] if stamps else None

    def rate_hz(self, what: str, now_ns: int) -> float:
        """How often it came in the last two seconds."""
        with self._lock:
            stamps = self._came.get(what, ())
            return sum(now_ns - stamp < _RATE_S * 1e9 for stamp in stamps) / _RATE_S

    def add_latency(self, latency_ms: float) -> None:
        """A frameset has an estimate, so long after it came."""
        latency_ms = max(latency_ms, 0.0)  # when it came is what its source says
        with self._lock:
            self._latencies_ms.append(latency_ms)
            self._histogram[min(int(latency_ms / _BIN_MS), _BINS)] += 1
            self._longest_ms = max(self._longest_ms, latency_ms)

    @property
    def counts(self) -> dict[str, int]:
        """By kind."""
        with self._lock:
            return dict(self._counts)

    @property
    def longest_ms(self) -> float:
        """The longest latency of the whole run."""
        return self._longest_ms

    def recent_ms(self, percent: float) -> float | None:
        """Percentile of the newest latencies."""
        with self._lock:
            return float(np.percentile(self._latencies_ms, percent)) if self._latencies_ms else None

    def overall_ms(self, percent: float) -> float | None:
        """Percentile of all latencies, to half a millisecond; beyond two seconds, the longest of all."""
        with self._lock:
            total = int(self._histogram.sum())
            if not total:
                return None
            rank = np.searchsorted(np.cumsum(self._histogram), percent / 100.0 * total)
            return self._longest_ms if rank >= _BINS else min(float((rank + 1) * _BIN_MS), self._longest_ms)
