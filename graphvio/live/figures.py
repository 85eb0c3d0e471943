"""How a live run does, as figures by name: what the terminal, the metrics and the services show."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from graphvio.live.meter import Meter
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.readings import DeviceHealth

_STATM = Path("/proc/self/statm")
_PAGE_BYTES = 4096
_NO_NAME = re.compile(r"[^A-Za-z0-9]+")  # what names of figures, which become metrics, must not have

_STALE_NS = 2_000_000_000
STALE = "stale"
"""The status where the newest estimate is older than two seconds."""

Figures = dict[str, float | int | str | None]


def figures(meter: Meter, latest: Estimate | None, now_ns: int) -> Figures:
    """All figures of the counts and of the newest estimate."""
    counts = meter.counts
    told: Figures = {
        "images": counts.pop("images", 0),
        "imu_samples": counts.pop("imu_samples", 0),
        "framesets": counts.pop("framesets", 0),
        "estimates": counts.pop("estimates", 0),
        "skipped_late": counts.pop("skipped_late", 0),
        "frameset_hz": meter.rate_hz("framesets", now_ns),
        "estimate_hz": meter.rate_hz("estimates", now_ns),
        "imu_hz": meter.rate_hz("imu_samples", now_ns),
        "latency_p50_ms": meter.recent_ms(50),
        "latency_p99_ms": meter.recent_ms(99),
        "latency_p99_all_ms": meter.overall_ms(99),
        "latency_max_ms": meter.longest_ms,
        "memory_mb": memory_mb(),
    }
    told |= dict(sorted(counts.items()))
    newest_ns = meter.newest_ns("estimates")
    if latest is not None and newest_ns is not None:
        told |= _of_estimate(latest)
        told["estimate_age_s"] = 1e-9 * (now_ns - newest_ns)
        if now_ns - newest_ns > _STALE_NS:
            told["status"] = STALE
    return told


def _of_estimate(estimate: Estimate) -> Figures:
    told: Figures = {"status": str(estimate.status), "epoch": estimate.epoch, "stamp_ns": estimate.stamp_ns}
    for j, report in sorted(estimate.pairs.items()):
        told[f"pair{j}_points"], told[f"pair{j}_inliers"] = report.points, report.inliers
    if estimate.gyro_bias is not None:
        told["gyro_bias_rad_s"] = float(np.linalg.norm(estimate.gyro_bias))
    if estimate.accel_bias is not None:
        told["accel_bias_m_s2"] = float(np.linalg.norm(estimate.accel_bias))
    if estimate.covariance is not None:
        told["position_sigma_m"] = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[3:, 3:])[-1]))
    return told


def device_figures(devices: Sequence[DeviceHealth]) -> Figures:
    """Whether each device is connected, 1 or 0, and what was lost in its driver."""
    told: Figures = {}
    for device in devices:
        name = "device_" + _NO_NAME.sub("_", device.name)
        told[f"{name}_connected"] = int(device.connected)
        told |= {f"{name}_{_NO_NAME.sub('_', kind)}": count for kind, count in sorted(device.counts.items())}
    return told


def memory_mb() -> float | None:
    """What the process holds in memory, or None where the system does not tell."""
    try:
        return int(_STATM.read_text().split()[1]) * _PAGE_BYTES / 1e6
    except OSError:
        return None
