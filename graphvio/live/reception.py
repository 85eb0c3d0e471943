"""Conversion of device readings to IMU samples and framesets: stamps on one clock, images decoded, samples in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from heapq import heappop, heappush

from graphvio.config import Config
from graphvio.errors import SourceError
from graphvio.live.clocks import ClockMaps, SharedClock
from graphvio.live.figures import Meter
from graphvio.live.pairing import FramesetAssembler
from graphvio.live.source import LiveSource
from graphvio.live.stages import Stage
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.readings import CameraFrame, ImuReading, Notice, Reading, host_ns
from graphvio.measurements.sensors import ImuSample, Measurement
from graphvio.queues import BoundedQueue, WhenFull
from graphvio.rig import Imu, Rig
from graphvio.sources.matching import TOLERANCE_NS

_WAITING_IMAGES = 64  # images that wait to be decoded
_READ_AHEAD_IMAGES = 8  # likewise, of a source that waits for its reader
_MISSING_SAMPLE_MS = 10.0  # how long a sample that others overtook is waited for
_ROUND_S = 0.05
_MISSING_PERIODS = 1.5  # time between samples, in periods, from which one in between is missing or late
_PERIODS = 50  # number of newest periods that are averaged
_MIN_PERIODS = 8  # number of periods from which their mean replaces the rig's nominal one
_MAX_HELD = 1000

Deliver = Callable[[Stage, Measurement, int], None]
"""Takes the stage that delivers, a measurement, and the host time of its arrival."""


class Reception:
    """The stages ``capture``, which takes readings from the source, and ``decode``, which makes framesets of images.

    Args:
        source: the opened source.
        rig: the source's rig.
        config: configuration of all stages.
        meter: counts arrivals.
        report: takes events on readings that are left out.
        deliver: takes samples and framesets, from both stages.

    Attributes:
        images: images that wait to be decoded, with their stamps on the host's clock.
        started_ns: host time of the start; earlier readings are not used, as sensors may have been started long before.
        last_ns: host time of the newest reading.
        temperature_c: temperature of the IMU, or None.
    """

    def __init__(
        self, source: LiveSource, rig: Rig, config: Config, meter: Meter, report: Report, deliver: Deliver
    ) -> None:
        self.images: BoundedQueue[tuple[CameraFrame, int]] = (
            BoundedQueue(_WAITING_IMAGES, WhenFull.DROP_NEWEST)
            if source.is_realtime
            else BoundedQueue(_READ_AHEAD_IMAGES, WhenFull.WAIT)
        )
        self.started_ns = self.last_ns = host_ns()
        self.temperature_c: float | None = None
        self._source = source
        self._meter = meter
        self._report = report
        self._deliver = deliver
        self._clocks = ClockMaps(report)
        self._shared = SharedClock(report)  # clock of the readings that name none
        self._order = SampleOrder(_MISSING_SAMPLE_MS, (rig.imu or Imu()).rate_hz)
        set_ms = config.timing.simultaneous_ms
        tolerance_ms = 1e-6 * TOLERANCE_NS if set_ms is None else set_ms
        self._assembler = FramesetAssembler(rig, tolerance_ms, config.live.max_image_wait_ms, report)

    def start(self) -> None:
        """Use readings from now on."""
        self.started_ns = self.last_ns = host_ns()

    def capture(self, stage: Stage) -> None:
        """Take the source's readings until its end: deliver IMU samples, and queue images for decoding."""
        for reading in self._source.readings():
            with stage.working():
                self.last_ns = host_ns()
                self._take(stage, reading)
        for sample in self._order.flush():
            self._deliver(stage, sample, host_ns())

    def decode(self, stage: Stage) -> None:
        """Decode images and assemble them into framesets until there are no more."""
        while (item := self._next_image(stage)) is not None:
            frame, stamp_ns = item
            with stage.working():
                try:
                    image = frame.decode()
                except SourceError as error:
                    self._report(stamp_ns, EventKind.IMAGE_DAMAGED, str(error))
                    continue
                # A source that waits delivers when it is read: waiting times are then measured by its stamps.
                at_ns = frame.arrival_ns if self._source.is_realtime else stamp_ns
                for frameset in self._assembler.add(frame.camera, stamp_ns, image, at_ns):
                    self._deliver(stage, frameset, frame.arrival_ns)
        for frameset in self._assembler.flush():
            self._deliver(stage, frameset, host_ns())

    def _take(self, stage: Stage, reading: Reading) -> None:
        if isinstance(reading, Notice):
            self._clocks.expect_restart(reading.clock)
            self._report(reading.arrival_ns, reading.kind, reading.detail)
            return
        if self._source.is_realtime and reading.arrival_ns < self.started_ns:
            return
        stamp_ns = self._mapped(reading)
        if stamp_ns is None:
            return  # the clock has reported it
        if isinstance(reading, ImuReading):
            self._meter.add_arrival("imu_samples", reading.arrival_ns)
            self.temperature_c = reading.temperature_c
            sample = ImuSample(stamp_ns, reading.angular_velocity, reading.linear_acceleration)
            for each in self._order.add(sample):
                self._deliver(stage, each, reading.arrival_ns)
            return
        self._meter.add_arrival("images", reading.arrival_ns)
        with stage.waiting():
            has_room = self.images.put((reading, stamp_ns))
        if not has_room:
            self._meter.count("images_not_decoded")

    def _mapped(self, reading: ImuReading | CameraFrame) -> int | None:
        """Return a reading's stamp on the clock of all sensors, or None if it is implausible."""
        if reading.clock is None:
            return self._shared.map("imu" if isinstance(reading, ImuReading) else reading.camera, reading.stamp_ns)
        return self._clocks.map(reading.clock, reading.stamp_ns, reading.arrival_ns)

    def _next_image(self, stage: Stage) -> tuple[CameraFrame, int] | None:
        """Return the next image; None at the end. While none comes, deliver framesets that have waited long enough."""
        while (item := self.images.get(_ROUND_S)) is None and not self.images.is_finished:
            if not self._source.is_realtime:
                continue  # its images come when they are taken: the host's time does not count
            now_ns = host_ns()
            for frameset in self._assembler.advance(now_ns):
                self._deliver(stage, frameset, now_ns)
        return item


class SampleOrder:
    """Puts IMU samples in the order of their stamps, for links such as a network on which one may overtake another.

    A sample is held only if one is missing before it, so that none waits as long as none overtakes another.

    Args:
        max_wait_ms: how long a missing sample is waited for, measured by the stamps of the samples that come.
        rate_hz: nominal rate of the samples.
    """

    def __init__(self, max_wait_ms: float, rate_hz: float) -> None:
        self._max_wait_ns = round(1e6 * max_wait_ms)
        self._nominal_ns = 1e9 / rate_hz
        self._held: list[tuple[int, int, ImuSample]] = []  # a heap by stamp and order of arrival
        self._arrived = 0
        self._given_ns: int | None = None
        self._newest_ns: int | None = None
        self._steps_ns: deque[int] = deque(maxlen=_PERIODS)

    def add(self, sample: ImuSample) -> list[ImuSample]:
        """Add a sample, and return the samples that are passed on, in order.

        A sample that is older than those passed on before is passed on at once: the odometry reports it.
        """
        if self._given_ns is not None and sample.stamp_ns <= self._given_ns:
            return [sample]
        self._arrived += 1
        heappush(self._held, (sample.stamp_ns, self._arrived, sample))
        self._newest_ns = sample.stamp_ns if self._newest_ns is None else max(self._newest_ns, sample.stamp_ns)
        given = []
        while self._held and self._may_go_on(self._held[0][0]):
            given.append(heappop(self._held)[2])
            if self._given_ns is not None:
                self._steps_ns.append(given[-1].stamp_ns - self._given_ns)
            self._given_ns = given[-1].stamp_ns
        return given

    def flush(self) -> list[ImuSample]:
        """Return all samples that are held, in order."""
        held, self._held = self._held, []
        return [sample for _, _, sample in sorted(held, key=lambda each: each[:2])]

    def _may_go_on(self, stamp_ns: int) -> bool:
        assert self._newest_ns is not None
        if self._given_ns is None or len(self._held) > _MAX_HELD:
            return True
        steps = self._steps_ns
        period_ns = self._nominal_ns if len(steps) < _MIN_PERIODS else sum(steps) / len(steps)
        follows = stamp_ns - self._given_ns < _MISSING_PERIODS * period_ns
        return follows or self._newest_ns - stamp_ns >= self._max_wait_ns
