"""Counts by kind that threads of drivers add to, while others read them."""

from __future__ import annotations

import threading
from collections import Counter


class Counts:
    """How often what happened."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def add(self, kind: str, count: int = 1) -> None:
        """It happened once more, or so many times."""
        if count:
            with self._lock:
                self._counts[kind] += count

    def totals(self) -> dict[str, int]:
        """All that are not zero."""
        with self._lock:
            return dict(self._counts)
