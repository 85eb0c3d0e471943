"""A buffer of IMU samples that checks them, and returns their readings over intervals."""

from __future__ import annotations

from math import isfinite
from typing import Literal

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.kernels import kernel, put
from graphvio.measurements.events import EventKind
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.imu_noise import shown_noise
from graphvio.measurements.sensors import ImuSample

_MAX_RATE = 100.0  # rad/s and m/s^2: beyond what any inertial sensor for this use can read
_MAX_FORCE = 1000.0
NO_SAMPLES = (np.empty(0, dtype=np.int64), np.empty((0, 6)))
"""No stamps (0,) and no values (0, 6)."""
_STUCK_NS = 250_000_000  # no working axis repeats one value for so long while others change
_HISTORY = 100  # samples over which an axis's repetitions are averaged
_MIN_CHANGE = 0.02  # an axis that changes in a smaller share of the samples has no noise to go by
_MAX_CHANGE = 0.95  # share of the samples in which an axis changes that is assumed at most
_MIN_OTHERS_CHANGE = 0.8  # share of the samples in which another axis of the sensor must go on changing
_MAX_FROZEN = 5  # times that all axes may repeat their values; some drivers deliver each sample twice
_MIN_LIVE_CHANGE = 0.5  # share of the samples in which each axis must have changed before
_MIN_LOG_CHANCE = np.log(1e-9)  # log probability that a working axis repeats its value so often
_MIN_MOTION = np.repeat([0.2, 1.0], 3)  # range of an axis's values that counts as motion, rad/s and m/s^2
_KEPT_NS = 60_000_000_000  # no frameset arrives later than this after the samples of its interval
_ROOM = 1024  # samples that the buffer has room for at first
_NOISE_SAMPLES = 50  # number of samples from which the noise of an interval is estimated


def value_fault(sample: ImuSample) -> str:
    """Return the kind of fault of a sample with values that no sensor can read, or an empty string."""
    rate, force = sample.angular_velocity.tolist(), sample.linear_acceleration.tolist()  # numpy is slow for three
    if not all(map(isfinite, (*rate, *force))):
        return EventKind.IMU_NOT_FINITE
    if not any(force):  # not even free fall gives exact zeros
        return EventKind.IMU_STUCK
    if max(map(abs, rate)) > _MAX_RATE or max(map(abs, force)) > _MAX_FORCE:
        return EventKind.IMU_OUT_OF_RANGE
    return ""


class ImuBuffer:
    """Buffer of IMU samples in time order; `add` leaves out unusable ones and returns the kind of their fault.

    Args:
        max_gap_ms: Longer intervals between samples are gaps.
    """

    def __init__(self, max_gap_ms: float) -> None:
        self._stamps = np.empty(_ROOM, dtype=np.int64)
        self._values = np.empty((_ROOM, 6))  # angular velocity, linear acceleration
        self._first, self._end = 0, 0  # the samples that are kept
        self._max_gap_ns = round(max_gap_ms * 1e6)
        self._stuck = _StuckAxes()

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest sample, or None."""
        return int(self._stamps[self._first]) if self._end > self._first else None

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample, or None."""
        return int(self._stamps[self._end - 1]) if self._end > self._first else None

    def add(self, sample: ImuSample) -> str:
        """Add a sample, and return the kind of its fault if it is unusable, or an empty string."""
        fault = value_fault(sample)
        if fault:
            return fault
        newest_ns = self.newest_ns
        if newest_ns is not None and sample.stamp_ns <= newest_ns:
            return EventKind.IMU_DUPLICATE_STAMP if sample.stamp_ns == newest_ns else EventKind.IMU_BACKWARD_STAMP
        if self._stuck.shows(sample):
            return EventKind.IMU_STUCK
        if self._end == len(self._stamps):
            self._make_room()
        self._stamps[self._end] = sample.stamp_ns
        self._values[self._end, :3], self._values[self._end, 3:] = sample.angular_velocity, sample.linear_acceleration
        self._end += 1
        return ""

    def covers(self, stamp_ns: int) -> bool:
        """Whether a sample at or after an instant has been added."""
        return self._end > self._first and bool(self._stamps[self._end - 1] >= stamp_ns)

    def interval(self, start_ns: int, end_ns: int) -> ImuInterval | None:
        """Return the readings between two instants, interpolated at both ends, or None where there is a gap."""
        first = self._find(start_ns, "right") - 1
        last = self._find(end_ns, "left")
        if first < self._first or last >= self._end or end_ns <= start_ns:
            return None
        stamps = self._stamps[first : last + 1]
        if np.diff(stamps).max() > self._max_gap_ns:
            return None
        steps_s, means = _steps(stamps - start_ns, self._values[first : last + 1], end_ns - start_ns)
        recent = slice(max(min(first, last - _NOISE_SAMPLES), self._first), last + 1)
        noise = shown_noise(self._stamps[recent], self._values[recent], self._max_gap_ns)
        return ImuInterval(steps_s, means[:, :3], means[:, 3:], noise)

    def segment(self, start_ns: int, end_ns: int) -> tuple[ImuInterval, int] | None:
        """Return the longest gapless segment that ends at the newest sample between two instants.

        Returns:
            The interval and its first stamp, or None where there are fewer than two samples.
        """
        stamps = self._stamps[self._find(start_ns, "left") : self._find(end_ns, "right")]
        gaps = np.flatnonzero(np.diff(stamps) > self._max_gap_ns)
        stamps = stamps[gaps[-1] + 1 :] if len(gaps) else stamps
        interval = self.interval(int(stamps[0]), int(stamps[-1])) if len(stamps) > 1 else None
        return None if interval is None else (interval, int(stamps[0]))

    def means(self, offset_ns: int = 0) -> MeanReadings:
        """Return the means of the samples in the buffer now, with an offset subtracted from their stamps."""
        kept = slice(self._first, self._end)
        return MeanReadings(self._stamps[kept] - offset_ns, self._values[kept].copy(), self._max_gap_ns)

    def since(self, stamp_ns: int) -> tuple[Int, Float]:
        """Return the reading at an instant, interpolated, and all samples after it.

        Returns:
            Stamps (N,) and values (N, 6), angular velocity and specific force; empty where the instant is in a gap.
        """
        end = self._find(stamp_ns, "right")
        first = end - 1
        if first >= self._first and self._stamps[first] == stamp_ns:
            return self._stamps[first : self._end].copy(), self._values[first : self._end].copy()
        if first < self._first or end >= self._end or self._stamps[end] - self._stamps[first] > self._max_gap_ns:
            return NO_SAMPLES
        fraction = (stamp_ns - self._stamps[first]) / (self._stamps[end] - self._stamps[first])
        at = self._values[first] + fraction * (self._values[end] - self._values[first])
        stamps = np.concatenate([np.array([stamp_ns]), self._stamps[end : self._end]])
        return stamps, np.vstack([at, self._values[end : self._end]])

    def discard_before(self, stamp_ns: int) -> None:
        """Discard the samples that no interval from an instant on needs."""
        self._first = max(self._find(stamp_ns, "right") - 1, self._first)

    def _find(self, stamp_ns: int, side: Literal["left", "right"]) -> int:
        return self._first + int(np.searchsorted(self._stamps[self._first : self._end], stamp_ns, side))

    def _make_room(self) -> None:
        """Move the samples to the front of a new array, twice as large if they fill more than half of the old one.

        Samples older than a minute are discarded: an IMU without framesets must not fill the memory.
        """
        self.discard_before(int(self._stamps[self._end - 1]) - _KEPT_NS)
        kept = slice(self._first, self._end)
        stamps, values = self._stamps[kept], self._values[kept]
        room = len(self._stamps) * (2 if 2 * len(stamps) > len(self._stamps) else 1)
        self._stamps, self._values = np.empty(room, dtype=np.int64), np.empty((room, 6))
        self._stamps[: len(stamps)], self._values[: len(stamps)] = stamps, values
        self._first, self._end = 0, len(stamps)


class MeanReadings:
    """Mean readings of an IMU in intervals, from integrals over all of its samples.

    Args:
        stamps_ns: (N,) increasing stamps of the samples.
        values: (N, 6) angular velocities and specific forces.
        max_gap_ns: Longer intervals between samples are gaps.
    """

    def __init__(self, stamps_ns: Int, values: Float, max_gap_ns: int) -> None:
        self._stamps, self._values = stamps_ns, values
        self._steps_ns = np.diff(stamps_ns)
        means = 0.5 * (values[1:] + values[:-1])
        self._sums = np.vstack([np.zeros(6), np.cumsum(means * self._steps_ns[:, None], axis=0)])  # up to each sample
        self._gaps = np.concatenate([[0], np.cumsum(self._steps_ns > max_gap_ns)])

    def between(self, begins_ns: Int, ends_ns: Int) -> Float:
        """Return the mean readings (K, 6) in K intervals between stamps, NaN where samples do not cover one."""
        if len(self._stamps) < 2:
            return np.full((len(begins_ns), 6), np.nan)
        first, last = self._step_at(begins_ns), self._step_at(ends_ns)
        is_covered = (begins_ns >= self._stamps[0]) & (ends_ns <= self._stamps[-1])
        is_covered &= self._gaps[first] == self._gaps[last + 1]
        total = self._integral(last, ends_ns) - self._integral(first, begins_ns)
        return np.where(is_covered[:, None], total / (ends_ns - begins_ns)[:, None], np.nan)

    def _step_at(self, stamps_ns: Int) -> Int:
        return np.clip(np.searchsorted(self._stamps, stamps_ns, "right") - 1, 0, len(self._stamps) - 2)

    def _integral(self, k: Int, stamps_ns: Int) -> Float:
        """Return the integrals up to stamps within the steps ``k``, in which the readings change linearly."""
        after_ns = (stamps_ns - self._stamps[k])[:, None]
        slopes = (self._values[k + 1] - self._values[k]) / self._steps_ns[k][:, None]
        return np.asarray(self._sums[k] + after_ns * (self._values[k] + 0.5 * after_ns * slopes))


class _StuckAxes:
    """Detection of axes that repeat one value while others change, as an axis does at the end of its range.

    An axis that used to change with every sample, because of its noise, is found within some samples if another axis of
    the same sensor goes on changing; so is an IMU that repeats the values of all axes. An axis that used to repeat its
    values is found once other axes have moved for a while.
    """

    def __init__(self) -> None:
        self._before = np.full(6, np.nan)
        self._low, self._high = np.zeros((2, 6, 6))  # for each axis, the range of all axes since it took its value
        self._since_ns = np.zeros(6, dtype=np.int64)  # stamp since which each axis repeats its value though others move
        self._change = np.zeros(6)  # share of the samples in which each axis changed, up to its last change
        self._repeats = np.zeros((6, 6))  # for each axis, how often each changed since it took its value; of itself,
        # how often it has repeated it

    def shows(self, sample: ImuSample) -> bool:
        """Whether a sample, the next in time, has a stuck axis."""
        now = np.concatenate([sample.angular_velocity, sample.linear_acceleration])
        stopped = _note_stops(now, self._before, self._change, self._repeats)
        since_ns = _note_repeats(
            sample.stamp_ns, now, self._before, self._low, self._high, self._since_ns, self._change > _MIN_CHANGE
        )
        return stopped or sample.stamp_ns - since_ns >= _STUCK_NS


@kernel
def _note_stops(now: Float, before: Float, change: Float, repeats: Float) -> bool:
    """Add a sample (6,), and return whether some axis repeats its value more often than noise allows."""
    stopped, all_repeat = False, change.min() > _MIN_LIVE_CHANGE
    for axis in range(6):
        if now[axis] != before[axis]:
            change[axis] *= (1.0 - 1.0 / _HISTORY) ** repeats[axis, axis]
            change[axis] += (1.0 - change[axis]) / _HISTORY
            for other in range(6):
                repeats[axis, other] = 0.0
            all_repeat = False
            continue
        for other in range(6):
            repeats[axis, other] += other == axis or now[other] != before[other]
        count, first = repeats[axis, axis], 3 * (axis // 3)
        others_live = False
        for other in range(first, first + 3):
            others_live |= other != axis and repeats[axis, other] > _MIN_OTHERS_CHANGE * count
        chance = count * np.log(1.0 - min(change[axis], _MAX_CHANGE))
        stopped |= others_live and chance < _MIN_LOG_CHANCE
        all_repeat &= count >= _MAX_FROZEN
    return stopped or all_repeat


@kernel
def _note_repeats(
    stamp_ns: int, now: Float, before: Float, low: Float, high: Float, since_ns: Int, has_lived: Bool
) -> int:
    """Add a sample (6,), and return the stamp since which some axis repeats its value though others move."""
    for axis in range(6):
        if now[axis] != before[axis]:
            put(low[axis], now)
            put(high[axis], now)
        moved = False
        for other in range(6):
            low[axis, other] = min(low[axis, other], now[other])
            high[axis, other] = max(high[axis, other], now[other])
            moved |= high[axis, other] - low[axis, other] > _MIN_MOTION[other]
        if not (moved and has_lived[axis]):
            since_ns[axis] = stamp_ns
    put(before, now)
    return int(since_ns.min())


@kernel
def _steps(stamps_ns: Int, values: Float, end_ns: int) -> tuple[Float, Float]:
    """Return the durations (N - 1,) and mean values (N - 1, 6) between samples (N,), clipped to 0 and ``end_ns``."""
    n = len(stamps_ns)
    steps_s, means = np.empty(n - 1), np.empty((n - 1, 6))
    for i in range(n - 1):
        begin_ns, until_ns = max(stamps_ns[i], 0), min(stamps_ns[i + 1], end_ns)
        whole_ns = stamps_ns[i + 1] - stamps_ns[i]
        steps_s[i] = (until_ns - begin_ns) * 1e-9
        middle = (0.5 * (begin_ns + until_ns) - stamps_ns[i]) / whole_ns
        for c in range(6):
            means[i, c] = values[i, c] + middle * (values[i + 1, c] - values[i, c])
    return steps_s, means
