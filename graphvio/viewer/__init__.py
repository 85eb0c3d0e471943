"""Live view and recording of a run with rerun (the extra ``viewer``)."""

from graphvio.viewer.processes import WebOptions
from graphvio.viewer.viewer import Viewer, check_display

__all__ = ["Viewer", "WebOptions", "check_display"]
