"""Samples of the IMU in the order of their stamps: some links, such as a network, let one overtake another."""

from __future__ import annotations

from collections import deque
from heapq import heappop, heappush

from graphvio.measurements.sensors import ImuSample

_MISSING_PERIODS = 1.5  # between samples: something is missing, or late
_PERIODS = 50  # whose mean is the usual one, once
_LEAST_STEPS = 8  # are known
_MOST_HELD = 1000


class SampleOrder:
    """Holds samples back only where one is missing before them, so that nothing waits as long as none overtakes.

    Args:
        max_wait_ms: so long the missing one is waited for, by the stamps of those that come.
        rate_hz: of the samples, as far as it is known before they come.
    """

    def __init__(self, max_wait_ms: float, rate_hz: float) -> None:
        self._max_wait_ns = round(1e6 * max_wait_ms)
        self._nominal_ns = 1e9 / rate_hz
        self._held: list[tuple[int, int, ImuSample]] = []
        self._came = 0
        self._given_ns: int | None = None
        self._newest_ns: int | None = None
        self._steps_ns: deque[int] = deque(maxlen=_PERIODS)

    def add(self, sample: ImuSample) -> list[ImuSample]:
        """Take a sample; those that may go on, in order. One that is older than those that went on goes on, too: the
        odometry tells of it."""
        if self._given_ns is not None and sample.stamp_ns <= self._given_ns:
            return [sample]
        self._came += 1
        heappush(self._held, (sample.stamp_ns, self._came, sample))
        self._newest_ns = sample.stamp_ns if self._newest_ns is None else max(self._newest_ns, sample.stamp_ns)
        given = []
        while self._held and self._may_go_on(self._held[0][0]):
            given.append(heappop(self._held)[2])
            if self._given_ns is not None:
                self._steps_ns.append(given[-1].stamp_ns - self._given_ns)
            self._given_ns = given[-1].stamp_ns
        return given

    def flush(self) -> list[ImuSample]:
        """All that is held."""
        held, self._held = self._held, []
        return [sample for _, _, sample in sorted(held, key=lambda each: each[:2])]

    def _may_go_on(self, stamp_ns: int) -> bool:
        assert self._newest_ns is not None
        if self._given_ns is None or len(self._held) > _MOST_HELD:
            return True
        steps = self._steps_ns
        period_ns = self._nominal_ns if len(steps) < _LEAST_STEPS else sum(steps) / len(steps)
        follows = stamp_ns - self._given_ns < _MISSING_PERIODS * period_ns
        return follows or self._newest_ns - stamp_ns >= self._max_wait_ns
