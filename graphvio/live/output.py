"""What takes all that comes and all that is made of it: a recorder, a viewer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from graphvio.events import Estimate, Event, FrameSet, Incident


class Output(Protocol):
    """Handed events by the threads that bring them, which it must not hold up; and results by a thread of its own."""

    def add_event(self, event: Event) -> None:
        """A sample or frameset came; from several threads."""

    def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
        """An estimate was made, of images that are given if they are still known."""

    def add_incident(self, incident: Incident) -> None:
        """Something happened; from several threads."""

    def status(self) -> Mapping[str, float | int | str | None]:
        """How it does, by name; from any thread."""
