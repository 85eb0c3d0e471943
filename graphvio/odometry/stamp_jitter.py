"""Estimation of the jitter of framesets' stamps, as of cameras whose images are stamped when they arrive.

Images of a free-running camera are taken whole periods apart. The deviation of the stamps from that is their error, and
thereby the error of the interval over which the IMU is integrated.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Sequence
from itertools import pairwise
from math import sqrt
from statistics import median

_STAMPS = 40
_MIN_STAMPS = 5
_MAX_SHARE = 0.2  # scatter as a share of the period: stamps with more have no period
_NORMAL_MEDIAN = 0.6745  # median of the magnitude of a normal deviate


class StampJitter:
    """Estimates the standard deviation of stamps from their intervals."""

    def __init__(self) -> None:
        self._stamps: defaultdict[int, deque[int]] = defaultdict(lambda: deque(maxlen=_STAMPS))
        self._sigma_s: float | None = 0.0

    def add(self, stamp_ns: int, group: int) -> None:
        """Add the stamp of the next frameset, some of which may be missing.

        Args:
            stamp_ns: stamp of the frameset.
            group: a pair or single camera of which it has images. Pairs that are triggered one after the other come in
                separate framesets.
        """
        self._stamps[group].append(stamp_ns)
        self._sigma_s = None

    @property
    def sigma_s(self) -> float:
        """Standard deviation of a stamp, seconds; zero where stamps show no period."""
        if self._sigma_s is None:
            errors = [_errors_s(stamps) for stamps in self._stamps.values() if len(stamps) >= _MIN_STAMPS]
            pooled = [abs(error) for of_group in errors for error in of_group]
            self._sigma_s = median(pooled or [0.0]) / (_NORMAL_MEDIAN * sqrt(2.0))
        return self._sigma_s


def _errors_s(stamps_ns: Sequence[int]) -> list[float]:
    """Return the deviations (N - 1,) of intervals between stamps (N,) from whole periods; zeros without a period."""
    intervals = [1e-9 * (end - begin) for begin, end in pairwise(stamps_ns)]  # numpy is slow for so few
    one = sorted(intervals)[len(intervals) // 4]  # some framesets may be missing
    periods = [max(round(interval / one), 1) for interval in intervals]
    period = median(interval / count for interval, count in zip(intervals, periods, strict=True))
    errors = [interval - count * period for interval, count in zip(intervals, periods, strict=True)]
    is_periodic = median(map(abs, errors)) < sqrt(2.0) * _NORMAL_MEDIAN * _MAX_SHARE * period
    return errors if is_periodic else [0.0] * len(errors)
