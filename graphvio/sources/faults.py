"""Faults of a recording: counted by kind, and told once with the place where each kind was met first."""

from __future__ import annotations

import logging
from collections import Counter

from graphvio.measurements.events import Event

_log = logging.getLogger(__name__)


class FaultLog:
    """Counts faults by kind, and keeps and logs the first of each kind.

    Attributes:
        counts: kind -> how often it was met.
        events: the first fault of each kind, in the order in which the kinds were met.
    """

    def __init__(self, name: str) -> None:
        """An empty log; ``name`` of the recording begins each logged line."""
        self.name = name
        self.counts: dict[str, int] = {}
        self.events: list[Event] = []
        self._told: set[str] = set()

    def add(self, kind: str, stamp_ns: int, detail: str, times: int = 1) -> None:
        """Count a fault that was met ``times`` times, first at ``stamp_ns``; the kind's first is logged."""
        if times <= 0:
            return
        first = kind not in self.counts
        self.counts[kind] = self.counts.get(kind, 0) + times
        if not first:
            return
        self.events.append(Event(stamp_ns, kind, detail))
        if kind not in self._told:  # a second pass over the recording tells nothing new
            self._told.add(kind)
            _log.warning("%s: %s: %s (further ones are only counted)", self.name, kind, detail)

    def mark(self) -> tuple[Counter[str], list[Event]]:
        """What is known now, to return to with `rewind`."""
        return Counter(self.counts), list(self.events)

    def rewind(self, marked: tuple[Counter[str], list[Event]]) -> None:
        """Forget what was counted since `mark`."""
        self.counts, self.events = dict(marked[0]), list(marked[1])

    def __str__(self) -> str:
        return ", ".join(f"{kind} {count}" for kind, count in sorted(self.counts.items())) or "none"
