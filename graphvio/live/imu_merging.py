"""Merging of a gyro and an accelerometer that have different rates into samples of one IMU."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from operator import itemgetter

from graphvio.arrays import Float
from graphvio.live.devices import Counts
from graphvio.measurements.readings import ImuReading

_MAX_GAP_NS = 100_000_000
_MAX_WAITING = 256
_ACCELS_KEPT = 32


class AccelOntoGyro:
    """Interpolates the acceleration linearly at the gyro's stamps.

    A gyro reading thus waits for the next acceleration: 4 to 16 ms with accelerometers of 250 to 63 Hz. The two sensors
    may call from different threads. Gyro readings without accelerations on both sides, 100 ms apart at most, are
    dropped and counted.

    Args:
        hand_over: takes the samples.
        counts: counts losses as ``imu_unpaired`` and ``imu_out_of_order``.
    """

    def __init__(self, hand_over: Callable[[ImuReading], None], counts: Counts) -> None:
        self._counts = counts
        self._hand_over = hand_over
        self._lock = threading.Lock()
        self._waiting: deque[ImuReading] = deque()
        self._newest_gyro_ns: int | None = None
        self._accels: deque[tuple[int, Float]] = deque(maxlen=_ACCELS_KEPT)

    def add_gyro(self, reading: ImuReading) -> None:
        """Add a gyro reading, whose ``linear_acceleration`` is not read; a repeated stamp is ignored."""
        with self._lock:
            if self._newest_gyro_ns is not None and reading.stamp_ns <= self._newest_gyro_ns:
                self._counts.add("imu_out_of_order", reading.stamp_ns < self._newest_gyro_ns)
                return
            self._newest_gyro_ns = reading.stamp_ns
            self._waiting.append(reading)
            if len(self._waiting) > _MAX_WAITING:
                self._waiting.popleft()
                self._counts.add("imu_unpaired")
            self._hand_over_ready()

    def add_accel(self, stamp_ns: int, acceleration: Float) -> None:
        """Add an acceleration (3,) in body, m/s^2; a repeated stamp is ignored."""
        with self._lock:
            if self._accels and stamp_ns <= self._accels[-1][0]:
                self._counts.add("imu_out_of_order", stamp_ns < self._accels[-1][0])
                return
            self._accels.append((stamp_ns, acceleration))
            self._hand_over_ready()

    def _hand_over_ready(self) -> None:
        while self._waiting and self._accels and self._waiting[0].stamp_ns <= self._accels[-1][0]:
            gyro = self._waiting.popleft()
            acceleration = self._at(gyro.stamp_ns)
            if acceleration is None:
                self._counts.add("imu_unpaired")
            else:
                self._hand_over(replace(gyro, linear_acceleration=acceleration))

    def _at(self, stamp_ns: int) -> Float | None:
        index = bisect_left(self._accels, stamp_ns, key=itemgetter(0))
        after_ns, after = self._accels[index]
        if after_ns == stamp_ns:
            return after
        if index == 0:
            return None
        before_ns, before = self._accels[index - 1]
        if after_ns - before_ns > _MAX_GAP_NS:
            return None
        share = (stamp_ns - before_ns) / (after_ns - before_ns)
        return (1.0 - share) * before + share * after
