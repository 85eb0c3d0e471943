"""Notices stages that are stuck or dead, and tells when sensors are silent."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence

from graphvio.live.stage import Stage

_log = logging.getLogger(__name__)
_ROUND_S = 0.25

Tell = Callable[[str, str], None]
"""Takes kind and detail of an event."""


class Watchdog:
    """Looks at stages from time to time, from a thread of its own.

    Args:
        stages: to look at.
        stuck_s: a piece of work that takes longer is stuck, and sensors from which nothing came for longer are silent.
        tell: is told when it begins, and when it is over.
        silent_s: tells for how long nothing has come of each kind of sensor that should deliver.
    """

    def __init__(
        self, stages: Sequence[Stage], stuck_s: float, tell: Tell, silent_s: Callable[[], Mapping[str, float]]
    ) -> None:
        self._stages = stages
        self._stuck_s = stuck_s
        self._tell = tell
        self._silent_s = silent_s
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

    @property
    def is_running(self) -> bool:
        """Whether it looks."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def stop(self) -> None:
        """Look no more."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(_ROUND_S):
            try:
                self._look()
            except Exception:  # of an output that is told: stages are watched on
                _log.exception("an event could not be told")

    def _look(self) -> None:
        stuck_before, self._stuck = self._stuck, self.stuck
        for name in sorted(self._stuck - stuck_before):
            self._tell("stage_stuck", f"{name} has worked on one thing for more than {self._stuck_s:g} s")
        for name in sorted(stuck_before - self._stuck):
            self._tell("stage_recovered", f"{name} goes on")
        silent_before, silences_s = self._silent, self._silent_s()
        self._silent = frozenset(kind for kind, since_s in silences_s.items() if since_s > self._stuck_s)
        for kind in sorted(self._silent - silent_before):
            self._tell(f"{kind}_silent", f"nothing came for {self._stuck_s:g} s")
        for kind in sorted(silent_before - self._silent):
            self._tell(f"{kind}_back", "readings come again")
