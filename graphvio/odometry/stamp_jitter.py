"""Jitter of framesets' stamps, as of cameras whose images are stamped when they arrive.

Stamps of a camera that runs freely are whole periods apart. By how much they are not is how much each stamp errs, and
with it the interval over which the IMU is integrated.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Sequence

import numpy as np

from graphvio.arrays import Float

_STAMPS = 40
_MIN_STAMPS = 5
_MAX_SHARE = 0.2  # of the period: what scatters more has no period
_NORMAL_MEDIAN = 0.6745  # of the magnitude of a normal deviate


class StampJitter:
    """Estimates the standard deviation of stamps from their intervals."""

    def __init__(self) -> None:
        self._stamps: defaultdict[int, deque[int]] = defaultdict(lambda: deque(maxlen=_STAMPS))
        self._sigma_s: float | None = 0.0

    def add(self, stamp_ns: int, group: int) -> None:
        """Take the stamp of the next frameset, some of which may be missing.

        Args:
            stamp_ns: of the frameset.
            group: a pair or single camera that it has images of. Pairs that are triggered one after the other come in
                framesets of their own.
        """
        self._stamps[group].append(stamp_ns)
        self._sigma_s = None

    @property
    def sigma_s(self) -> float:
        """Standard deviation of a stamp, seconds; zero where stamps show no period."""
        if self._sigma_s is None:
            errors = [_errors_s(stamps) for stamps in self._stamps.values() if len(stamps) >= _MIN_STAMPS]
            pooled = np.abs(np.concatenate(errors)) if errors else np.zeros(1)
            self._sigma_s = float(np.median(pooled)) / (_NORMAL_MEDIAN * np.sqrt(2.0))
        return self._sigma_s


def _errors_s(stamps_ns: Sequence[int]) -> Float:
    """Return by how much intervals between stamps (N,) are not whole periods (N - 1,), zeros if there is no period."""
    intervals = 1e-9 * np.diff(np.array(stamps_ns))
    periods = np.maximum(np.round(intervals / np.quantile(intervals, 0.25)), 1.0)
    period = np.median(intervals / periods)
    errors = np.asarray(intervals - periods * period)
    return errors if np.median(np.abs(errors)) < np.sqrt(2.0) * _NORMAL_MEDIAN * _MAX_SHARE * period else 0.0 * errors
