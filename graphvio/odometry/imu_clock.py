"""The error of the IMU's clock that exceeds what the calibration corrects, and its correction."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

from graphvio.errors import RigError
from graphvio.measurements.events import CORRECTED, EventKind, Report
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig

MAX_SHIFT_S = 1.5
"""Largest error of the clock that is searched for, s."""
_MIN_REPORTED_S = 1e-3  # several corrections may nearly cancel


def with_late_clock(rig: Rig, seconds: float) -> Rig:
    """Return a rig with the IMU's time offset increased; the same rig where a rig file does not allow that offset."""
    if rig.imu is not None and seconds:
        with suppress(RigError):
            return replace(rig, imu=replace(rig.imu, time_offset_s=rig.imu.time_offset_s + seconds))
    return rig


class ImuClock:
    """Keeps the error of the IMU's clock, and corrects it.

    Args:
        max_late_s: Largest lateness that is corrected, s. A later clock is only reported, as framesets do not wait for
            so long.
        synchroniser: Receives corrections.
        report: Receives events.

    Attributes:
        shift_s: Time, s, by which the IMU's stamps are later than by the rig's time offset.
        is_too_late: Whether the clock is too late to be corrected.
    """

    def __init__(self, max_late_s: float, synchroniser: Synchroniser, report: Report) -> None:
        self.shift_s = 0.0
        self.is_too_late = False
        self._corrected_s = 0.0  # part of `shift_s` that is corrected in this run
        self._max_late_s = max_late_s
        self._synchroniser = synchroniser
        self._report = report

    @property
    def warnings(self) -> list[str]:
        """Warning about the clock's error, a sentence or none."""
        if abs(self.shift_s) < _MIN_REPORTED_S:
            return []
        return [f"IMU: {self._relation}; {self._what_is_done}"]

    def correct(self, stamp_ns: int, shift_s: float) -> bool:
        """Correct the clock, whose stamps are later than after the last correction.

        Args:
            stamp_ns: Stamp of the frameset at which the error was found.
            shift_s: Time by which the stamps are later, s.

        Returns:
            Whether the clock is corrected; where it is too late for that, this is reported once.
        """
        self.shift_s = self._corrected_s + shift_s
        was_too_late, self.is_too_late = self.is_too_late, self.shift_s > self._max_late_s
        if not (was_too_late and self.is_too_late):
            self._report(stamp_ns, EventKind.IMU_CLOCK_OFF, f"{self._relation}; {self._what_is_done}")
        if self.is_too_late:
            return False
        self._synchroniser.correct_imu_clock(shift_s)
        self._corrected_s = self.shift_s
        return True

    def keep(self) -> None:
        """Record that the clock is right with the present correction."""
        self.shift_s, self.is_too_late = self._corrected_s, False

    @property
    def _relation(self) -> str:
        later = "later" if self.shift_s > 0.0 else "earlier"
        return f"its stamps are {1e3 * abs(self.shift_s):.0f} ms {later} than by the rig's time offset"

    @property
    def _what_is_done(self) -> str:
        return "it is not used, since framesets do not wait for so long" if self.is_too_late else CORRECTED
