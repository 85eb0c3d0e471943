"""Shows a live run in the viewer."""

from __future__ import annotations

from collections.abc import Mapping

from graphvio.events import Estimate, Event, FrameSet, Incident
from graphvio.viewer import Viewer


class ViewOutput:
    """An output (`graphvio.live.output.Output`) whose images are the newest that the viewer has time for.

    Args:
        viewer: open.
    """

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer

    def add_event(self, event: Event) -> None:
        """Events are shown with what is made of them."""

    def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
        """See `Output`."""
        self._viewer.show(frameset, estimate)

    def add_incident(self, incident: Incident) -> None:
        """See `Output`."""
        self._viewer.show_incident(incident)

    def status(self) -> Mapping[str, float | int | str | None]:
        """See `Output`."""
        return {"framesets_not_shown": self._viewer.dropped}
