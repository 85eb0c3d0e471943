"""Reader of IMUs of Linux' Industrial I/O (IIO), by their files in sysfs and the buffers of character devices."""

from __future__ import annotations

import os
import re
import select
import threading
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphvio.arrays import AnyArray, Float, Int
from graphvio.errors import SourceError
from graphvio.live.device_clock import host_ns_of_monotonic, realtime_to_host_ns
from graphvio.live.devices import Counts, DeviceLostError, HandOver
from graphvio.live.imu_merging import AccelOntoGyro
from graphvio.measurements.readings import ImuReading, host_ns
from graphvio.wording import listed

_SYSFS = Path("/sys/bus/iio/devices")
_DEV = Path("/dev")
_KINDS = ("anglvel", "accel")
_AXES = "xyz"
_TYPE = re.compile(r"(le|be):([su])(\d+)/(\d+)(?:X(\d+))?>>(\d+)")
_BUFFER_SCANS = 128
_SCANS_A_READ = 64
_POLL_S = 0.1
_MAX_SILENCE_NS = 3_000_000_000


class IioImu:
    """Gyro and accelerometer of one IIO device, or of two whose samples are merged, as a `Device`.

    Stamps are the kernel's, on the host's clock. Mount matrices are applied, so that samples are in body.

    Args:
        names: names of the devices, as in their files ``name``, or ``iio:deviceN``.
        rate_hz: the rate to set, or None to leave it as it is.
        sysfs: folder of all devices.
        dev: folder of the character devices.
    """

    clock = None

    def __init__(self, names: list[str], rate_hz: float | None = None, sysfs: Path = _SYSFS, dev: Path = _DEV) -> None:
        self.name = f"iio:{'+'.join(names)}"
        self._names, self._rate_hz, self._sysfs, self._dev = names, rate_hz, sysfs, dev
        self._buffers: list[_Buffer] = []
        self._merging: AccelOntoGyro | None = None
        self.counts = Counts()

    def start(self, hand_over: HandOver) -> None:
        """See `Device.start`."""
        self._merging = AccelOntoGyro(hand_over, self.counts)
        try:
            for name in self._names:
                self._buffers.append(_Buffer(_find(self._sysfs, name), self._dev, self._rate_hz))
            missing = [kind for kind in _KINDS if not any(kind in buffer.kinds for buffer in self._buffers)]
            if missing:
                raise SourceError(
                    f"{self.name}: has no channels in_{missing[0]}_x, _y, _z; name the device that has them, too "
                    "(imu=iio:GYRO+ACCEL)"
                )
            for buffer in self._buffers:
                buffer.enable()
        except OSError as error:
            raise SourceError(
                f"{self.name}: cannot be set up ({error}); reading IIO buffers needs the right to write its files in "
                "sysfs: a udev rule or root"
            ) from None

    def run(self, hand_over: HandOver, stopping: threading.Event) -> None:
        """See `Device.run`."""
        assert self._merging is not None
        newest_ns = host_ns()
        while not stopping.is_set():
            ready, _, _ = select.select(self._buffers, [], [], _POLL_S)
            arrival_ns = host_ns()
            for buffer in ready:
                if buffer.read_into(self._merging, arrival_ns):
                    newest_ns = arrival_ns
            if arrival_ns - newest_ns > _MAX_SILENCE_NS:
                raise DeviceLostError("no sample for 3 s; check its trigger")

    def stop(self) -> None:
        """See `Device.stop`."""
        for buffer in self._buffers:
            buffer.close()
        self._buffers.clear()

    def detail(self) -> str:
        """See `Device.detail`."""
        return "IMU of the kernel"


class _Buffer:
    """The buffer of one IIO device, with its inertial channels."""

    def __init__(self, folder: Path, dev: Path, rate_hz: float | None) -> None:
        self._folder = folder
        self._path = dev / folder.name
        self._scan = folder / "scan_elements"
        self._fd = -1
        self._partial = b""
        self.kinds = [kind for kind in _KINDS if (self._scan / f"in_{kind}_x_en").exists()]
        self._write("buffer/enable", "0")  # channels cannot be selected while it runs
        self._set_rate(rate_hz)
        self._is_monotonic = self._set_clock()
        wanted = [f"in_{kind}_{axis}" for kind in self.kinds for axis in _AXES] + ["in_timestamp"]
        for file in self._scan.glob("*_en"):
            file.write_text("1" if file.name.removesuffix("_en") in wanted else "0")
        self._format = ScanFormat([self._element(name) for name in wanted])
        self._scales = {kind: self._scale(kind) for kind in self.kinds}
        self._offsets = {kind: self._per_axis(kind, "offset", 0.0) for kind in self.kinds}
        self._body_R_sensor = {kind: self._mount(kind) for kind in self.kinds}

    def fileno(self) -> int:
        """Return the file descriptor, for `select`."""
        return self._fd

    def enable(self) -> None:
        trigger = self._folder / "trigger/current_trigger"
        if trigger.exists() and not trigger.read_text().strip():
            trigger.write_text(self._own_trigger())
        self._write("buffer/length", str(_BUFFER_SCANS))
        self._write("buffer/enable", "1")
        self._fd = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK)

    def close(self) -> None:
        with ExitStack() as stack:
            stack.enter_context(suppress(OSError))
            if self._fd >= 0:
                stack.callback(os.close, self._fd)
                self._fd = -1
            self._write("buffer/enable", "0")

    def read_into(self, merging: AccelOntoGyro, arrival_ns: int) -> int:
        """Pass on the scans in the buffer to the merging; returns their number."""
        size = self._format.dtype.itemsize
        try:
            data = os.read(self._fd, _SCANS_A_READ * size)
        except BlockingIOError:
            return 0
        if not data:
            raise DeviceLostError(f"{self._path} has ended")
        data = self._partial + data
        whole = len(data) // size * size
        self._partial = data[whole:]
        scans = np.frombuffer(data[:whole], self._format.dtype)
        vectors = {kind: self._vectors(scans, kind) for kind in self.kinds}
        to_host_ns = host_ns_of_monotonic(0) if self._is_monotonic else realtime_to_host_ns()
        for k, kernel_ns in enumerate(self._format.channel(scans, "in_timestamp").tolist()):
            stamp_ns = kernel_ns + to_host_ns
            if "accel" in vectors:
                merging.add_accel(stamp_ns, vectors["accel"][k])
            if "anglvel" in vectors:
                merging.add_gyro(ImuReading(stamp_ns, vectors["anglvel"][k], np.zeros(3), arrival_ns))
        return len(scans)

    def _vectors(self, scans: np.ndarray[tuple[int], np.dtype[np.void]], kind: str) -> Float:
        raw = np.stack([self._format.channel(scans, f"in_{kind}_{axis}") for axis in _AXES], axis=1)
        measured = (raw + self._offsets[kind]) * self._scales[kind]
        return np.asarray(measured @ self._body_R_sensor[kind].T)

    def _element(self, name: str) -> ScanElement:
        try:
            index = (self._scan / f"{name}_index").read_text()
            kind = (self._scan / f"{name}_type").read_text()
        except FileNotFoundError:
            raise SourceError(f"{self._folder}: has no channel {name}; it cannot be used as an IMU") from None
        return ScanElement.parse(name, index, kind)

    def _scale(self, kind: str) -> Float:
        scales = self._per_axis(kind, "scale", None)
        if (scales <= 0).any():
            raise SourceError(f"{self._folder}: in_{kind}_scale is not positive")
        return scales

    def _per_axis(self, kind: str, what: str, default: float | None) -> Float:
        """Read a value for each axis (3,): from the axis' own file or the common one, or the default."""
        values = []
        for axis in _AXES:
            texts = [self._read(f"in_{kind}_{axis}_{what}"), self._read(f"in_{kind}_{what}")]
            text = next((text for text in texts if text is not None), None)
            if text is None and default is None:
                raise SourceError(f"{self._folder}: has no file in_{kind}_{what}")
            values.append(float(text) if text is not None else float(default or 0.0))
        return np.array(values)

    def _mount(self, kind: str) -> Float:
        for name in (f"in_{kind}_mount_matrix", "in_mount_matrix", "mount_matrix"):
            text = self._read(name)
            if text is not None:
                return mount_matrix(text)
        return np.eye(3)

    def _set_rate(self, rate_hz: float | None) -> None:
        if rate_hz is None:
            return
        files = [f"in_{kind}_sampling_frequency" for kind in self.kinds] + ["sampling_frequency"]
        present = [name for name in files if (self._folder / name).exists()]
        if not present:
            raise SourceError(f"{self._folder}: its rate cannot be set here; leave imu_rate_hz out")
        for name in present:
            self._write(name, f"{rate_hz:g}")

    def _set_clock(self) -> bool:
        """Select ``CLOCK_MONOTONIC``; returns False if stamps stay on the kernel's default, ``CLOCK_REALTIME``."""
        name = "current_timestamp_clock"
        if not (self._folder / name).exists():
            return False
        self._write(name, "monotonic")
        return self._read(name) == "monotonic"

    def _own_trigger(self) -> str:
        number = self._folder.name.removeprefix("iio:device")
        for file in sorted(self._folder.parent.glob("trigger*/name")):
            trigger = file.read_text().strip()
            if trigger.endswith(f"-dev{number}"):  # the driver's own data-ready trigger
                return trigger
        raise SourceError(
            f"{self._folder}: has no trigger; write the name of one to {self._folder / 'trigger/current_trigger'}"
        )

    def _read(self, name: str) -> str | None:
        try:
            return (self._folder / name).read_text().strip()
        except FileNotFoundError:
            return None

    def _write(self, name: str, text: str) -> None:
        (self._folder / name).write_text(text)


def _find(sysfs: Path, name: str) -> Path:
    """Find the folder of a device by its name or number."""
    known = {}
    for folder in sorted(sysfs.glob("iio:device*")):
        known[folder.name] = folder
        with suppress(OSError):
            known.setdefault((folder / "name").read_text().strip(), folder)
    if name not in known:
        raise SourceError(f"there is no IIO device {name!r} in {sysfs}; there are {listed(known)}")
    return known[name]


@dataclass(frozen=True)
class ScanElement:
    """One channel of a scan; in sysfs ``[be|le]:[s|u]BITS/STORAGE[XREPEAT]>>SHIFT``."""

    name: str  # name of the channel, such as ``in_anglvel_x``
    index: int  # its position in the scan
    is_signed: bool  # whether it is in two's complement
    bits: int  # number of valid bits
    storage_bytes: int  # its size in the scan, to a multiple of which it is aligned
    shift: int  # number of bits to shift right, before the valid bits are taken
    is_big_endian: bool  # whether its byte order is big-endian

    @staticmethod
    def parse(name: str, index: str, kind: str) -> ScanElement:
        """Parse the contents of ``NAME_index`` and ``NAME_type``.

        Raises:
            SourceError: if they are malformed, or of a kind that no IMU has.
        """
        found = _TYPE.fullmatch(kind.strip())
        if found is None or not index.strip().isdigit():
            raise SourceError(f"IIO channel {name}: type {kind.strip()!r} or index {index.strip()!r} is not understood")
        bits, storage, shift = int(found[3]), int(found[4]), int(found[6])
        if storage not in (8, 16, 32, 64) or found[5] not in (None, "1") or not 0 < bits <= storage - shift:
            raise SourceError(f"IIO channel {name}: type {kind.strip()!r} is none that an IMU has")
        return ScanElement(name, int(index), found[2] == "s", bits, storage // 8, shift, found[1] == "be")

    def values(self, stored: AnyArray) -> Int:
        """Convert stored words (N,), unsigned and of the width of the storage, to numbers (N,)."""
        words = stored.astype(np.uint64) >> np.uint64(self.shift)
        unused = np.uint64(64 - self.bits)
        words = words << unused
        return (words.view(np.int64) >> np.int64(unused)) if self.is_signed else (words >> unused).view(np.int64)


class ScanFormat:
    """Layout of the enabled elements in a scan: each is aligned to its own size.

    Attributes:
        dtype: numpy type of a whole scan, with a field for each element.
    """

    def __init__(self, elements: list[ScanElement]) -> None:
        self._elements = {element.name: element for element in elements}
        offsets, formats, end = [], [], 0
        ordered = sorted(elements, key=lambda element: element.index)
        for element in ordered:
            size = element.storage_bytes
            offsets.append(-(-end // size) * size)
            formats.append(f"{'>' if element.is_big_endian else '<'}u{size}")
            end = offsets[-1] + size
        alignment = max(element.storage_bytes for element in elements)
        names = [element.name for element in ordered]
        self.dtype: np.dtype[np.void] = np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": -(-end // alignment) * alignment}
        )

    def channel(self, scans: AnyArray, name: str) -> Int:
        """Return the raw numbers (N,) of a channel in N scans of `dtype`."""
        return self._elements[name].values(scans[name])


def mount_matrix(text: str) -> Float:
    """Parse ``body_R_sensor`` (3, 3) from a mount matrix in sysfs, ``a, b, c; d, e, f; g, h, i``.

    Raises:
        SourceError: if it is not a rotation.
    """
    try:
        matrix = np.array([[float(value) for value in row.split(",")] for row in text.strip().split(";")])
    except ValueError:
        matrix = np.zeros((0, 0))
    if matrix.shape != (3, 3) or np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0:
        raise SourceError(f"IIO mount matrix {text.strip()!r} is not a rotation; correct it in the device tree")
    return matrix
