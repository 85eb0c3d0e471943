"""The one clock of all sensors whose stamps are kept as they are, and what becomes of it when it is set back."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from graphvio.backend.initial_state import MAX_UNBRIDGED_S
from graphvio.measurements.events import Report

BACK_NS = 250_000_000
"""Further behind the stamps before it of the same sensor, a stamp is of a clock that was set back."""
_CONFIRMATIONS = 3  # of one sensor, one after the other
_AHEAD_NS = 100_000_000  # by so much one sensor's stamps may be ahead of the others'
_GAP_NS = round((MAX_UNBRIDGED_S + 1.0) * 1e9)  # that nothing bridges: what was before has nothing to do with it
_KEPT = 3


class SharedClock:
    """Stamps as they are, until the clock is set back: a host's by its administrator, or a bag's that is played again.

    From then on stamps are as much later as it takes to come four seconds after all before, so that the odometry begins
    a new epoch. What is still under way from before is late, and left out. Single wild stamps set nothing back.

    Args:
        report: is told ``clock_restarted``, and ``stamp_implausible`` where a stamp is not used.
    """

    def __init__(self, report: Report) -> None:
        self._report = report
        self._offsets_ns = [0]  # since each time that it was set back
        self._sensors: dict[str, _Sensor] = {}

    def map(self, sensor: str, stamp_ns: int) -> int | None:
        """The stamp to be used, or None if it cannot be believed.

        Args:
            sensor: whose it is; stamps of one come in order, but for few.
            stamp_ns: as it came.
        """
        latest = len(self._offsets_ns) - 1
        own = self._sensors.setdefault(sensor, _Sensor(latest))
        if own.setting < latest and stamp_ns + self._offsets_ns[latest] <= self._newest_ns(latest) + _AHEAD_NS:
            own.begin(latest)
        if own.is_behind(stamp_ns):
            own.behind += 1
            if own.behind < _CONFIRMATIONS:
                self._report(stamp_ns, "stamp_implausible", f"{sensor}: earlier than those before it; left out")
                return None
            self._set_back(own, sensor, stamp_ns)
        own.behind = 0
        own.recent_ns.append(stamp_ns)
        return stamp_ns + self._offsets_ns[own.setting]

    def _set_back(self, own: _Sensor, sensor: str, stamp_ns: int) -> None:
        latest = len(self._offsets_ns) - 1
        offset_ns = self._newest_ns(latest) + _GAP_NS - stamp_ns
        back_s = 1e-9 * (own.typical_ns - stamp_ns)
        self._report(
            stamp_ns,
            "clock_restarted",
            f"stamps of {sensor} went back by {back_s:.3f} s: from now on {1e-9 * offset_ns:.3f} s are added to all",
        )
        self._offsets_ns.append(offset_ns)
        own.begin(latest + 1)

    def _newest_ns(self, setting: int) -> int:
        """Of all sensors since it was set so, as used."""
        stamps = [each.typical_ns for each in self._sensors.values() if each.setting == setting and each.recent_ns]
        return max(stamps) + self._offsets_ns[setting]


@dataclass(slots=True)
class _Sensor:
    """What came of one.

    Attributes:
        setting: of the clock, how many times it had been set back.
        recent_ns: its newest stamps.
        behind: how many in a row were too early.
    """

    setting: int
    recent_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_KEPT))
    behind: int = 0

    @property
    def typical_ns(self) -> int:
        """A recent stamp that is no wild one: their median."""
        return sorted(self.recent_ns)[len(self.recent_ns) // 2]

    def is_behind(self, stamp_ns: int) -> bool:
        """Whether a stamp is of a clock that was set back."""
        return bool(self.recent_ns) and stamp_ns < self.typical_ns - BACK_NS

    def begin(self, setting: int) -> None:
        """From now on its stamps are those of another setting."""
        self.setting, self.behind = setting, 0
        self.recent_ns.clear()
