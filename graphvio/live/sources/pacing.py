"""Recorded measurements at the pace at which they were recorded, or a multiple."""

from __future__ import annotations

import threading

from graphvio.live.sources import SourceSpec
from graphvio.live.spec_options import number_of
from graphvio.measurements.readings import host_ns

_LATE_NS = 1_000_000_000


class Pace:
    """Waits until a measurement is due.

    Args:
        speed: of the recording's time; None does not wait.
    """

    def __init__(self, speed: float | None) -> None:
        self._speed = speed
        self._stop = threading.Event()
        self._first: tuple[int, int] | None = None  # stamp, and when it was due

    def wait_for(self, stamp_ns: int) -> bool:
        """Wait for the instant of a stamp; False once it was stopped."""
        if self._speed is not None and not self._stop.is_set():
            if self._first is None:
                self._first = stamp_ns, host_ns()
            due_ns = self._first[1] + round((stamp_ns - self._first[0]) / self._speed)
            left_ns = due_ns - host_ns()
            if left_ns < -_LATE_NS:  # the machine slept, or the reader was held up: sensors do not make up for that
                self._first = stamp_ns, host_ns()
            elif left_ns > 0:
                self._stop.wait(left_ns * 1e-9)
        return not self._stop.is_set()

    def stop(self) -> None:
        """Wait no more; from any thread."""
        self._stop.set()


def speed_of(spec: SourceSpec) -> float | None:
    """The option ``speed``: a factor such as ``2``, 1 where it is not given, or None for ``max``.

    Raises:
        SourceError: if it is neither.
    """
    if spec.options.get("speed") == "max":
        return None
    return number_of(spec, "speed", 0.01, 100.0) or 1.0
