"""Corrections of sensors' stamps: maps of devices' clocks to the host's, and a shared clock that may be set back."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, field

from graphvio.backend.initial_state import MAX_UNBRIDGED_S
from graphvio.live.envelope import Envelope, Line
from graphvio.measurements.events import EventKind, Report

_MAX_OFFSET_NS = 500_000_000  # a stamp that is off by more is of a clock that was set or restarted
_FAST_SLEW_NS = 1_000_000_000  # time from the beginning of a map in which it is corrected by _FAST_SLEW at most
_FAST_SLEW = 0.5  # seconds per second: corrects any initial error within that time
_SLEW = 1e-3  # seconds per second, maximum correction after that time
_KNOT_INTERVAL_NS = 20_000_000
_KNOTS = 64  # for more than a second: older stamps are not mapped
_CONFIRMATIONS = 3  # number of readings that have to agree on another clock
_CONFIRMED_NS = 50_000_000  # minimum time in which they arrive, so that a burst from a queue is not enough
_CONFIRMED_PAUSE_NS = 1_000_000_000  # the same if stamps continue the previous ones, as after a pause of the host

_MAX_BACK_NS = 250_000_000  # a stamp farther behind its sensor's recent ones is of a clock that was set back
_MAX_AHEAD_NS = 100_000_000  # of one sensor's stamps relative to the others'
_GAP_NS = round((MAX_UNBRIDGED_S + 1.0) * 1e9)  # long enough that the odometry begins a new epoch
_RECENT = 3


class ClockMap:
    """Map from a device's stamps to the host's time, estimated from stamps and arrival times.

    All sensors of a device share the map. It is continuous and increasing, and once a stamp has been mapped, every
    stamp up to it always maps to the same time. Errors are corrected gradually, by a rate on top of the drift: 0.5 s/s
    at most in the first second and 1 ms/s from then on.

    The minimum delay of messages cannot be distinguished from an offset: mapped times are late by this delay.

    If a clock is off by more than 0.5 s, a new map is begun; the drift is kept, as it is that of the crystal. Three
    stamps have to agree on this over 50 ms, and are not mapped until then. Stamps that may only be late, after a pause,
    have to agree over 1 s, and are mapped as before until then.

    Args:
        name: name of the clock, for people.
        report: takes events: ``clock_restarted``, ``clock_stepped`` where the clock went forward by less and is
            followed slowly, and ``stamp_implausible`` where a stamp is not mapped.
    """

    def __init__(self, name: str, report: Report) -> None:
        self._name = name
        self._report = report
        self._envelope = Envelope()
        self._knots: deque[_Knot] = deque(maxlen=_KNOTS)
        self._origin_ns = 0  # stamp at which the map begins
        self._offset_ns = 0  # host's time at the origin minus its stamp
        self._newest = 0  # newest stamp, since the origin
        self._suspicion: _Suspicion | None = None
        self._may_have_restarted = False

    def expect_restart(self) -> None:
        """Accept, as the device was away, that the clock has restarted as soon as a single stamp shows it."""
        self._may_have_restarted = True

    def map(self, stamp_ns: int, arrival_ns: int) -> int | None:
        """Map the stamp of a message that arrived at a host time to the host's time; None if it is implausible."""
        if not self._knots:
            self._start(stamp_ns, arrival_ns)
        late_ns = arrival_ns - self._mapped(stamp_ns)
        if abs(late_ns) <= _MAX_OFFSET_NS:
            self._suspicion, self._may_have_restarted = None, False
            self._update(stamp_ns, arrival_ns)
        elif self._is_other_clock(stamp_ns, arrival_ns, late_ns):
            detail = f"clock {self._name}: {1e-9 * late_ns:+.3f} s off what it was; mapped again"
            self._report(stamp_ns, EventKind.CLOCK_RESTARTED, detail)
            self._start(stamp_ns, arrival_ns)
        elif not self._continues(stamp_ns, late_ns):
            detail = f"clock {self._name}: {1e-9 * late_ns:+.3f} s off its clock; left out"
            self._report(stamp_ns, EventKind.STAMP_IMPLAUSIBLE, detail)
            return None
        self._newest = max(self._newest, stamp_ns - self._origin_ns)
        return self._mapped(stamp_ns)

    def _mapped(self, stamp_ns: int) -> int:
        at = stamp_ns - self._origin_ns
        knot = self._knots[max(bisect_right(self._knots, at, key=lambda each: each.start) - 1, 0)]
        return stamp_ns + self._offset_ns + round(knot.delay(at))

    def _start(self, stamp_ns: int, arrival_ns: int) -> None:
        """Begin a new map, as if this message was not delayed, but later than all times that were mapped before."""
        start_ns = arrival_ns
        if self._knots:
            start_ns = max(arrival_ns, self._mapped(self._origin_ns + self._newest) + 1)
        self._origin_ns, self._offset_ns, self._newest = stamp_ns, start_ns - stamp_ns, 0
        self._envelope = Envelope(self._envelope.line.drift)
        self._knots.clear()
        self._knots.append(_Knot(0, 0.0, Line(0.0, self._envelope.line.drift)))
        self._suspicion, self._may_have_restarted = None, False
        self._update(stamp_ns, arrival_ns)

    def _update(self, stamp_ns: int, arrival_ns: int) -> None:
        has_stepped = self._envelope.add(stamp_ns - self._origin_ns, arrival_ns - stamp_ns - self._offset_ns)
        if has_stepped:
            detail = f"clock {self._name} went forward: followed, 1 ms a second"
            self._report(stamp_ns, EventKind.CLOCK_STEPPED, detail)
        last = self._knots[-1]
        newest = max(self._newest, stamp_ns - self._origin_ns)
        if self._envelope.line != last.line and newest - last.start >= _KNOT_INTERVAL_NS:
            self._knots.append(_Knot(newest, self._envelope.line.at(newest) - last.delay(newest), self._envelope.line))

    def _continues(self, stamp_ns: int, late_ns: int) -> bool:
        """Return whether a message may only be late, after a pause of the host or of the link."""
        return late_ns > 0 and stamp_ns - self._origin_ns > self._newest - _MAX_OFFSET_NS

    def _is_other_clock(self, stamp_ns: int, arrival_ns: int, late_ns: int) -> bool:
        if self._may_have_restarted:
            return True
        offset_ns = arrival_ns - stamp_ns
        if self._suspicion is None or abs(offset_ns - self._suspicion.offset_ns) > _MAX_OFFSET_NS:
            self._suspicion = _Suspicion(offset_ns, arrival_ns, 0)
        self._suspicion.count += 1
        min_ns = _CONFIRMED_PAUSE_NS if self._continues(stamp_ns, late_ns) else _CONFIRMED_NS
        return self._suspicion.count >= _CONFIRMATIONS and arrival_ns - self._suspicion.since_ns >= min_ns


@dataclass(frozen=True, slots=True)
class _Knot:
    """A part of the map, from a stamp on, in which the map approaches a line."""

    start: int  # stamp since the map's origin, ns
    error: float  # the line's delay minus the map's at this stamp, ns
    line: Line  # delay over stamp, both since the origin, ns

    def delay(self, at: int) -> float:
        """Return the delay (ns) at a stamp since the origin, which is added to the stamp and the map's offset."""
        corrected = max(_max_correction(at) - _max_correction(self.start), 0.0)
        left = max(abs(self.error) - corrected, 0.0)
        return self.line.at(at) - (left if self.error > 0.0 else -left)


def _max_correction(at: int) -> float:
    """Return by how much a map may have been corrected up to a stamp since its origin, ns."""
    return _FAST_SLEW * min(at, _FAST_SLEW_NS) + _SLEW * max(at - _FAST_SLEW_NS, 0)


@dataclass(slots=True)
class _Suspicion:
    """Consecutive readings that agree on another clock."""

    offset_ns: int  # arrival minus stamp, of the first of them
    since_ns: int  # host time at which it arrived
    count: int  # number of these readings


class ClockMaps:
    """The maps of all devices' clocks, by name; see `ClockMap`."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._maps: dict[str, ClockMap] = {}

    def map(self, clock: str, stamp_ns: int, arrival_ns: int) -> int | None:
        """See `ClockMap.map`."""
        if clock not in self._maps:
            self._maps[clock] = ClockMap(clock, self._report)
        return self._maps[clock].map(stamp_ns, arrival_ns)

    def expect_restart(self, clock: str | None) -> None:
        """See `ClockMap.expect_restart`; called for every notice that a device was lost or is back."""
        if clock in self._maps:
            self._maps[clock].expect_restart()


class SharedClock:
    """The clock of all sensors whose stamps are used unchanged, as long as it is not set back.

    A host's clock may be set back by its administrator, and that of a bag when it is played again. From then on an
    offset is added to stamps so that they continue four seconds after all earlier ones, and the odometry begins a new
    epoch. Stamps from before the change that arrive after it are late, and left out. Single outliers among the stamps
    do not count as a change.

    Args:
        report: takes events: ``clock_restarted``, and ``stamp_implausible`` where a stamp is not used.
    """

    def __init__(self, report: Report) -> None:
        self._report = report
        self._offsets_ns = [0]  # one for the beginning, and one for each time the clock was set back
        self._sensors: dict[str, _Sensor] = {}

    def map(self, sensor: str, stamp_ns: int) -> int | None:
        """Return a sensor's stamp with the offset in force, or None if it is implausible.

        A sensor's stamps have to be in order, except for a few.
        """
        latest = len(self._offsets_ns) - 1
        own = self._sensors.setdefault(sensor, _Sensor(latest))
        if own.setting < latest and stamp_ns + self._offsets_ns[latest] <= self._newest_ns(latest) + _MAX_AHEAD_NS:
            own.restart(latest)
        if own.recent_ns and stamp_ns < own.typical_ns - _MAX_BACK_NS:
            own.behind += 1
            if own.behind < _CONFIRMATIONS:
                detail = f"{sensor}: earlier than those before it; left out"
                self._report(stamp_ns, EventKind.STAMP_IMPLAUSIBLE, detail)
                return None
            self._set_back(own, sensor, stamp_ns)
        own.behind = 0
        own.recent_ns.append(stamp_ns)
        return stamp_ns + self._offsets_ns[own.setting]

    def _set_back(self, own: _Sensor, sensor: str, stamp_ns: int) -> None:
        latest = len(self._offsets_ns) - 1
        offset_ns = self._newest_ns(latest) + _GAP_NS - stamp_ns
        back_s = 1e-9 * (own.typical_ns - stamp_ns)
        detail = (
            f"stamps of {sensor} went back by {back_s:.3f} s: from now on {1e-9 * offset_ns:.3f} s are added to all"
        )
        self._report(stamp_ns, EventKind.CLOCK_RESTARTED, detail)
        self._offsets_ns.append(offset_ns)
        own.restart(latest + 1)

    def _newest_ns(self, setting: int) -> int:
        """Return the newest stamp of all sensors that are in a setting of the clock, with the setting's offset."""
        stamps = [each.typical_ns for each in self._sensors.values() if each.setting == setting and each.recent_ns]
        return max(stamps) + self._offsets_ns[setting]


@dataclass(slots=True)
class _Sensor:
    """The state of one sensor of a shared clock."""

    setting: int  # setting of the clock: how many times it had been set back
    recent_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_RECENT))  # its newest stamps
    behind: int = 0  # number of stamps in a row that were too early

    @property
    def typical_ns(self) -> int:
        """Median of the recent stamps, which a single outlier does not affect."""
        return sorted(self.recent_ns)[len(self.recent_ns) // 2]

    def restart(self, setting: int) -> None:
        """Forget the previous stamps; those to come belong to another setting of the clock."""
        self.setting, self.behind = setting, 0
        self.recent_ns.clear()
