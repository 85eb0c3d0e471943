"""Shows a live run in the viewer."""

from __future__ import annotations

from collections.abc import Mapping

from graphvio.measurements.estimate import Estimate
from graphvio.measurements.events import Event
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.viewer import Viewer


class ViewOutput:
    """An output (`graphvio.live.output.Output`) whose images are the newest that the viewer has time for.

    Args:
        viewer: open.
    """

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer

    def add_measurement(self, measurement: Measurement) -> None:
        """Measurements are shown with what is made of them."""

    def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
        """See `Output`."""
        self._viewer.show(frameset, estimate)

    def add_event(self, event: Event) -> None:
        """See `Output`."""
        self._viewer.show_event(event)

    def status(self) -> Mapping[str, float | int | str | None]:
        """See `Output`."""
        return {"framesets_not_shown": self._viewer.dropped}
