"""From the clocks of devices to the host's: offset and drift, from the stamps of messages and when they came."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

from graphvio.live.envelope import Envelope, Line
from graphvio.measurements.events import Report

JUMP_NS = 500_000_000
"""Off by more than this, a stamp is of a clock that was set or began anew."""
SETTLING_NS = 1_000_000_000
"""At first the map may move fast."""
FAST_SLEW = 0.5
"""Seconds per second while it settles: whatever it was wrong by at first is gone by the end."""
SLEW = 1e-3
"""Seconds per second from then on."""

_KNOT_INTERVAL_NS = 20_000_000
_KNOTS = 64  # more than a second of them: nothing older is mapped
_CONFIRMATIONS = 3  # readings that agree on another clock,
_CONFIRMED_NS = 50_000_000  # for so long, so that a queue that empties is not enough
_STOPPED_NS = 1_000_000_000  # and longer if their stamps go on from the ones before, which a pause of the host explains


class ClockMap:
    """One device's clock, as a function from its stamps to the host's time.

    All stamps of a device, of whatever sensor, go through the same function: it is continuous, increases, and once a
    stamp has been mapped, every stamp up to it always maps to the same time. What it is wrong by, it makes good by
    running faster or slower, `FAST_SLEW` at most for a second and `SLEW` from then on; rates are on top of the drift.

    The least delay of messages cannot be told from an offset: mapped times are later than the truth by it.

    A clock that is off by more than `JUMP_NS` is mapped anew; the drift, which is the crystal's, is kept. One wild
    stamp does not do that: three have to agree over 50 ms, and are not mapped until they do.

    Args:
        name: of the clock, for people.
        report: is told ``clock_restarted``, ``clock_stepped`` where it went forward by less and is followed slowly, and
            ``stamp_implausible`` where a stamp is not mapped.
    """

    def __init__(self, name: str, report: Report) -> None:
        self._name = name
        self._report = report
        self._envelope = Envelope()
        self._knots: deque[_Knot] = deque(maxlen=_KNOTS)
        self._origin_ns = 0  # stamp
        self._offset_ns = 0  # host's time there, less the stamp
        self._newest = 0  # since the origin
        self._suspicion: _Suspicion | None = None
        self._is_doubted = False

    @property
    def drift_ppm(self) -> float:
        """How much faster the host's clock is, as known now; 0 until three seconds have passed."""
        return 1e6 * self._envelope.line.drift

    def doubt(self) -> None:
        """The device was away: its clock has begun anew if the next stamp says so."""
        self._is_doubted = True

    def map(self, stamp_ns: int, arrival_ns: int) -> int | None:
        """The host's time of a stamp, or None if the stamp cannot be believed.

        Args:
            stamp_ns: by the device, of any of its sensors.
            arrival_ns: when it came, by the host.
        """
        if not self._knots:
            self._begin(stamp_ns, arrival_ns)
        late_ns = arrival_ns - self._mapped(stamp_ns)
        if abs(late_ns) <= JUMP_NS:
            self._suspicion, self._is_doubted = None, False
            self._learn(stamp_ns, arrival_ns)
        elif self._is_other_clock(stamp_ns, arrival_ns, late_ns):
            self._report(
                stamp_ns, "clock_restarted", f"clock {self._name}: {1e-9 * late_ns:+.3f} s off what it was; mapped anew"
            )
            self._begin(stamp_ns, arrival_ns)
        elif not self._goes_on(stamp_ns, late_ns):
            self._report(
                stamp_ns, "stamp_implausible", f"clock {self._name}: {1e-9 * late_ns:+.3f} s off its clock; left out"
            )
            return None
        self._newest = max(self._newest, stamp_ns - self._origin_ns)
        return self._mapped(stamp_ns)

    def _mapped(self, stamp_ns: int) -> int:
        at = stamp_ns - self._origin_ns
        knot = self._knots[max(bisect_right(self._knots, at, key=lambda each: each.start) - 1, 0)]
        return stamp_ns + self._offset_ns + round(knot.delay(at))

    def _begin(self, stamp_ns: int, arrival_ns: int) -> None:
        """Map from here on as if this message was not delayed; after all that was mapped before."""
        begin_ns = arrival_ns
        if self._knots:
            begin_ns = max(arrival_ns, self._mapped(self._origin_ns + self._newest) + 1)
        self._origin_ns, self._offset_ns, self._newest = stamp_ns, begin_ns - stamp_ns, 0
        self._envelope = Envelope(self._envelope.line.drift)
        self._knots.clear()
        self._knots.append(_Knot(0, 0.0, Line(0.0, self._envelope.line.drift)))
        self._suspicion, self._is_doubted = None, False
        self._learn(stamp_ns, arrival_ns)

    def _learn(self, stamp_ns: int, arrival_ns: int) -> None:
        change = self._envelope.add(stamp_ns - self._origin_ns, arrival_ns - stamp_ns - self._offset_ns)
        if change == "stepped":
            self._report(stamp_ns, "clock_stepped", f"clock {self._name} went forward: followed, 1 ms a second")
        last = self._knots[-1]
        newest = max(self._newest, stamp_ns - self._origin_ns)
        if self._envelope.line != last.line and newest - last.start >= _KNOT_INTERVAL_NS:
            self._knots.append(_Knot(newest, self._envelope.line.at(newest) - last.delay(newest), self._envelope.line))

    def _goes_on(self, stamp_ns: int, late_ns: int) -> bool:
        """Whether a pause of the host, or of what is between, may have made a message late."""
        return late_ns > 0 and stamp_ns - self._origin_ns > self._newest - JUMP_NS

    def _is_other_clock(self, stamp_ns: int, arrival_ns: int, late_ns: int) -> bool:
        if self._is_doubted:
            return True
        offset_ns = arrival_ns - stamp_ns
        if self._suspicion is None or abs(offset_ns - self._suspicion.offset_ns) > JUMP_NS:
            self._suspicion = _Suspicion(offset_ns, arrival_ns, 0)
        self._suspicion.count += 1
        least_ns = _STOPPED_NS if self._goes_on(stamp_ns, late_ns) else _CONFIRMED_NS
        return self._suspicion.count >= _CONFIRMATIONS and arrival_ns - self._suspicion.since_ns >= least_ns


class ClockMaps:
    """The clocks of all devices, by name."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._maps: dict[str, ClockMap] = {}

    def map(self, clock: str, stamp_ns: int, arrival_ns: int) -> int | None:
        """See `ClockMap.map`."""
        if clock not in self._maps:
            self._maps[clock] = ClockMap(clock, self._report)
        return self._maps[clock].map(stamp_ns, arrival_ns)

    def doubt(self, clock: str | None) -> None:
        """See `ClockMap.doubt`: for every notice that a device was lost or is back."""
        if clock in self._maps:
            self._maps[clock].doubt()

    @property
    def drifts_ppm(self) -> dict[str, float]:
        """See `ClockMap.drift_ppm`."""
        return {name: each.drift_ppm for name, each in self._maps.items()}


@dataclass(frozen=True, slots=True)
class _Knot:
    """From a stamp on, the map approaches a line.

    Attributes:
        start: stamp since the map's origin, ns.
        error: what has to be added there, ns.
        line: delay over stamp, both since the origin, ns.
    """

    start: int
    error: float
    line: Line

    def delay(self, at: int) -> float:
        """What to add to a stamp, besides the map's offset."""
        made_good = max(_allowance(at) - _allowance(self.start), 0.0)
        left = max(abs(self.error) - made_good, 0.0)
        return self.line.at(at) - (left if self.error > 0.0 else -left)


def _allowance(at: int) -> float:
    """By how much a map may be corrected up to a stamp since its origin, ns."""
    return FAST_SLEW * min(at, SETTLING_NS) + SLEW * max(at - SETTLING_NS, 0)


@dataclass(slots=True)
class _Suspicion:
    """Readings in a row that agree on another clock."""

    offset_ns: int
    since_ns: int
    count: int
