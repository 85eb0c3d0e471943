"""Reader of IMUs on a serial port that send lines of text, which a few lines of microcontroller code can write.

    stamp_us,gx,gy,gz,ax,ay,az[,temperature][*HH]

``stamp_us`` is the microcontroller's clock, a whole number that may wrap at 32 bits; rates are rad/s, accelerations
m/s^2, the temperature degrees Celsius. ``HH`` is the exclusive or of all bytes before the star, two hexadecimal digits,
as in NMEA 0183; once a line has had one, lines without are damaged. Lines end in LF or CRLF.
"""

from __future__ import annotations

import re
import threading
from functools import reduce
from operator import xor
from typing import Any

import numpy as np

from graphvio.errors import SourceError, importing
from graphvio.live.device_clock import MicrosecondCounter
from graphvio.live.devices import Counts, DeviceLostError, HandOver
from graphvio.measurements.events import EventKind
from graphvio.measurements.readings import ImuReading, Notice, host_ns

_POLL_S = 0.05
_MAX_SILENCE_NS = 3_000_000_000
_MAX_LINE = 256
_MAX_RATE = 100.0  # rad/s; most values with a lost or doubled digit exceed the range of any IMU
_MAX_ACCELERATION = 1000.0  # m/s^2
_BACKWARDS_NS = 1_000_000_000
_LINE = re.compile(rb"([-+0-9.eE, ]+)(?:\*([0-9A-Fa-f]{2}))?\r?")


class ImuLines:
    """Parser of the bytes of a serial port; lines that are not samples are counted.

    Args:
        clock: name of the microcontroller's clock.
        counts: counts ``bad_line``, ``bad_checksum`` and ``clock_restarted``.
    """

    def __init__(self, clock: str, counts: Counts) -> None:
        self._counts = counts
        self._clock = clock
        self._counter = MicrosecondCounter()
        self._newest_ns: int | None = None
        self._partial = b""
        self._is_in_step = False
        self._has_checksums = False

    def take(self, data: bytes, arrival_ns: int) -> list[ImuReading | Notice]:
        """Parse the lines that end in these bytes; the very first is left out, as it may be incomplete."""
        *lines, self._partial = (self._partial + data).split(b"\n")
        if lines and not self._is_in_step:
            self._is_in_step = True
            del lines[0]
        if len(self._partial) > _MAX_LINE:
            self._partial = b""
            self._counts.add("bad_line", self._is_in_step)
            self._is_in_step = False
        found: list[ImuReading | Notice] = []
        for line in lines:
            self._take_line(line, arrival_ns, found)
        return found

    def _take_line(self, line: bytes, arrival_ns: int, found: list[ImuReading | Notice]) -> None:
        matched = _LINE.fullmatch(line)
        if matched is None or len(line) > _MAX_LINE:
            self._counts.add("bad_line")
            return
        if matched[2] is None:
            is_sound = not self._has_checksums
        else:
            is_sound = reduce(xor, matched[1], 0) == int(matched[2], 16)
            self._has_checksums |= is_sound
        if not is_sound:
            self._counts.add("bad_checksum")
            return
        try:
            stamp, *texts = matched[1].split(b",")
            stamp_us, values = int(stamp), np.array([float(text) for text in texts])
        except ValueError:
            self._counts.add("bad_line")
            return
        rate, acceleration = values[:3], values[3:6]
        too_large = np.abs(rate).max(initial=0.0) > _MAX_RATE
        too_large |= np.abs(acceleration).max(initial=0.0) > _MAX_ACCELERATION
        if len(values) not in (6, 7) or stamp_us < 0 or too_large or not np.isfinite(values).all():
            self._counts.add("bad_line")
            return
        stamp_ns = self._counter.stamp_ns(stamp_us)
        if self._newest_ns is not None and stamp_ns < self._newest_ns - _BACKWARDS_NS:
            self._counts.add(EventKind.CLOCK_RESTARTED)
            self._counter = MicrosecondCounter()
            stamp_ns = self._counter.stamp_ns(stamp_us)
            detail = f"{self._clock}: its clock went back to {stamp_us} us; it has restarted"
            found.append(Notice(EventKind.CLOCK_RESTARTED, detail, arrival_ns, self._clock))
        self._newest_ns = stamp_ns
        temperature_c = float(values[6]) if len(values) == 7 else None
        found.append(ImuReading(stamp_ns, rate, acceleration, arrival_ns, self._clock, temperature_c))


class SerialImu:
    """An IMU on a serial port as a `Device`, read with pyserial.

    Args:
        path: path of the port.
        baud: rate of the port.

    Raises:
        MissingExtraError: if pyserial is not installed.
    """

    def __init__(self, path: str, baud: int) -> None:
        with importing("pyserial", "live", "an IMU on a serial port"):
            import serial
        self._library = serial
        self.name = f"serial:{path}"
        self.clock = self.name
        self._path, self._baud = path, baud
        self._port: Any = None
        self.counts = Counts()
        self._lines = ImuLines(self.clock, self.counts)

    def start(self, hand_over: HandOver) -> None:
        """See `Device.start`."""
        self._lines = ImuLines(self.clock, self.counts)
        try:
            self._port = self._library.Serial(self._path, self._baud, timeout=_POLL_S, exclusive=True)
            self._port.reset_input_buffer()  # arrival times of buffered data are meaningless
        except (OSError, ValueError) as error:
            raise SourceError(
                f"{self._path}: cannot be opened as a serial port ({error}); check the cable, and that you are in "
                "the group 'dialout'"
            ) from None

    def run(self, hand_over: HandOver, stopping: threading.Event) -> None:
        """See `Device.run`."""
        newest_ns = host_ns()
        while not stopping.is_set():
            data = self._port.read(max(self._port.in_waiting, 1))
            arrival_ns = host_ns()
            found = self._lines.take(data, arrival_ns)
            for reading in found:
                hand_over(reading)
            if found:
                newest_ns = arrival_ns
            elif arrival_ns - newest_ns > _MAX_SILENCE_NS:
                raise DeviceLostError("no sample for 3 s; check the rate of the port (baud=...) and the lines' format")

    def stop(self) -> None:
        """See `Device.stop`."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def detail(self) -> str:
        """See `Device.detail`."""
        return f"IMU, lines at {self._baud} baud"
