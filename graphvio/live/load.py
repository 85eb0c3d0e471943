"""Control of the load when the odometry is slower than real time: what is given up, and in which order.

First fewer corners are tracked. Then old framesets are skipped if a newer one waits. IMU samples are never given up.
"""

from __future__ import annotations

_SHARES = (1.0, 0.7, 0.5, 0.35)
_LATE = 0.5  # share of the latency's limit from which framesets count as late
# shares of the time between framesets: if work takes more than _BUSY, fewer corners are tracked; if with more corners
# it would still take less than _IDLE, more are
_BUSY, _IDLE = 0.85, 0.7
_IDLE_NS = 2_000_000_000  # idle time before more corners are tracked again
_MIN_FRAMESETS = 5  # between changes, so that the effect of the last change shows
_DEVIATIONS = 2.5  # in mean absolute deviations, equal to two standard deviations
_NEWEST_SHARE = 0.1  # weight of the newest value in running means


class LoadControl:
    """Decides how many corners are tracked and which framesets are skipped, only from the times that it is given."""

    def __init__(self, max_latency_ms: float) -> None:
        self._limit_ms = max_latency_ms
        self._level = 0
        self._waited_ms = 0.0  # running mean, as the three below
        self._deviation_ms = 0.0  # mean absolute deviation of the work from its mean
        self._work_ms: float | None = None
        self._interval_ms: float | None = None  # interval between stamps
        self._last_ns: int | None = None
        self._since_change = 0
        self._idle_since_ns: int | None = None

    @property
    def corner_share(self) -> float:
        """Share of the configured number of corners."""
        return _SHARES[self._level]

    @property
    def patience_ms(self) -> float:
        """Longest time after a frameset's arrival at which the work on it can begin and still end in time."""
        return max(self._limit_ms - self._likely_ms, 0.0)

    def must_skip(self, waited_ms: float, is_newest: bool) -> bool:
        """Decide whether a frameset is skipped, because it would be late and a newer one waits.

        As long as the number of corners can be lowered, that is done instead, and only a frameset that is late already
        is skipped.

        Args:
            waited_ms: time since the frameset's arrival.
            is_newest: whether no newer frameset waits.
        """
        if is_newest or waited_ms + self._likely_ms <= self._limit_ms:
            return False
        if self._level < len(_SHARES) - 1:
            self._change(1)
            return waited_ms > self._limit_ms
        return True

    def add(self, stamp_ns: int, waited_ms: float, work_ms: float) -> None:
        """Add the times of a frameset that was processed, and adapt the share of corners.

        Args:
            stamp_ns: stamp of the frameset.
            waited_ms: time from its arrival until the work began.
            work_ms: time that the work took.
        """
        if self._last_ns is not None:
            self._interval_ms = _mean(self._interval_ms, 1e-6 * (stamp_ns - self._last_ns))
        self._last_ns = stamp_ns
        self._waited_ms = _mean(self._waited_ms, waited_ms)
        self._deviation_ms = _mean(self._deviation_ms, abs(work_ms - (self._work_ms or work_ms)))
        self._work_ms = _mean(self._work_ms, work_ms)
        self._since_change += 1
        if self._since_change < _MIN_FRAMESETS or self._interval_ms is None:
            return
        share = self._work_ms / max(self._interval_ms, 1e-3)
        late = self._waited_ms + self._work_ms > _LATE * self._limit_ms
        higher = _SHARES[max(self._level - 1, 0)] / _SHARES[self._level]
        if share * higher >= _IDLE or late:
            self._idle_since_ns = None
        elif self._idle_since_ns is None:
            self._idle_since_ns = stamp_ns
        if (share > _BUSY or late) and self._level < len(_SHARES) - 1:
            self._change(1)
        elif self._level and self._idle_since_ns is not None and stamp_ns - self._idle_since_ns > _IDLE_NS:
            self._change(-1)

    @property
    def _likely_ms(self) -> float:
        """Time that the work on a frameset will hardly exceed."""
        return (self._work_ms or 0.0) + _DEVIATIONS * self._deviation_ms

    def _change(self, by: int) -> None:
        self._level += by
        self._since_change = 0
        self._idle_since_ns = None
        if self._work_ms is not None:
            self._work_ms *= _SHARES[self._level] / _SHARES[self._level - by]


def _mean(before: float | None, newest: float) -> float:
    return newest if before is None else before + _NEWEST_SHARE * (newest - before)
