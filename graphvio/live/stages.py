"""The threads of a live run, and the watchdog that reports stuck threads and silent sensors."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from graphvio.measurements.events import EventKind

_ROUND_S = 0.25
_log = logging.getLogger(__name__)


class Stage:
    """A thread that works on one item after the other.

    Args:
        name: name of the stage, for people.
        body: runs until there is nothing more to do; works on each item inside of `working`.
        on_failure: called in the thread with an error that ended the body.
        at_end: called in the thread after the body, and after ``on_failure``.
    """

    def __init__(
        self,
        name: str,
        body: Callable[[Stage], None],
        on_failure: Callable[[Stage, BaseException], None],
        at_end: Callable[[], None],
    ) -> None:
        self.name = name
        self.failure: BaseException | None = None
        self._body = body
        self._on_failure = on_failure
        self._at_end = at_end
        self._busy_since_s: float | None = None
        self.done = 0  # items or parts of work that have ended, one way or another
        self._thread = threading.Thread(target=self._run, name=f"graphvio-{name}", daemon=True)

    @contextmanager
    def working(self) -> Iterator[None]:
        """Mark the work on an item, so that work which does not end is noticed."""
        self._busy_since_s = time.monotonic()
        try:
            yield
        finally:
            self._busy_since_s = None
            self.done += 1

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Mark a wait for the next stage inside of `working`: only the next one can be stuck in the meantime."""
        is_working = self._busy_since_s is not None
        self._busy_since_s = None
        try:
            yield
        finally:
            self._busy_since_s = time.monotonic() if is_working else None

    def progress(self) -> None:
        """Mark inside of `working` that a part of the work is done, and the next one begins."""
        self._busy_since_s = time.monotonic()
        self.done += 1

    @property
    def busy_s(self) -> float:
        """Time since the work on the present item, or part of it, began; zero if there is none."""
        since_s = self._busy_since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    @property
    def is_alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait for the thread's end; returns whether it has ended."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._body(self)
        except BaseException as error:  # any kind of error: the other stages must end, too
            self.failure = error
            self._on_failure(self, error)
        finally:
            self._busy_since_s = None
            self._at_end()


class Watchdog:
    """Monitors stages and sensors from a thread of its own.

    Args:
        stages: the stages to monitor.
        stuck_s: a stage whose item takes longer is stuck, and a sensor that delivers nothing for longer is silent.
        report: takes kind and detail of an event, when such a state begins and when it ends.
        silences_s: returns the time since the last reading by kind of sensor, of the kinds that should deliver.
    """

    def __init__(
        self,
        stages: Sequence[Stage],
        stuck_s: float,
        report: Callable[[str, str], None],
        silences_s: Callable[[], Mapping[str, float]],
    ) -> None:
        self._stages = stages
        self._stuck_s = stuck_s
        self._report = report
        self._silences_s = silences_s
        self._silent: frozenset[str] = frozenset()
        self._stuck: frozenset[str] = frozenset()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="graphvio-watchdog", daemon=True)

    @property
    def stuck(self) -> frozenset[str]:
        """Names of the stages that are stuck now."""
        return frozenset(stage.name for stage in self._stages if stage.busy_s > self._stuck_s)

    @property
    def dead(self) -> frozenset[str]:
        """Names of the stages that failed."""
        return frozenset(stage.name for stage in self._stages if stage.failure is not None)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread, if it was started."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(_ROUND_S):
            try:
                self._check()
            except Exception:  # in an output that takes the event: monitoring goes on
                _log.exception("an event could not be reported")

    def _check(self) -> None:
        stuck_before, self._stuck = self._stuck, self.stuck
        for name in sorted(self._stuck - stuck_before):
            detail = f"{name} has worked on one item for more than {self._stuck_s:g} s"
            self._report(EventKind.STAGE_STUCK, detail)
        for name in sorted(stuck_before - self._stuck):
            self._report(EventKind.STAGE_RECOVERED, f"{name} goes on")
        silent_before, silences_s = self._silent, self._silences_s()
        self._silent = frozenset(kind for kind, since_s in silences_s.items() if since_s > self._stuck_s)
        for kind in sorted(self._silent - silent_before):
            self._report(f"{kind}_silent", f"nothing came for {self._stuck_s:g} s")
        for kind in sorted(silent_before - self._silent):
            self._report(f"{kind}_back", "readings come again")
