"""What live sources of sensors share: losses and returns, counters that wrap, IMUs whose parts tick apart."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from recordings import small_rig

from graphvio.errors import SourceError
from graphvio.live.device_clock import MicrosecondCounter, host_ns_of_monotonic, host_ns_of_realtime
from graphvio.live.devices import Counts, DeviceLostError, DeviceSource, HandOver, Mailbox
from graphvio.live.imu_merging import AccelOntoGyro
from graphvio.live.sources import SourceSpec
from graphvio.live.sources.spec_options import choice_of, names_of, number_of, size_of
from graphvio.measurements.events import EventKind
from graphvio.measurements.readings import ImuReading, Notice, Reading, host_ns
from graphvio.rig import Rig

QUICK = (0.01, 0.02)


def imu_reading(stamp_ns: int, arrival_ns: int | None = None) -> ImuReading:
    arrival_ns = stamp_ns if arrival_ns is None else arrival_ns
    return ImuReading(stamp_ns, np.array([1e-9 * stamp_ns, 0.0, 0.0]), np.zeros(3), arrival_ns, "clock")


class Script:
    """A device with scripted lives: the number of readings of each, then how it ends."""

    clock = "script"

    def __init__(self, name: str, lives: list[tuple[int, Exception | None]], absences: int = 0) -> None:
        self.name = name
        self.lives, self.absences = iter(lives), absences
        self.started, self.stops = 0, 0
        self.counts = Counts()
        self.counts.add("frames_lost", 3)
        self.counts.add("other", 0)

    def start(self, hand_over: HandOver) -> None:
        if self.started and self.absences:
            self.absences -= 1
            raise SourceError(f"{self.name}: is not there")
        self.started += 1

    def run(self, hand_over: HandOver, stopping: threading.Event) -> None:
        count, end = next(self.lives)
        for k in range(count):
            hand_over(imu_reading(k, host_ns()))
        if end is not None:
            raise end
        stopping.wait()

    def stop(self) -> None:
        self.stops += 1
        raise RuntimeError("it is gone")  # as drivers do; it must not matter

    def detail(self) -> str:
        return "model"


def take(readings: Iterator[Reading], count: int) -> list[Reading]:
    return [next(readings) for _ in range(count)]


def test_device_source_lost_device_is_reported_and_restarted() -> None:
    device = Script(
        "a", [(2, DeviceLostError("unplugged")), (1, ValueError("what drivers say")), (1, None)], absences=2
    )
    source = DeviceSource("test", [device], lambda: small_rig(1), QUICK)
    assert isinstance(source.open(), Rig)
    found = take(source.readings(), 8)
    kinds = [reading.kind if isinstance(reading, Notice) else "imu" for reading in found]
    assert kinds == [
        "imu",
        "imu",
        EventKind.DEVICE_LOST,
        EventKind.DEVICE_BACK,
        "imu",
        EventKind.DEVICE_LOST,
        EventKind.DEVICE_BACK,
        "imu",
    ]
    notices = [reading for reading in found if isinstance(reading, Notice)]
    assert notices[0].detail == "a: unplugged"
    assert notices[2].detail == "a: ValueError: what drivers say"
    assert {notice.clock for notice in notices} == {"script"}
    (health,) = source.health()
    assert health.connected
    assert health.counts == {"frames_lost": 3, "device_lost": 2}
    source.close()
    assert device.started == 3
    assert device.stops >= 3


def test_device_source_missing_device_stays_reported() -> None:
    device = Script("a", [(0, DeviceLostError("unplugged"))], absences=10**9)
    source = DeviceSource("test", [device], lambda: small_rig(1), QUICK)
    source.open()
    take(source.readings(), 1)
    limit_s = time.monotonic() + 10.0
    while "is not there" not in source.health()[0].detail:
        assert time.monotonic() < limit_s
        time.sleep(0.005)
    assert not source.health()[0].connected
    source.close()


def test_device_source_close_from_other_thread_ends_readings() -> None:
    source = DeviceSource("test", [Script("a", [(1, None)])], lambda: small_rig(1), QUICK)
    source.open()
    readings = source.readings()
    take(readings, 1)
    remaining: list[Reading] = []
    reader = threading.Thread(target=lambda: remaining.extend(readings))
    reader.start()
    source.close()
    source.close()
    reader.join(10.0)
    assert not reader.is_alive()
    assert remaining == []
    assert list(source.readings()) == []


def test_device_source_failing_open_stops_all_devices() -> None:
    first, second = Script("a", [(0, None)]), Script("b", [])
    second.started, second.absences = 1, 1
    source = DeviceSource("test", [first, second], lambda: small_rig(1), QUICK)
    with pytest.raises(SourceError, match="b: is not there"):
        source.open()
    assert first.stops == 1
    assert not any(thread.name in "ab" for thread in threading.enumerate())
    source.close()


def test_mailbox_drops_old_readings_but_no_notice() -> None:
    mailbox = Mailbox(max_age_ns=100)
    notice = Notice(EventKind.DEVICE_LOST, "a", 5)
    mailbox.put("a", imu_reading(0))
    mailbox.put("a", notice)
    for stamp_ns in (50, 150, 200):
        mailbox.put("b", imu_reading(stamp_ns))
    assert mailbox.get() is notice
    stamps = [reading.stamp_ns for _ in range(2) if isinstance(reading := mailbox.get(), ImuReading)]
    assert stamps == [150, 200]
    assert (mailbox.dropped("a"), mailbox.dropped("b")) == (1, 1)


def test_microsecond_counter_wraps_for_all_sensors() -> None:
    counter, wrap = MicrosecondCounter(), 1 << 32
    start_us = wrap - 1000.0
    assert counter.stamp_ns(start_us) == round(1e3 * start_us)
    assert counter.stamp_ns(500.0) == 1000 * (wrap + 500)
    assert counter.stamp_ns(start_us + 900.0) == round(1e3 * (start_us + 900.0))  # another sensor, not wrapped yet
    for k in range(1, 10):  # an hour and more, in steps of ten minutes
        stamp_us = 500 + 600_000_000 * k
        assert counter.stamp_ns(stamp_us % wrap) == 1000 * (wrap + stamp_us)
    assert MicrosecondCounter().stamp_ns(7.5 * wrap) == 7500 * wrap  # a wider counter is taken as it is


def test_kernel_stamps_convert_to_host_time() -> None:
    before_ns, monotonic_ns, after_ns = host_ns(), time.monotonic_ns(), host_ns()
    assert before_ns - 100_000 <= host_ns_of_monotonic(monotonic_ns) <= after_ns + 100_000
    before_ns, realtime_ns = host_ns(), time.time_ns()
    assert abs(host_ns_of_realtime(realtime_ns) - before_ns) < 100_000_000


def test_accel_onto_gyro_interpolates_at_gyro_stamps() -> None:
    found: list[ImuReading] = []
    counts = Counts()
    merging = AccelOntoGyro(found.append, counts)
    merging.add_gyro(imu_reading(5_000_000))  # before any acceleration
    for stamp_ns in (10_000_000, 20_000_000, 30_000_000):
        merging.add_accel(stamp_ns, np.array([0.0, 1e-6 * stamp_ns, 9.81]))
    for stamp_ns in (12_500_000, 20_000_000, 27_500_000, 32_500_000):  # late, as of another thread
        merging.add_gyro(imu_reading(stamp_ns))
    merging.add_gyro(imu_reading(32_500_000))
    merging.add_gyro(imu_reading(31_000_000))
    merging.add_accel(25_000_000, np.zeros(3))
    assert [reading.stamp_ns for reading in found] == [12_500_000, 20_000_000, 27_500_000]
    merging.add_accel(40_000_000, np.array([0.0, 40.0, 9.81]))
    assert [reading.stamp_ns for reading in found] == [12_500_000, 20_000_000, 27_500_000, 32_500_000]
    for reading in found:
        np.testing.assert_allclose(reading.linear_acceleration, [0.0, 1e-6 * reading.stamp_ns, 9.81])
        np.testing.assert_allclose(reading.angular_velocity, [1e-9 * reading.stamp_ns, 0.0, 0.0])
    assert counts.totals() == {"imu_unpaired": 1, "imu_out_of_order": 2}


def test_accel_onto_gyro_does_not_interpolate_over_gap() -> None:
    found: list[ImuReading] = []
    counts = Counts()
    merging = AccelOntoGyro(found.append, counts)
    merging.add_accel(0, np.zeros(3))
    merging.add_gyro(imu_reading(60_000_000))
    merging.add_accel(101_000_000, np.zeros(3))
    assert found == []
    assert counts.totals()["imu_unpaired"] == 1
    for stamp_ns in range(200_000_000, 200_000_300):  # an accelerometer that has stopped
        merging.add_gyro(imu_reading(stamp_ns))
    assert counts.totals()["imu_unpaired"] == 1 + 300 - 256


def test_spec_options_are_checked() -> None:
    spec = SourceSpec.parse("v4l2:a,b?size=1280x720&fps=30&layout=separate")
    assert size_of(spec, "size") == (1280, 720)
    assert size_of(spec, "other") is None
    assert number_of(spec, "fps", 1, 60) == 30.0
    assert choice_of(spec, "layout", ("one", "separate")) == "separate"
    assert choice_of(spec, "other", ("one", "separate")) == "one"
    assert names_of(spec) == ["a", "b"]
    with pytest.raises(SourceError, match="from 1 to 20"):
        number_of(spec, "fps", 1, 20)
    with pytest.raises(SourceError, match="write a number"):
        number_of(spec, "size", 1, 20)
    with pytest.raises(SourceError, match="write a number"):
        number_of(SourceSpec.parse("v4l2:a?fps=nan"), "fps", 1, 20)
    with pytest.raises(SourceError, match="WIDTHxHEIGHT"):
        size_of(spec, "fps")
    with pytest.raises(SourceError, match="choose one of one"):
        choice_of(spec, "layout", ("one",))
    for text in ("v4l2:a,a", "v4l2:a,", "v4l2:,"):
        with pytest.raises(SourceError, match="twice or not at all"):
            names_of(SourceSpec.parse(text))
