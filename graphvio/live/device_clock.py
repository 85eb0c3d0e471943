"""Conversion of stamps: from devices' counters, which wrap, and from the kernel's clocks to the host's time."""

from __future__ import annotations

import threading
import time

from graphvio.measurements.readings import host_ns

_MONOTONIC_TO_HOST_NS = host_ns() - time.monotonic_ns()


class MicrosecondCounter:
    """Stamps in nanoseconds from a counter of 32 bits, which wraps every 71.6 minutes.

    Sensors of one device share an instance, so that their stamps agree; any thread may call it. Counters of more bits
    work, too, as long as no pause lasts half an hour.
    """

    _PERIOD_US = 1 << 32

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest_us: float | None = None

    def stamp_ns(self, counter_us: float) -> int:
        """Return the stamp of a counter's value, unwrapped so that it is nearest to the newest stamp."""
        with self._lock:
            if self._newest_us is None:
                self._newest_us = counter_us
            rounds = round((self._newest_us - counter_us) / self._PERIOD_US)
            unwrapped_us = counter_us + rounds * self._PERIOD_US
            self._newest_us = max(self._newest_us, unwrapped_us)
            return round(1e3 * unwrapped_us)


def host_ns_of_monotonic(monotonic_ns: int) -> int:
    """Convert a stamp by ``CLOCK_MONOTONIC`` to the host's time."""
    return monotonic_ns + _MONOTONIC_TO_HOST_NS


def host_ns_of_realtime(realtime_ns: int) -> int:
    """Convert a recent stamp by ``CLOCK_REALTIME``, which may be set at any time, to the host's time."""
    return realtime_ns + realtime_to_host_ns()


def realtime_to_host_ns() -> int:
    """Return the host's time minus ``CLOCK_REALTIME`` now; the best of three readings, as threads are interrupted."""
    readings = []
    for _ in range(3):
        before_ns, realtime_ns, after_ns = host_ns(), time.time_ns(), host_ns()
        readings.append((after_ns - before_ns, (before_ns + after_ns) // 2 - realtime_ns))
    return min(readings)[1]
