"""Shows a run in rerun's window or in browsers, or saves it to a file, without delaying the odometry.

A thread logs to rerun. When it is slower than the odometry, images are left out: only the newest frameset waits to be
logged, and replaces an older one. Poses, curves and messages are never left out.
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from graphvio.errors import GraphvioError, MissingExtraError
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.events import Event
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Rig
from graphvio.viewer.processes import WebOptions

if TYPE_CHECKING:
    from graphvio.self_calibration.estimate import CalibrationEstimate
    from graphvio.trajectory import Trajectory
    from graphvio.viewer.recording import Recording

_ROUND_S = 0.03


class Viewer:
    """Shows a run in a window or in browsers, saves it to a file, or does several of these; a context manager.

    Args:
        rig: rig whose cameras are shown.
        spawn: open rerun's window and stream to it.
        save: file (``.rrd``) to save a recording to; needs no display.
        web: serve browsers at ``web.url`` until the viewer is closed; needs no display.

    Raises:
        MissingExtraError: if rerun is not installed.
        GraphvioError: if there is no display for a window, the file cannot be written, or a port is not available.
    """

    def __init__(
        self, rig: Rig, *, spawn: bool = False, save: Path | None = None, web: WebOptions | None = None
    ) -> None:
        recording = _open_recording(rig, spawn, save, web)
        self._web = web
        self._changed = threading.Condition()
        self._estimates: deque[Estimate] = deque()
        self._extras: deque[Callable[[Recording], None]] = deque()
        self._frameset: tuple[FrameSet, Estimate] | None = None
        self._closing = False
        self.dropped = 0  # framesets whose images were left out because the odometry was faster
        self._error: Exception | None = None
        self._worker = threading.Thread(target=self._work, args=(recording,), name="viewer", daemon=True)
        self._worker.start()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        except GraphvioError:
            if kind is None:  # otherwise the error that ended the context is raised
                raise

    @property
    def url(self) -> str | None:
        """Address for a browser, or None if browsers are not served."""
        return None if self._web is None else self._web.url

    def show(self, frameset: FrameSet | None, estimate: Estimate) -> None:
        """Show an estimate, and the images of its frameset unless ``frameset`` is None; returns at once."""
        with self._changed:
            if self._closing or self._error is not None:
                return
            self._estimates.append(estimate)
            if frameset is not None:
                self.dropped += self._frameset is not None
                self._frameset = (frameset, estimate)
            self._changed.notify()

    def show_event(self, event: Event) -> None:
        """Show an event; returns at once."""
        self._add_extra(lambda recording: recording.add_event(event))

    def show_calibration(self, stamp_ns: int, estimate: CalibrationEstimate) -> None:
        """Show a calibration that came into force at a stamp; returns at once."""
        self._add_extra(lambda recording: recording.add_calibration(stamp_ns, estimate))

    def show_path(self, name: str, path: Trajectory, colour: tuple[int, int, int] = (150, 150, 150)) -> None:
        """Show another trajectory in nav, such as the smoothed one or the truth; returns at once."""
        self._add_extra(lambda recording: recording.add_path(name, path, colour))

    def _add_extra(self, extra: Callable[[Recording], None]) -> None:
        with self._changed:
            if self._closing or self._error is not None:
                return
            self._extras.append(extra)
            self._changed.notify()

    def close(self) -> None:
        """Show all pending data, flush and end; later calls of other methods have no effect.

        Raises:
            GraphvioError: if rerun has failed; the recording then ends at that point.
        """
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._worker.join()
        error, self._error = self._error, None
        if error is not None:
            raise GraphvioError(f"viewer: rerun failed ({_first_line(error)}); what was shown or saved is incomplete")

    def _work(self, recording: Recording) -> None:
        try:
            try:
                self._log(recording)
            finally:
                recording.close()
        except Exception as error:
            self._error = error
            self._estimates.clear()
            self._extras.clear()
            self._frameset = None

    def _log(self, recording: Recording) -> None:
        while self._log_pending(recording):
            # More frequent rounds would slow the odometry down; a batch of estimates costs as much as one estimate.
            with self._changed:
                self._changed.wait_for(lambda: self._closing, _ROUND_S)

    def _log_pending(self, recording: Recording) -> bool:
        """Wait for pending data and log it; return False when the viewer is closing and all data is logged."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing or self._estimates or self._extras)
            estimates, self._estimates = self._estimates, deque()
            extras, self._extras = self._extras, deque()
            frameset, self._frameset = self._frameset, None
            closing = self._closing
        recording.add_estimates(list(estimates))
        for extra in extras:
            extra(recording)
        if frameset is not None:
            recording.add_images(*frameset)
        return not closing


def check_display() -> None:
    """Check that a window can be opened.

    Raises:
        GraphvioError: on Linux without an X or Wayland display.
    """
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise GraphvioError(
            "viewer: there is no display to open a window on; save a recording with --save-rrd FILE and open "
            "it with  rerun FILE  where there is one"
        )


def _open_recording(rig: Rig, spawn: bool, save: Path | None, web: WebOptions | None) -> Recording:
    try:
        from graphvio.viewer.recording import Recording
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "rerun":
            raise
        raise MissingExtraError("rerun-sdk", "viewer", "showing or saving a recording") from None
    if spawn:
        check_display()
    if save is not None and not Path(save).parent.is_dir():
        raise GraphvioError(f"{save}: cannot be written (there is no folder {Path(save).parent}); make it first")
    try:
        return Recording(rig, spawn=spawn, save=save, web=web)
    except (OSError, RuntimeError, ValueError) as error:
        raise GraphvioError(f"viewer: cannot be opened ({_first_line(error)})") from None


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)
