"""Faults of a recording: counted by kind, and logged once per kind."""

from __future__ import annotations

import logging
from collections import Counter

from graphvio.measurements.events import Event, EventKind

_log = logging.getLogger(__name__)


class FaultLog:
    """Counts faults by kind, and keeps and logs the first of each kind.

    Args:
        name: name of the recording, with which each logged line begins.

    Attributes:
        counts: kind -> number of faults.
        events: the first fault of each kind, in the order in which they came.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.counts: dict[str, int] = {}
        self.events: list[Event] = []
        self._logged: set[str] = set()

    def add(self, kind: EventKind, stamp_ns: int, detail: str, times: int = 1) -> None:
        """Count faults of a kind, none if ``times`` is 0; ``stamp_ns`` and ``detail``, one line, describe the first."""
        if times <= 0:
            return
        first = kind not in self.counts
        self.counts[kind] = self.counts.get(kind, 0) + times
        if not first:
            return
        self.events.append(Event(stamp_ns, kind, detail))
        if kind not in self._logged:  # not logged again when the recording is read a second time
            self._logged.add(kind)
            _log.warning("%s: %s: %s (later ones are only counted)", self.name, kind, detail)

    def mark(self) -> tuple[Counter[str], list[Event]]:
        """Return the present counts and events, for `rewind`."""
        return Counter(self.counts), list(self.events)

    def rewind(self, marked: tuple[Counter[str], list[Event]]) -> None:
        """Forget what was counted since `mark`."""
        self.counts, self.events = dict(marked[0]), list(marked[1])

    def __str__(self) -> str:
        return ", ".join(f"{kind} {count}" for kind, count in sorted(self.counts.items())) or "none"
