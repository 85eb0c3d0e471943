"""IMUs on a serial port, here a pseudo-terminal, and of the kernel, here a tree of files and a pipe."""

from __future__ import annotations

import os
import struct
import time
import tty
from collections.abc import Iterator
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest
from recordings import small_rig

from graphvio.errors import SourceError
from graphvio.live.devices import Counts, Device, DeviceSource
from graphvio.live.imu_readers.iio_imu import IioImu, ScanElement, ScanFormat, mount_matrix
from graphvio.live.imu_readers.serial_imu import ImuLines, SerialImu
from graphvio.measurements.events import EventKind
from graphvio.measurements.readings import ImuReading, Notice, Reading, host_ns

BAUD = 115_200


def line(stamp_us: int, checksum: bool = False, temperature: str = "") -> bytes:
    text = f"{stamp_us},0.1,-0.2,0.3,1.5,-2.5,9.81{temperature}".encode()
    return text + (b"*%02X" % reduce(xor, text, 0) if checksum else b"") + b"\n"


def imu_readings(found: list[ImuReading | Notice]) -> list[ImuReading]:
    return [reading for reading in found if isinstance(reading, ImuReading)]


@pytest.mark.parametrize("cut", [1, 7, 1000])
def test_imu_lines_any_chunks_give_samples(cut: int) -> None:
    counts = Counts()
    lines = ImuLines("mcu", counts)
    data = b"5,1.0,2.0\n" + line(1000) + line(6000, temperature=",31.5").replace(b"\n", b"\r\n") + line(11000)[:9]
    found = []
    for begin in range(0, len(data), cut):
        found += imu_readings(lines.take(data[begin : begin + cut], 77))
    assert [reading.stamp_ns for reading in found] == [1_000_000, 6_000_000]
    np.testing.assert_array_equal(found[0].angular_velocity, [0.1, -0.2, 0.3])
    np.testing.assert_array_equal(found[0].linear_acceleration, [1.5, -2.5, 9.81])
    assert (found[0].clock, found[0].arrival_ns) == ("mcu", 77)
    assert (found[0].temperature_c, found[1].temperature_c) == (None, 31.5)
    assert not counts.totals()


@pytest.mark.parametrize(
    "garbage",
    [
        b"\xff\x00\x13garbage\n",
        b"1,2,3\n",
        b"\n",
        b"1,nan,0,0,0,0,0\n",
        b"1,1e400,0,0,0,0,0\n",
        b"1,101,0,0,0,0,0\n",
        b"1,0,0,0,0,0,-1001\n",
        b"-1,0,0,0,0,0,0\n",
        b"1.5,0,0,0,0,0,0\n",
        b"1,0,0,0,0,0,0,0,0\n",
        b"1,0,0,0,0,0,0-\n",
        b"1,0,0,,0,0,0\n",
    ],
)
def test_imu_lines_bad_line_is_counted(garbage: bytes) -> None:
    counts = Counts()
    lines = ImuLines("mcu", counts)
    found = imu_readings(lines.take(b"\n" + line(1000) + garbage + line(2000), 0))
    assert [reading.stamp_ns for reading in found] == [1_000_000, 2_000_000]
    assert counts.totals() == {"bad_line": 1}


def test_imu_lines_without_line_ends_are_dropped() -> None:
    counts = Counts()
    lines = ImuLines("mcu", counts)
    lines.take(b"\n", 0)
    for _ in range(100):
        assert lines.take(b"\x00" * 100, 0) == []
    assert counts.totals()["bad_line"] == 1
    assert imu_readings(lines.take(b"00\n" + line(3000), 0))[0].stamp_ns == 3_000_000


def test_imu_lines_checksum_is_required_after_first() -> None:
    counts = Counts()
    lines = ImuLines("mcu", counts)
    sound, damaged = line(1000, checksum=True), line(2000, checksum=True).replace(b"9.81", b"8.81")
    found = imu_readings(lines.take(b"\n" + sound + damaged + line(3000) + line(4000, checksum=True), 0))
    assert [reading.stamp_ns for reading in found] == [1_000_000, 4_000_000]
    assert counts.totals() == {"bad_checksum": 2}


def test_imu_lines_counter_wrap_and_restart() -> None:
    counts = Counts()
    lines = ImuLines("mcu", counts)
    found = lines.take(b"\n" + line((1 << 32) - 1000) + line(1000) + line(5_000_000) + line(70), 9)
    stamps = [each.stamp_ns if isinstance(each, ImuReading) else each.kind for each in found]
    wrap_us = 1 << 32
    assert stamps == [
        1000 * (wrap_us - 1000),
        1000 * (wrap_us + 1000),
        1000 * (wrap_us + 5_000_000),
        EventKind.CLOCK_RESTARTED,
        70_000,
    ]
    (notice,) = [each for each in found if isinstance(each, Notice)]
    assert notice.clock == "mcu"


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """A microcontroller's end, and the path of the host's."""
    controller, port = os.openpty()
    tty.setraw(port)
    yield controller, os.ttyname(port)
    os.close(port)
    os.close(controller)


def started(imu: Device) -> tuple[DeviceSource, Iterator[Reading]]:
    source = DeviceSource("test", [imu], lambda: small_rig(1), (0.01, 0.02))
    source.open()
    return source, source.readings()


def test_serial_imu_reads_port(terminal: tuple[int, str]) -> None:
    controller, path = terminal
    before_ns = host_ns()
    source, readings = started(SerialImu(path, BAUD))
    os.write(controller, b"0.3,1\n" + line(1000) + b"\x07\n" + line(2000)[:10])
    time.sleep(0.02)
    os.write(controller, line(2000)[10:] + line(3000))
    found = [next(readings) for _ in range(3)]
    assert [reading.stamp_ns for reading in found if isinstance(reading, ImuReading)] == [
        1_000_000,
        2_000_000,
        3_000_000,
    ]
    assert all(before_ns < reading.arrival_ns <= host_ns() for reading in found)
    assert {reading.clock for reading in found} == {f"serial:{path}"}
    (health,) = source.health()
    assert health.counts == {"bad_line": 1}
    assert health.connected
    source.close()


def test_serial_imu_unplugged_port_reconnects(tmp_path: Path) -> None:
    path = tmp_path / "ttyACM0"  # what udev would make of the device
    controller, port = os.openpty()
    tty.setraw(port)
    path.symlink_to(os.ttyname(port))
    source, readings = started(SerialImu(str(path), BAUD))
    os.write(controller, b"\n" + line(1000))
    assert next(readings).arrival_ns
    path.unlink()
    os.close(port)
    os.close(controller)
    lost = next(readings)
    assert isinstance(lost, Notice)
    assert lost.kind == EventKind.DEVICE_LOST
    controller, port = os.openpty()
    tty.setraw(port)
    path.symlink_to(os.ttyname(port))
    back = next(readings)
    assert isinstance(back, Notice)
    assert (back.kind, back.clock) == (EventKind.DEVICE_BACK, f"serial:{path}")
    os.write(controller, b"\n" + line(500))
    sample = next(readings)
    assert isinstance(sample, ImuReading)
    assert sample.stamp_ns == 500_000
    source.close()
    os.close(port)
    os.close(controller)


def test_serial_imu_missing_port_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="cannot be opened as a serial port"):
        SerialImu(str(tmp_path / "ttyACM9"), BAUD).start(lambda reading: None)


@pytest.mark.parametrize(
    ("kind", "stored", "values"),
    [
        ("le:s16/16>>0", [0x7FFF, 0x8000, 0xFFFF], [32767, -32768, -1]),
        ("be:s12/16>>4", [0x7FF5, 0x800A, 0xFFFF], [2047, -2048, -1]),
        ("le:u12/16>>0", [0xF800, 0x1FFF, 0x0001], [2048, 4095, 1]),
        ("le:s64/64>>0", [(1 << 64) - 5, 5, 1 << 62], [-5, 5, 1 << 62]),
        ("le:s24/32>>8", [0x800000FF, 0x7FFFFF00, 0x100], [-(1 << 23), (1 << 23) - 1, 1]),
    ],
)
def test_scan_element_values(kind: str, stored: list[int], values: list[int]) -> None:
    element = ScanElement.parse("in_accel_x", "0\n", kind)
    raw = np.array(stored, np.uint64).astype(f"<u{element.storage_bytes}")
    assert element.values(raw).tolist() == values


@pytest.mark.parametrize("kind", ["le:s16/16", "xe:s16/16>>0", "le:s16/16X3>>0", "le:s40/40>>0", "le:s16/16>>4"])
def test_scan_element_bad_type_is_refused(kind: str) -> None:
    with pytest.raises(SourceError, match="in_accel_x"):
        ScanElement.parse("in_accel_x", "0", kind)


def test_scan_format_matches_kernel_layout() -> None:
    kinds = {"in_accel_x": "le:s16/16>>0", "in_accel_y": "be:s32/32>>0", "in_timestamp": "le:s64/64>>0"}
    made = ScanFormat([ScanElement.parse(name, str(k), kind) for k, (name, kind) in enumerate(kinds.items())])
    assert made.dtype.itemsize == 16  # 2, 2 of padding, 4, 8
    data = struct.pack("<h2x", -7) + struct.pack(">i", -70_000) + struct.pack("<q", 10**18)
    scans = np.frombuffer(data, made.dtype)
    assert [made.channel(scans, name)[0] for name in kinds] == [-7, -70_000, 10**18]


def test_mount_matrix_is_rotation() -> None:
    np.testing.assert_array_equal(mount_matrix("0, 1, 0; -1, 0, 0; 0, 0, 1\n") @ [1, 2, 3], [2, -1, 3])
    for text in ("1, 0; 0, 1", "1, 0, 0; 0, 1, 0; 0, 0, -1", "a", "0, 0, 0; 0, 0, 0; 0, 0, 0"):
        with pytest.raises(SourceError, match="not a rotation"):
            mount_matrix(text)


class Tree:
    """What the kernel shows of an IIO device, in a folder; its character device is a pipe."""

    def __init__(self, root: Path, number: int, name: str, kinds: tuple[str, ...], clock: bool = True) -> None:
        self.folder = root / "sys" / f"iio:device{number}"
        self.device = root / "dev" / f"iio:device{number}"
        (self.folder / "scan_elements").mkdir(parents=True)
        (self.folder / "buffer").mkdir()
        self.device.parent.mkdir(exist_ok=True)
        os.mkfifo(self.device)
        files = {"name": name, "buffer/enable": "1", "buffer/length": "2", "sampling_frequency": "100"}
        if clock:
            files["current_timestamp_clock"] = "realtime"
        channels = [f"in_{kind}_{axis}" for kind in kinds for axis in "xyz"]
        for index, channel in enumerate([*channels, "in_temp", "in_timestamp"]):
            files[f"scan_elements/{channel}_en"] = "1" if channel == "in_temp" else "0"
            files[f"scan_elements/{channel}_index"] = str(index)
            files[f"scan_elements/{channel}_type"] = "le:s64/64>>0" if channel == "in_timestamp" else "be:s16/16>>0"
        for kind in kinds:
            files[f"in_{kind}_scale"] = "0.001" if kind == "anglvel" else "0.01"
        for file, text in files.items():
            self.write(file, text)
        self._pipe = -1

    def write(self, file: str, text: str) -> None:
        (self.folder / file).parent.mkdir(exist_ok=True)
        (self.folder / file).write_text(text + "\n")

    def read(self, file: str) -> str:
        return (self.folder / file).read_text().strip()

    def scan(self, stamp_ns: int, *values: int) -> bytes:
        packed = struct.pack(f">{len(values)}h", *values)
        return packed + bytes(-len(packed) % 8) + struct.pack("<q", stamp_ns)

    def feed(self, data: bytes) -> None:
        if self._pipe < 0:
            self._pipe = os.open(self.device, os.O_WRONLY)
        os.write(self._pipe, data)

    def unplug(self) -> None:
        os.close(self._pipe)
        self._pipe = -1

    def imu(self, names: list[str], rate_hz: float | None = None) -> IioImu:
        return IioImu(names, rate_hz, self.folder.parent, self.device.parent)


def test_iio_imu_reads_device(tmp_path: Path) -> None:
    tree = Tree(tmp_path, 0, "bmi088", ("anglvel", "accel"))
    tree.write("in_mount_matrix", "0, 1, 0; -1, 0, 0; 0, 0, 1")
    tree.write("in_accel_x_offset", "10")
    now_ns = time.monotonic_ns()
    data = b"".join(tree.scan(now_ns + 5_000_000 * k, 100, -200, 300, 0, 50, 981 + k) for k in range(3))
    reader = os.open(tree.device, os.O_RDONLY | os.O_NONBLOCK)  # so that the pipe keeps what is fed before the start
    tree.feed(data[:20])
    source, readings = started(tree.imu(["bmi088"], 200.0))
    os.close(reader)
    tree.feed(data[20:])
    found = [next(readings) for _ in range(3)]
    for k, reading in enumerate(found):
        assert isinstance(reading, ImuReading)
        np.testing.assert_allclose(reading.angular_velocity, [-0.2, -0.1, 0.3])
        np.testing.assert_allclose(reading.linear_acceleration, [0.5, -0.1, 9.81 + 0.01 * k])
        assert reading.clock is None
        assert abs(reading.stamp_ns - 5_000_000 * k - (host_ns() - (time.monotonic_ns() - now_ns))) < 100_000_000
    assert tree.read("buffer/enable") == "1"
    assert tree.read("sampling_frequency") == "200"
    assert tree.read("current_timestamp_clock") == "monotonic"
    assert tree.read("scan_elements/in_temp_en") == "0"
    assert tree.read("scan_elements/in_accel_z_en") == "1"
    tree.unplug()
    lost = next(readings)
    assert isinstance(lost, Notice)
    assert "has ended" in lost.detail
    source.close()
    assert tree.read("buffer/enable") == "0"


def test_iio_imu_merges_two_devices(tmp_path: Path) -> None:
    gyro = Tree(tmp_path, 0, "gyro_3d", ("anglvel",), clock=False)
    accel = Tree(tmp_path, 1, "accel_3d", ("accel",), clock=False)
    holders = [os.open(tree.device, os.O_RDWR | os.O_NONBLOCK) for tree in (gyro, accel)]
    source, readings = started(gyro.imu(["gyro_3d", "iio:device1"]))
    now_ns = time.time_ns()
    for k in range(4):
        accel.feed(accel.scan(now_ns + 10_000_000 * k, 0, 100 * k, 0))
        gyro.feed(gyro.scan(now_ns + 10_000_000 * k + 2_500_000, 1, 2, 3))
    found = [next(readings) for _ in range(3)]
    accelerations = [reading.linear_acceleration[1] for reading in found if isinstance(reading, ImuReading)]
    np.testing.assert_allclose(accelerations, [0.25, 1.25, 2.25], atol=0.02)  # by two clocks
    source.close()
    for holder in holders:
        os.close(holder)


def test_iio_imu_unusable_device_is_refused(tmp_path: Path) -> None:
    tree = Tree(tmp_path, 0, "gyro_3d", ("anglvel",))

    def refusal(imu: IioImu) -> str:
        with pytest.raises(SourceError) as caught:
            imu.start(lambda reading: None)
        imu.stop()
        return str(caught.value)

    assert "there are iio:device0, gyro_3d" in refusal(tree.imu(["bmi088"]))
    assert "no channels in_accel_x" in refusal(tree.imu(["gyro_3d"]))
    accel = Tree(tmp_path, 1, "accel_3d", ("accel",))
    accel.write("trigger/current_trigger", "")
    assert "has no trigger" in refusal(tree.imu(["gyro_3d", "accel_3d"]))
    (accel.folder / "in_accel_scale").unlink()
    assert "has no file in_accel_scale" in refusal(tree.imu(["gyro_3d", "accel_3d"]))
    assert "there is no IIO device" in refusal(IioImu(["a"], None, tmp_path / "none", tmp_path))


def test_iio_imu_uses_own_trigger(tmp_path: Path) -> None:
    tree = Tree(tmp_path, 3, "mpu6050", ("anglvel", "accel"))
    tree.write("trigger/current_trigger", "")
    (tree.folder.parent / "trigger0").mkdir()
    (tree.folder.parent / "trigger0/name").write_text("other-dev2\n")
    (tree.folder.parent / "trigger1").mkdir()
    (tree.folder.parent / "trigger1/name").write_text("mpu6050-dev3\n")
    imu = tree.imu(["mpu6050"])
    imu.start(lambda reading: None)
    assert tree.read("trigger/current_trigger") == "mpu6050-dev3"
    imu.stop()
