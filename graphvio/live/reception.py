"""What sensors deliver, until it is samples and framesets: stamps on one clock, images decoded and put together."""

from __future__ import annotations

from collections.abc import Callable

from graphvio.config import Config
from graphvio.errors import SourceError
from graphvio.live.clock import ClockMaps
from graphvio.live.meter import Meter
from graphvio.live.ordering import SampleOrder
from graphvio.live.pairing import FramesetAssembler
from graphvio.live.shared_clock import SharedClock
from graphvio.live.source import LiveSource
from graphvio.live.stage import Stage
from graphvio.measurements.events import Report
from graphvio.measurements.readings import CameraFrame, ImuReading, Notice, host_ns
from graphvio.measurements.sensors import ImuSample, Measurement
from graphvio.queues import BoundedQueue, WhenFull
from graphvio.rig import Imu, Rig

_WAITING_IMAGES = 64  # for decoding
_READ_AHEAD_IMAGES = 8  # likewise, of a source that waits
_MISSING_SAMPLE_MS = 10.0  # so long one that others overtook is waited for
_ROUND_S = 0.05

Bring = Callable[[Stage, Measurement, int], None]
"""Takes the stage that brings it, a measurement, and when it came."""


class Reception:
    """The stages ``capture`` and ``decode``.

    Args:
        source: opened.
        rig: of it.
        config: of all stages.
        meter: counts what comes.
        report: is told what had to be left out.
        bring: is handed samples and framesets, from both stages.

    Attributes:
        images: that wait to be decoded.
        started_ns: what came before is not taken: sensors may have been started long before.
        last_ns: when something came last.
        temperature_c: of the IMU, or None.
    """

    def __init__(
        self, source: LiveSource, rig: Rig, config: Config, meter: Meter, report: Report, bring: Bring
    ) -> None:
        most_images = _WAITING_IMAGES if source.is_realtime else _READ_AHEAD_IMAGES
        when_full = WhenFull.DROP_NEWEST if source.is_realtime else WhenFull.WAIT
        self.images: BoundedQueue[tuple[CameraFrame, int]] = BoundedQueue(most_images, when_full)
        self.started_ns = self.last_ns = host_ns()
        self.temperature_c: float | None = None
        self._source = source
        self._meter = meter
        self._report = report
        self._bring = bring
        self._clocks = ClockMaps(report)
        self._shared = SharedClock(report)  # of the readings that name no clock
        self._order = SampleOrder(_MISSING_SAMPLE_MS, (rig.imu or Imu()).rate_hz)
        self._assembler = FramesetAssembler(rig, config.timing.simultaneous_ms, config.live.max_image_wait_ms, report)

    def begin(self) -> None:
        """From now on what comes is taken."""
        self.started_ns = self.last_ns = host_ns()

    def capture(self, stage: Stage) -> None:
        """Sort what the source gives, until its end."""
        for reading in self._source.readings():
            with stage.working():
                self.last_ns = host_ns()
                self._take(stage, reading)
        for sample in self._order.flush():
            self._bring(stage, sample, host_ns())

    def decode(self, stage: Stage) -> None:
        """Decode images, and put them together to framesets, until there are no more."""
        while (item := self._next_image(stage)) is not None:
            frame, stamp_ns = item
            with stage.working():
                try:
                    image = frame.decode()
                except SourceError as error:
                    self._report(stamp_ns, "image_damaged", str(error))
                    continue
                for frameset in self._assembler.add(frame.camera, stamp_ns, image, frame.arrival_ns):
                    self._bring(stage, frameset, frame.arrival_ns)
        for frameset in self._assembler.flush():
            self._bring(stage, frameset, host_ns())

    def _take(self, stage: Stage, reading: ImuReading | CameraFrame | Notice) -> None:
        if isinstance(reading, Notice):
            self._clocks.doubt(reading.clock)
            self._report(reading.arrival_ns, reading.kind, reading.detail)
            return
        if self._source.is_realtime and reading.arrival_ns < self.started_ns:
            return
        stamp_ns = self._mapped(reading)
        if stamp_ns is None:
            return  # one wild stamp, or the first of a clock that begins anew: told by the clock
        if isinstance(reading, ImuReading):
            self._meter.came("imu_samples", reading.arrival_ns)
            self.temperature_c = reading.temperature_c
            came = ImuSample(stamp_ns, reading.angular_velocity, reading.linear_acceleration)
            for sample in self._order.add(came):
                self._bring(stage, sample, reading.arrival_ns)
            return
        self._meter.came("images", reading.arrival_ns)
        with stage.waiting():
            has_room = self.images.put((reading, stamp_ns))
        if not has_room:
            self._meter.count("images_not_decoded")

    def _mapped(self, reading: ImuReading | CameraFrame) -> int | None:
        """Its stamp on the clock of all sensors, or None if it cannot be believed."""
        if reading.clock is None:
            return self._shared.map("imu" if isinstance(reading, ImuReading) else reading.camera, reading.stamp_ns)
        return self._clocks.map(reading.clock, reading.stamp_ns, reading.arrival_ns)

    def _next_image(self, stage: Stage) -> tuple[CameraFrame, int] | None:
        """The next image; None at the end. While none comes, framesets that have waited long enough go on."""
        while (item := self.images.get(_ROUND_S)) is None and not self.images.is_finished:
            if not self._source.is_realtime:
                continue  # its images come when they are taken: time tells nothing of them
            now_ns = host_ns()
            for frameset in self._assembler.advance(now_ns):
                self._bring(stage, frameset, now_ns)
        return item
