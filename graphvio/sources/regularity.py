"""How regularly the images of a camera, the samples of an IMU, or the messages of a topic come."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Int

_GAP_PERIODS = 1.5
_MIN_STAMPS = 3
_NS_PER_MS, _NS_PER_S = 1e6, 1e9


@dataclass(frozen=True)
class Regularity:
    """Intervals between stamps."""

    rate_hz: float | None  # by the median interval; None if that is zero
    jitter_ms: float  # standard deviation of the intervals without gaps
    gaps: int  # number of intervals longer than one and a half median ones
    longest_ms: float  # longest interval


def regularity(stamps_ns: Int) -> Regularity | None:
    """Measure the intervals between stamps.

    Args:
        stamps_ns: (N,) in any order, nanoseconds.

    Returns:
        The figures, or None if there are too few stamps, or all are equal.
    """
    stamps = np.sort(stamps_ns)
    if len(stamps) < _MIN_STAMPS or stamps[0] == stamps[-1]:
        return None
    steps = np.diff(stamps).astype(np.float64)
    median = float(np.median(steps))
    within = steps[steps <= _GAP_PERIODS * median]
    return Regularity(
        rate_hz=_NS_PER_S / median if median else None,
        jitter_ms=float(np.std(within)) / _NS_PER_MS,
        gaps=int(np.sum(steps > _GAP_PERIODS * median)),
        longest_ms=float(steps.max()) / _NS_PER_MS,
    )
