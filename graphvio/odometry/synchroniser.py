"""Brings IMU and framesets together: holds a frameset until the samples that cover it have come."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Generic, Protocol, TypeVar

from graphvio.arrays import Float, Int
from graphvio.backend.inertial import ImuBuffer
from graphvio.config import Config
from graphvio.measurements.events import Report
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.sensors import FrameSet, ImuSample
from graphvio.rig import Rig

_LEAST_INTERVAL_NS = 1_000_000  # between framesets: less is of one instant, and no motion can be told from it
_SILENT_WAITS = 2.0  # an IMU so far behind is not waited for until it goes on
_SUSPICIOUS_JUMP_NS = 5_000_000_000


class HasStamp(Protocol):
    """Anything that has a time."""

    @property
    def stamp_ns(self) -> int:
        """Of one clock."""


Stamped = TypeVar("Stamped", bound=HasStamp)


class Synchroniser:
    """Framesets in time order, each with the IMU up to its instant.

    Args:
        rig: tells the number of pairs, whether there is an IMU, and its time offset.
        config: tells how long things are waited for.
        report: is told what had to be left out.
    """

    def __init__(self, rig: Rig, config: Config, report: Report) -> None:
        self._pairs = len(rig.pairs)
        self._has_imu = rig.imu is not None
        self._offset_ns = rig.imu.time_offset_ns if rig.imu is not None else 0
        self._timing = config.timing
        self._initialisation = config.initialisation
        self._report = report
        self._imu = ImuBuffer(config.timing.max_imu_gap_ms)
        self._held: deque[FrameSet] = deque()
        self._newest_ns: int | None = None
        self._sample_jumps: JumpGuard[ImuSample] = JumpGuard("imu_future_stamp", report)
        self._frameset_jumps: JumpGuard[FrameSet] = JumpGuard("frameset_future_stamp", report)

    def add_sample(self, sample: ImuSample) -> list[ImuSample]:
        """Take a sample of the IMU; the samples that may be used from now on, with stamps on the framesets' clock."""
        usable = []
        for confirmed in self._sample_jumps.confirm(sample):
            fault = self._imu.add(confirmed)
            if fault:
                self._report(confirmed.stamp_ns, fault, "sample left out")
            else:
                usable.append(replace(confirmed, stamp_ns=confirmed.stamp_ns - self._offset_ns))
        return usable

    def add_frameset(self, frameset: FrameSet) -> None:
        """Take a frameset; time never goes back.

        Pairs may come in framesets of their own. Less than 1 ms after a frameset that is still held, further pairs
        join it; after one that is not, and for pairs that it has already, there is no room for another state.
        """
        for confirmed in self._frameset_jumps.confirm(frameset):
            self._add(confirmed)

    def _add(self, frameset: FrameSet) -> None:
        unknown = [j for j in frameset.images if not 0 <= j < self._pairs]
        if self._newest_ns is not None and frameset.stamp_ns < self._newest_ns + _LEAST_INTERVAL_NS:
            if not unknown and self._joins(frameset):
                held = self._held[-1]
                self._held[-1] = replace(held, images={**held.images, **frameset.images})
                return
            late = frameset.stamp_ns < self._newest_ns
            kind = "frameset_backward_stamp" if late else "frameset_duplicate_stamp"
            why = "time never goes back" if late else "less than 1 ms after the one before"
            self._report(frameset.stamp_ns, kind, f"frameset left out: {why}")
            return
        if unknown:
            self._report(frameset.stamp_ns, "unknown_pair", f"pair {unknown[0]} is not in the rig: left out")
            frameset = replace(frameset, images={j: v for j, v in frameset.images.items() if j not in unknown})
        self._newest_ns = frameset.stamp_ns
        self._held.append(frameset)

    def _joins(self, frameset: FrameSet) -> bool:
        """Whether a frameset is of the instant of the newest one, which is held, and brings other pairs."""
        return (
            bool(self._held)
            and abs(frameset.stamp_ns - self._held[-1].stamp_ns) < _LEAST_INTERVAL_NS
            and not self._held[-1].images.keys() & frameset.images.keys()
        )

    def next_due(self, *, started: bool) -> FrameSet | None:
        """The oldest held frameset if it need wait no longer; the first one waits for samples to start from."""
        if not self._held or not self._is_due(self._held[0], started):
            return None
        return self._held.popleft()

    @property
    def held_ns(self) -> int | None:
        """Stamp of the oldest held frameset, or None."""
        return self._held[0].stamp_ns if self._held else None

    def next_held(self) -> FrameSet | None:
        """The oldest held frameset, due or not, or None."""
        return self._held.popleft() if self._held else None

    def interval(self, start_ns: int, end_ns: int) -> ImuInterval | None:
        """The IMU between two framesets' stamps, or None where it does not cover them."""
        return self._imu.interval(start_ns + self._offset_ns, end_ns + self._offset_ns)

    def samples_since(self, stamp_ns: int) -> tuple[Int, Float]:
        """The IMU from a frameset's stamp on, stamps on the framesets' clock; see `ImuBuffer.since`."""
        stamps, values = self._imu.since(stamp_ns + self._offset_ns)
        return stamps - self._offset_ns, values

    def initial_interval(self, stamp_ns: int) -> tuple[ImuInterval, float] | None:
        """The IMU around a frameset, and the frameset's place in it in seconds, once it is long enough."""
        at_ns = stamp_ns + self._offset_ns
        window_ns, least_ns = (
            round(s * 1e9) for s in (self._initialisation.window_s, self._initialisation.min_window_s)
        )
        if not self._has_imu or not self._imu.covers(at_ns):
            return None
        for end_ns in (at_ns, at_ns + least_ns):
            found = self._imu.segment(at_ns - window_ns, end_ns)
            if found is not None and found[0].steps_s.sum() >= 0.95e-9 * least_ns:
                return found[0], (at_ns - found[1]) * 1e-9
        return None

    def shift_imu(self, seconds: float) -> None:
        """From now on the IMU's stamps are later than the framesets' by so much more than was thought."""
        self._offset_ns += round(seconds * 1e9)

    @property
    def time_offset_s(self) -> float:
        """Add it to a frameset's stamp to get the IMU's stamp of the same instant."""
        return self._offset_ns * 1e-9

    def precedes_imu(self, stamp_ns: int) -> bool:
        """Whether the first sample of the IMU has not come yet, or is later than a frameset."""
        if not self._has_imu:
            return False
        return self._imu.oldest_ns is None or stamp_ns + self._offset_ns < self._imu.oldest_ns

    def forget_before(self, stamp_ns: int) -> None:
        """Drop samples that are older than a start at this frameset's stamp would need."""
        self._imu.discard_before(stamp_ns + self._offset_ns - round(self._initialisation.window_s * 1e9))

    def _is_due(self, frameset: FrameSet, started: bool) -> bool:
        if not self._has_imu or self._imu.oldest_ns is None:
            return True
        assert self._newest_ns is not None
        waited_ns = self._newest_ns - frameset.stamp_ns
        if not started:
            if self.precedes_imu(frameset.stamp_ns):
                return True
            enough = self.initial_interval(frameset.stamp_ns) is not None
            return enough or waited_ns > 2.0 * self._initialisation.min_window_s * 1e9
        at_ns, newest_ns = frameset.stamp_ns + self._offset_ns, self._imu.newest_ns
        if newest_ns is None or newest_ns >= at_ns:
            return True
        longest_ns = self._timing.max_imu_wait_ms * 1e6
        is_silent = at_ns - newest_ns > _SILENT_WAITS * longest_ns
        return is_silent or waited_ns > longest_ns


class JumpGuard(Generic[Stamped]):
    """Believes a jump of the clock only when a second stamp confirms it: one wild stamp must not stop time."""

    def __init__(self, kind: str, report: Report) -> None:
        self._kind = kind
        self._report = report
        self._newest_ns: int | None = None
        self._suspect: Stamped | None = None

    def confirm(self, measurement: Stamped) -> list[Stamped]:
        """The measurements that may be taken now, in order; far ahead is more than 5 s."""
        suspect, self._suspect = self._suspect, None
        if suspect is not None:
            if 0 < measurement.stamp_ns - suspect.stamp_ns < _SUSPICIOUS_JUMP_NS:
                self._newest_ns = measurement.stamp_ns
                return [suspect, measurement]
            self._leave_out(suspect)
        if self._newest_ns is not None and measurement.stamp_ns - self._newest_ns > _SUSPICIOUS_JUMP_NS:
            self._suspect = measurement
            return []
        self._newest_ns = max(measurement.stamp_ns, self._newest_ns or measurement.stamp_ns)
        return [measurement]

    def end(self) -> None:
        """Nothing more will come, so what was not confirmed is left out."""
        suspect, self._suspect = self._suspect, None
        if suspect is not None:
            self._leave_out(suspect)

    def _leave_out(self, suspect: Stamped) -> None:
        self._report(suspect.stamp_ns, self._kind, "left out: far ahead of the stamps before and after it")
