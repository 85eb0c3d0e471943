"""Synchronisation of IMU and framesets: a frameset is held until the IMU samples that cover it have come."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.backend.inertial import ImuBuffer, MeanReadings
from graphvio.config import Config
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.sensors import FrameSet, ImuSample
from graphvio.odometry.spike_filter import SpikeFilter
from graphvio.odometry.stamp_jitter import StampJitter
from graphvio.rig import Rig
from graphvio.self_calibration.imu_correction import ImuCorrection

_KEPT_NS = 6_000_000_000  # IMU samples of this time are kept for `Synchroniser.mean_readings`
_MIN_INTERVAL_NS = 1_000_000  # framesets closer than this belong to one instant
_MAX_SILENT_WAITS = 2.0  # multiple of the longest wait: an IMU farther behind is not waited for
_MAX_JUMP_NS = 5_000_000_000
_MIN_COVERED = 0.95  # share of the time for an initialisation: samples may be missing at its ends


class HasStamp(Protocol):
    """An object with a stamp."""

    @property
    def stamp_ns(self) -> int:
        """Stamp in nanoseconds."""


Stamped = TypeVar("Stamped", bound=HasStamp)


class Synchroniser:
    """Holds framesets in time order until the IMU covers each up to its instant, or a rolling shutter's last line.

    Args:
        rig: The rig, with its groups of cameras, and the time offset of its IMU if there is one.
        config: Configuration, with the times for which framesets wait for the IMU.
        report: Receives an event for each measurement that is left out.

    Attributes:
        imu_correction: Correction that is applied to all readings that are returned from now on.
    """

    def __init__(self, rig: Rig, config: Config, report: Report) -> None:
        self._n_groups = len(rig.groups)
        self._has_imu = rig.imu is not None
        self._offset_ns = rig.imu.time_offset_ns if rig.imu is not None else 0
        self._nominal_ns = self._offset_ns
        self._clock_ns = 0  # subtracted from the stamps of the IMU's samples
        self._lateness_ns: dict[int, int] = {}  # group -> time by which its stamps are late
        self._instants_ns: dict[int, int] = {}  # stamp of a frameset -> instant of its images, if different
        self._newest_instant_ns: int | None = None
        self._readout_ns = max(camera.readout_ns for camera in rig.cameras)
        self._timing = config.timing
        self._initialisation = config.initialisation
        self._report = report
        self.imu_correction = ImuCorrection()
        self._imu = ImuBuffer(config.timing.max_imu_gap_ms)
        self._held: deque[FrameSet] = deque()
        self._newest_ns: int | None = None
        self._jitter = StampJitter()
        self._spikes = SpikeFilter(report)
        self._sample_jumps: StampJumpFilter[ImuSample] = StampJumpFilter(EventKind.IMU_FUTURE_STAMP, report)
        self._frameset_jumps: StampJumpFilter[FrameSet] = StampJumpFilter(EventKind.FRAMESET_FUTURE_STAMP, report)

    def add_sample(self, sample: ImuSample) -> list[ImuSample]:
        """Add an IMU sample, and return those that are usable now; only their stamps are corrected for a clock jump."""
        if self._clock_ns:
            sample = replace(sample, stamp_ns=sample.stamp_ns - self._clock_ns)
        passed = [each for confirmed in self._sample_jumps.confirm(sample) for each in self._spikes.confirm(confirmed)]
        return self._usable(passed)

    def last_samples(self) -> list[ImuSample]:
        """Return the samples that the spike filter still holds, when no other sample follows."""
        return self._usable(self._spikes.end())

    def _usable(self, samples: list[ImuSample]) -> list[ImuSample]:
        """Add samples to the buffer, and return those without a fault."""
        usable = []
        for sample in samples:
            fault = self._imu.add(sample)
            if fault:
                self._report(sample.stamp_ns, fault, "sample left out")
            else:
                usable.append(sample)
        return usable

    def corrected(self, sample: ImuSample) -> tuple[int, Float]:
        """Return a usable sample's stamp on the framesets' clock, and its corrected readings (6,)."""
        values = self.imu_correction.applied(np.concatenate([sample.angular_velocity, sample.linear_acceleration]))
        return sample.stamp_ns - self._offset_ns, values

    def add_frameset(self, frameset: FrameSet) -> None:
        """Add a frameset to those that are held for the IMU; it has to be newer than the previous ones.

        Pairs may come in separate framesets: one of other pairs, less than 1 ms after a frameset that is still held, is
        merged with it. A frameset so soon after one that has been processed, or after one with the same pairs, is left
        out.
        """
        for confirmed in self._frameset_jumps.confirm(frameset):
            self._add(confirmed)

    def _add(self, frameset: FrameSet) -> None:
        unknown = [j for j in frameset.images if not 0 <= j < self._n_groups]
        if self._newest_ns is not None and frameset.stamp_ns < self._newest_ns + _MIN_INTERVAL_NS:
            if not unknown and self._joins(frameset):
                held = self._held[-1]
                self._held[-1] = replace(
                    held, images={**held.images, **frameset.images}, masks={**held.masks, **frameset.masks}
                )
                return
            late = frameset.stamp_ns < self._newest_ns
            kind = EventKind.FRAMESET_BACKWARD_STAMP if late else EventKind.FRAMESET_DUPLICATE_STAMP
            why = "older than the one before" if late else "less than 1 ms after the one before"
            self._report(frameset.stamp_ns, kind, f"frameset left out: {why}")
            return
        if unknown:
            self._report(frameset.stamp_ns, EventKind.UNKNOWN_PAIR, f"pair {unknown[0]} is not in the rig: left out")
            frameset = replace(frameset, images={j: v for j, v in frameset.images.items() if j not in unknown})
        self._newest_ns = frameset.stamp_ns
        self._held.append(frameset)

    def _joins(self, frameset: FrameSet) -> bool:
        """Whether a frameset has other pairs of the same instant as the newest frameset, which is still held."""
        return (
            bool(self._held)
            and abs(frameset.stamp_ns - self._held[-1].stamp_ns) < _MIN_INTERVAL_NS
            and not self._held[-1].images.keys() & frameset.images.keys()
        )

    def next_due(self, *, initialised: bool) -> FrameSet | None:
        """Return the oldest held frameset if it is due; the first one waits for IMU samples to initialise from."""
        if not self._held or not self._is_due(self._held[0], initialised):
            return None
        return self._taken()

    @property
    def held_ns(self) -> int | None:
        """Stamp of the oldest held frameset, or None."""
        return self._held[0].stamp_ns if self._held else None

    def next_held(self) -> FrameSet | None:
        """Return the oldest held frameset, due or not, or None."""
        return self._taken() if self._held else None

    def _taken(self) -> FrameSet:
        frameset = self._held.popleft()
        stamp_ns, instant_ns = frameset.stamp_ns, self._expected_instant_ns(frameset)
        if self._newest_instant_ns is not None:  # framesets stay in the order of their stamps
            instant_ns = max(instant_ns, self._newest_instant_ns + _MIN_INTERVAL_NS)
        self._newest_instant_ns = instant_ns
        if instant_ns != stamp_ns:
            self._instants_ns[stamp_ns] = instant_ns
        self._jitter.add(stamp_ns, min(frameset.images, default=0))
        return frameset

    def _expected_instant_ns(self, frameset: FrameSet) -> int:
        """Return the instant at which a frameset's images were taken, on the clock of the first group."""
        group = next(iter(frameset.images)) if len(frameset.images) == 1 else -1
        return frameset.stamp_ns - self._lateness_ns.get(group, 0)

    def set_lateness(self, group: int, seconds: float) -> None:
        """Set the time by which stamps of a group's separate framesets are late, for all processed from now on."""
        self._lateness_ns[group] = round(seconds * 1e9)

    def instant_ns(self, stamp_ns: int) -> int:
        """Return the instant at which a frameset's images were taken: its stamp, corrected as by `set_lateness`."""
        return self._instants_ns.get(stamp_ns, stamp_ns)

    def stamp_ns(self, instant_ns: int) -> int:
        """Return the stamp of a recent frameset whose images were taken at an instant; the inverse of `instant_ns`."""
        return next((stamp_ns for stamp_ns, at_ns in self._instants_ns.items() if at_ns == instant_ns), instant_ns)

    def finish(self) -> None:
        """Leave out the measurements that were not confirmed, as no other follows."""
        self._sample_jumps.end()
        self._frameset_jumps.end()

    def interval(self, start_ns: int, end_ns: int) -> ImuInterval | None:
        """Return the IMU readings between two framesets, given by their stamps, or None where samples are missing."""
        return self._interval(self.instant_ns(start_ns) + self._offset_ns, self.instant_ns(end_ns) + self._offset_ns)

    def interval_after(self, stamp_ns: int, duration_ns: int) -> ImuInterval | None:
        """Return the IMU readings for a duration after a frameset, or None where they do not cover it."""
        start_ns = self.instant_ns(stamp_ns) + self._offset_ns
        return self._interval(start_ns, start_ns + duration_ns)

    def nominal_interval(self, start_ns: int, end_ns: int) -> ImuInterval | None:
        """Return the IMU readings between two stamps with the rig's time offset, without corrections of the clocks."""
        return self._interval(start_ns + self._nominal_ns, end_ns + self._nominal_ns)

    def _interval(self, start_ns: int, end_ns: int) -> ImuInterval | None:
        """Return the corrected readings between two stamps of the IMU, or None where they do not cover the interval."""
        interval = self._imu.interval(start_ns, end_ns)
        if interval is None:
            return None
        return self.imu_correction.applied_to(replace(interval, stamp_sigma_s=self.stamp_sigma_s))

    def samples_since(self, stamp_ns: int) -> tuple[Int, Float]:
        """Return the IMU readings from a frameset on, with stamps on the framesets' clock; see `ImuBuffer.since`."""
        stamps, values = self._imu.since(self.instant_ns(stamp_ns) + self._offset_ns)
        return stamps - self._offset_ns, self.imu_correction.applied(values)

    def initial_interval(self, stamp_ns: int) -> tuple[ImuInterval, float] | None:
        """Return the IMU readings around a frameset, once they cover enough time, and the frameset's time in them, s.

        Later samples are left out, so that the result does not depend on how early samples come.
        """
        at_ns = self.instant_ns(stamp_ns) + self._offset_ns
        window_ns, min_ns = (round(s * 1e9) for s in (self._initialisation.window_s, self._initialisation.min_window_s))
        min_covered_s = _MIN_COVERED * 1e-9 * min_ns
        if not self._has_imu or not self._imu.covers(at_ns):
            return None
        for with_later_samples in (False, True):
            found = self._imu.segment(at_ns - window_ns, at_ns + min_ns if with_later_samples else at_ns)
            if found is not None and found[0].steps_s.sum() >= min_covered_s:
                interval, n = found[0], len(found[0].steps_s)
                if with_later_samples:
                    n = next(k for k in range(1, n + 1) if interval.steps_s[:k].sum() >= min_covered_s)
                interval = ImuInterval(
                    interval.steps_s[:n], interval.angular_velocity[:n], interval.linear_acceleration[:n]
                )
                return self.imu_correction.applied_to(interval), (at_ns - found[1]) * 1e-9
        return None

    def mean_readings(self) -> MeanReadings:
        """Return the means of the samples in the buffer, uncorrected, with stamps on the framesets' clock."""
        return self._imu.means(self._offset_ns)

    def correct_imu_clock(self, late_s: float) -> None:
        """Correct a jump of the IMU's clock: later samples are stamped ``late_s`` earlier, those in the buffer dropped.

        In contrast to `add_to_time_offset`, this is for a clock that has jumped, or is wrong by more than a calibration
        corrects.
        """
        self._clock_ns += round(late_s * 1e9)
        self._imu = ImuBuffer(self._timing.max_imu_gap_ms)
        self._sample_jumps = StampJumpFilter(EventKind.IMU_FUTURE_STAMP, self._report)
        self._spikes = SpikeFilter(self._report)

    def add_to_time_offset(self, seconds: float) -> None:
        """Add ``seconds`` to the offset of the IMU's stamps from the framesets'; the samples in the buffer are kept."""
        self._offset_ns += round(seconds * 1e9)

    @property
    def stamp_sigma_s(self) -> float:
        """Standard deviation of the framesets' stamps."""
        return self._jitter.sigma_s

    @property
    def time_offset_s(self) -> float:
        """The IMU's stamp less the framesets' stamp of the same instant."""
        return self._offset_ns * 1e-9

    def precedes_imu(self, stamp_ns: int) -> bool:
        """Whether a frameset is before the first IMU sample, or none has come yet."""
        if not self._has_imu:
            return False
        return self._imu.oldest_ns is None or stamp_ns + self._offset_ns < self._imu.oldest_ns

    def forget_before(self, stamp_ns: int) -> None:
        """Drop samples that are older than an initialisation at this frameset's stamp would need."""
        kept_ns = max(round(self._initialisation.window_s * 1e9), _KEPT_NS)
        self._imu.discard_before(stamp_ns + self._offset_ns - kept_ns)
        self._instants_ns = {ns: at for ns, at in self._instants_ns.items() if ns > stamp_ns - kept_ns}

    def _is_due(self, frameset: FrameSet, initialised: bool) -> bool:
        if not self._has_imu or self._imu.oldest_ns is None:
            return True
        assert self._newest_ns is not None
        waited_ns = self._newest_ns - frameset.stamp_ns
        if not initialised:
            if self.precedes_imu(frameset.stamp_ns):
                return True
            enough = self.initial_interval(frameset.stamp_ns) is not None
            if self._readout_ns:  # the readout of its lines has to be covered, too
                enough &= self.interval_after(frameset.stamp_ns, self._readout_ns) is not None
            return enough or waited_ns > 2.0 * self._initialisation.min_window_s * 1e9
        at_ns, newest_ns = self._expected_instant_ns(frameset) + self._offset_ns, self._imu.newest_ns
        if newest_ns is None or newest_ns >= at_ns + self._readout_ns:
            return True
        longest_ns = self._timing.max_imu_wait_ms * 1e6
        is_silent = at_ns - newest_ns > _MAX_SILENT_WAITS * longest_ns
        return is_silent or waited_ns > longest_ns


class StampJumpFilter(Generic[Stamped]):
    """Accepts a jump of the clock only when a second stamp confirms it; leaves out a single wrong stamp.

    Args:
        kind: Kind of the event for a measurement that is left out.
        report: Receives events.
    """

    def __init__(self, kind: str, report: Report) -> None:
        self._kind = kind
        self._report = report
        self._newest_ns: int | None = None
        self._suspect: Stamped | None = None

    def confirm(self, measurement: Stamped) -> list[Stamped]:
        """Return the measurements that may be used now, in order; a jump is more than 5 s."""
        suspect, self._suspect = self._suspect, None
        if suspect is not None:
            if 0 < measurement.stamp_ns - suspect.stamp_ns < _MAX_JUMP_NS:
                self._newest_ns = measurement.stamp_ns
                return [suspect, measurement]
            self._leave_out(suspect)
        if self._newest_ns is not None and measurement.stamp_ns - self._newest_ns > _MAX_JUMP_NS:
            self._suspect = measurement
            return []
        self._newest_ns = max(measurement.stamp_ns, self._newest_ns or measurement.stamp_ns)
        return [measurement]

    def end(self) -> None:
        """Leave out the measurement that was not confirmed, as nothing follows."""
        suspect, self._suspect = self._suspect, None
        if suspect is not None:
            self._leave_out(suspect)

    def _leave_out(self, suspect: Stamped) -> None:
        self._report(suspect.stamp_ns, self._kind, "left out: more than 5 s ahead of the stamps before and after it")
