"""What takes all that comes and all that is made of it: a recorder, a viewer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from graphvio.measurements.estimate import Estimate
from graphvio.measurements.events import Event
from graphvio.measurements.sensors import FrameSet, Measurement


class Output(Protocol):
    """Consumer of measurements and results: it must not block the threads that hand measurements over."""

    def add_measurement(self, measurement: Measurement) -> None:
        """A sample or frameset came; from several threads."""

    def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
        """An estimate was made, of images that are given if they are still known."""

    def add_event(self, event: Event) -> None:
        """Something happened; from several threads."""

    def status(self) -> Mapping[str, float | int | str | None]:
        """How it does, by name; from any thread."""
