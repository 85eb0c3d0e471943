"""Figures of a live run by name (counts, rates, latencies), which terminal, metrics and services show."""

from __future__ import annotations

import re
import threading
from collections import Counter, deque
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from graphvio.measurements.estimate import Estimate
from graphvio.measurements.readings import DeviceHealth

_STATM = Path("/proc/self/statm")
_PAGE_BYTES = 4096
_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9]+")  # characters that names of metrics do not have
_RECENT = 1200  # latencies: a minute at 20 Hz
_RATE_S = 2.0
_BIN_MS = 0.5
_BINS = 4000
_STALE_NS = 2_000_000_000
STALE = "stale"
"""The status if the newest estimate is older than two seconds."""

Figures = dict[str, float | int | str | None]


class Meter:
    """Counts, rates and latencies of a live run; called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._latencies_ms: deque[float] = deque(maxlen=_RECENT)
        self._histogram = np.zeros(_BINS + 1, dtype=np.int64)  # of the whole run
        self.max_latency_ms = 0.0  # of the whole run
        self._arrivals_ns: dict[str, deque[int]] = {}

    def count(self, kind: str, by: int = 1) -> None:
        """Add to a count."""
        with self._lock:
            self._counts[kind] += by

    def add_arrival(self, kind: str, host_ns: int) -> None:
        """Count an item of a kind whose rate is measured, with the host time of its arrival."""
        with self._lock:
            self._counts[kind] += 1
            stamps = self._arrivals_ns.setdefault(kind, deque())
            stamps.append(host_ns)
            while host_ns - stamps[0] > _RATE_S * 1e9:
                stamps.popleft()

    def newest_ns(self, kind: str) -> int | None:
        """Return the host time of the newest arrival, or None."""
        with self._lock:
            stamps = self._arrivals_ns.get(kind)
            return stamps[-1] if stamps else None

    def rate_hz(self, kind: str, now_ns: int) -> float:
        """Return the rate of arrivals in the last two seconds."""
        with self._lock:
            stamps = self._arrivals_ns.get(kind, ())
            return sum(now_ns - stamp < _RATE_S * 1e9 for stamp in stamps) / _RATE_S

    def add_latency(self, latency_ms: float) -> None:
        """Add the time from a frameset's arrival to its estimate."""
        latency_ms = max(latency_ms, 0.0)  # the arrival is the time that the source gives
        with self._lock:
            self._latencies_ms.append(latency_ms)
            self._histogram[min(int(latency_ms / _BIN_MS), _BINS)] += 1
            self.max_latency_ms = max(self.max_latency_ms, latency_ms)

    @property
    def counts(self) -> dict[str, int]:
        """All counts by kind."""
        with self._lock:
            return dict(self._counts)

    def recent_latency_ms(self, percent: float) -> float | None:
        """Return a percentile of the newest latencies."""
        with self._lock:
            return float(np.percentile(self._latencies_ms, percent)) if self._latencies_ms else None

    def latency_ms(self, percent: float) -> float | None:
        """Return a percentile of all latencies, to half a millisecond; beyond two seconds, their maximum."""
        with self._lock:
            total = int(self._histogram.sum())
            if not total:
                return None
            rank = np.searchsorted(np.cumsum(self._histogram), percent / 100.0 * total)
            return self.max_latency_ms if rank >= _BINS else min(float((rank + 1) * _BIN_MS), self.max_latency_ms)


def run_figures(meter: Meter, latest: Estimate | None, now_ns: int) -> Figures:
    """Return the figures of a run from its counts and its newest estimate."""
    counts = meter.counts
    kinds = ("images", "imu_samples", "framesets", "estimates", "skipped_late")
    found: Figures = {
        **{kind: counts.pop(kind, 0) for kind in kinds},
        "frameset_hz": meter.rate_hz("framesets", now_ns),
        "estimate_hz": meter.rate_hz("estimates", now_ns),
        "imu_hz": meter.rate_hz("imu_samples", now_ns),
        "latency_p50_ms": meter.recent_latency_ms(50),
        "latency_p99_ms": meter.recent_latency_ms(99),
        "latency_p99_all_ms": meter.latency_ms(99),
        "latency_max_ms": meter.max_latency_ms,
        "memory_mb": _memory_mb(),
        **dict(sorted(counts.items())),
    }
    newest_ns = meter.newest_ns("estimates")
    if latest is not None and newest_ns is not None:
        found |= _estimate_figures(latest)
        found["estimate_age_s"] = 1e-9 * (now_ns - newest_ns)
        if now_ns - newest_ns > _STALE_NS:
            found["status"] = STALE
    return found


def _estimate_figures(estimate: Estimate) -> Figures:
    found: Figures = {"status": str(estimate.status), "epoch": estimate.epoch, "stamp_ns": estimate.stamp_ns}
    for j, report in sorted(estimate.pairs.items()):
        found[f"pair{j}_points"], found[f"pair{j}_inliers"] = report.points, report.inliers
    if estimate.gyro_bias is not None:
        found["gyro_bias_rad_s"] = float(np.linalg.norm(estimate.gyro_bias))
    if estimate.accel_bias is not None:
        found["accel_bias_m_s2"] = float(np.linalg.norm(estimate.accel_bias))
    if estimate.covariance is not None:
        found["position_sigma_m"] = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[3:, 3:])[-1]))
    return found


def device_figures(devices: Sequence[DeviceHealth]) -> Figures:
    """Return for each device whether it is connected, 1 or 0, and the losses in its driver by kind."""
    found: Figures = {}
    for device in devices:
        name = "device_" + _NOT_IN_NAMES.sub("_", device.name)
        found[f"{name}_connected"] = int(device.connected)
        found |= {f"{name}_{_NOT_IN_NAMES.sub('_', kind)}": count for kind, count in sorted(device.counts.items())}
    return found


def _memory_mb() -> float | None:
    """Return the resident memory of the process, or None where the system does not report it."""
    try:
        return int(_STATM.read_text().split()[1]) * _PAGE_BYTES / 1e6
    except OSError:
        return None
