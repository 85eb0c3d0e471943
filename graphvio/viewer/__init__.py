"""Live view and recording of a run, by way of rerun (the extra ``viewer``)."""

from graphvio.viewer.viewer import Viewer, check_display
from graphvio.viewer.web import WebOptions

__all__ = ["Viewer", "WebOptions", "check_display"]
