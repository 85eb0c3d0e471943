"""The odometry on live sensors: capture, decoding, odometry and output, each in a thread of its own.

Front-end and back-end are one stage: the front-end looks for points where the back-end's newest state foretells them,
so that neither has anything to do while the other works. The front-end itself has a thread for each pair.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.errors import SourceError
from graphvio.events import Estimate, FrameSet, ImuSample, Incident, Prediction
from graphvio.live.broadcast import Broadcast
from graphvio.live.clock import ClockMaps
from graphvio.live.figures import figures
from graphvio.live.inbox import Inbox
from graphvio.live.load import LoadControl
from graphvio.live.meter import Meter
from graphvio.live.ordering import SampleOrder
from graphvio.live.output import Output
from graphvio.live.pairing import FramesetAssembler
from graphvio.live.pipe import Pipe
from graphvio.live.source import CameraFrame, DeviceHealth, ImuReading, LiveSource, Notice, host_ns
from graphvio.live.stage import Stage
from graphvio.live.watchdog import Watchdog
from graphvio.odometry import Odometry
from graphvio.rig import Rig
from graphvio.slam.keyframe import CorrectionResult
from graphvio.slam.keyframe_log import KeyframeLog

_WAITING_IMAGES = 64  # for decoding
_WAITING_FRAMESETS = 8  # for the odometry
_WAITING_RESULTS = 64  # for output
_KEPT_FRAMESETS = 64  # until they are estimated
_MISSING_SAMPLE_MS = 10.0  # so long one that others overtook is waited for
_ROUND_S = 0.05
_START_NS = 500_000_000
_END_S = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """An estimate with the images that it was made from, if they are still known."""

    estimate: Estimate
    frameset: FrameSet | None


@dataclass(frozen=True, slots=True, eq=False)
class _UnderWay:
    """A frameset in the odometry: when it came, and how long it had waited when it was taken."""

    frameset: FrameSet
    arrival_ns: int
    waited_ms: float


class LiveOdometry:
    """Runs the odometry on a source until it ends or is stopped; what `graphvio.slam.interface.Served` asks for.

    Args:
        source: opened.
        rig: that opening it gave.
        config: of all stages.
        outputs: what is handed all that comes and all that is made of it.
        wants_keyframes: whether keyframes are made.

    Attributes:
        rig: of the source.
        estimates: as they are made.
        predictions: at each sample of the IMU.
        incidents: as they happen.
        keyframe_log: the newest keyframes.
    """

    def __init__(
        self,
        source: LiveSource,
        rig: Rig,
        config: Config,
        outputs: Sequence[Output] = (),
        wants_keyframes: bool = False,
    ) -> None:
        self.rig = rig
        self.estimates: Broadcast[Estimate] = Broadcast()
        self.predictions: Broadcast[Prediction] = Broadcast()
        self.incidents: Broadcast[Incident] = Broadcast()
        self.keyframe_log = KeyframeLog()
        self._source = source
        self._config = config
        self._outputs = list(outputs)
        self._meter = Meter()
        self._odometry = Odometry(rig, config, on_prediction=self.predictions.publish)
        if wants_keyframes:
            self._odometry.on_keyframe(self.keyframe_log.add)
        self._clocks = ClockMaps(self._report)
        self._assembler = FramesetAssembler(
            rig, config.timing.simultaneous_ms, config.live.max_image_wait_ms, self._report
        )
        self._order = SampleOrder(_MISSING_SAMPLE_MS)
        self._load = LoadControl(config.live.max_latency_ms)
        self._corner_share = 1.0
        self._images: Pipe[tuple[CameraFrame, int]] = Pipe(_WAITING_IMAGES)
        self._inbox = Inbox(_WAITING_FRAMESETS, waits=not source.is_realtime)
        self._results: Pipe[Result] = Pipe(_WAITING_RESULTS)
        self._under_way: OrderedDict[int, _UnderWay] = OrderedDict()
        self._first_pose_ns: int | None = None  # when it was made
        self._temperature_c: float | None = None
        self._latest: Estimate | None = None
        self._last_reading_ns = self._started_ns = host_ns()
        self._failures: list[BaseException] = []  # as they came
        self._ended = threading.Event()
        self._stages = [
            Stage("capture", self._capture, self._fail, self._images.close),
            Stage("decode", self._decode, self._fail, self._end_decode),
            Stage("odometry", self._estimate, self._fail, self._end_odometry),
            Stage("output", self._put_out, self._fail, self._end_output),
        ]
        self._watchdog = Watchdog(self._stages, config.live.stuck_s, self._tell_now, self._silent_s)

    # ------------------------------------------------------------------ for its owner

    def add_output(self, output: Output) -> None:
        """Hand all to one more; before `start`."""
        self._outputs.append(output)

    def start(self) -> None:
        """Start all threads; what came before is not taken."""
        self._started_ns = host_ns()
        for stage in self._stages:
            stage.start()
        self._watchdog.start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for the end of the source; whether it, or a failure, has come.

        Raises:
            GraphvioError: what ended a stage before its time.
        """
        ended = self._ended.wait(timeout_s)
        self._raise_failure()
        return ended

    def stop(self) -> None:
        """Stop the source, work on what has come, and end all threads; a second time does nothing.

        Threads are waited for as long as anything gets on. One that does not is told as ``stage_stuck`` and left
        behind, and those after it end without what it has.

        Raises:
            GraphvioError: what ended a stage before its time.
        """
        self._source.close()
        feeds = (self._images.close, self._inbox.close, self._results.close, self._results.abandon)
        for stage, end_next in zip(self._stages, feeds, strict=True):
            if stage.is_alive and not self._ends(stage):
                self._tell_now("stage_stuck", f"{stage.name} does not end; left behind")
                end_next()
        self._close_listeners()
        self._ended.set()
        if self._watchdog.is_running:
            self._watchdog.stop()
        self._raise_failure()

    def _ends(self, stage: Stage) -> bool:
        """Whether a stage ends; it may take long as long as it gets on, or what it waits for does. Capture has to end
        at once where it need not wait, as its source was closed."""
        capture, *later = self._stages
        counted = later if not self._source.is_realtime else [stage] if stage is not capture else []
        done, since_s = -1, 0.0
        while not stage.join(_ROUND_S):
            if (now_done := sum(each.done for each in counted)) != done:
                done, since_s = now_done, time.monotonic()
            elif time.monotonic() - since_s > _END_S:
                return False
        return True

    @property
    def odometry(self) -> Odometry:
        """What estimates; its `predict`, `correct` and `map_T_body` may be asked from any thread."""
        return self._odometry

    @property
    def is_healthy(self) -> bool:
        """Whether all stages live and none is stuck."""
        return not self._watchdog.stuck and not self._watchdog.dead

    @property
    def devices(self) -> Sequence[DeviceHealth]:
        """Each device."""
        return self._source.health()

    # ------------------------------------------------------------------ for the services

    @property
    def map_T_odom(self) -> Float | None:
        """(4, 4) in force, or None before the epoch's first correction."""
        return self._odometry.map_T_odom

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """See `graphvio.Odometry.correct`."""
        return self._odometry.correct(keyframe_id, map_T_body, covariance)

    def status(self) -> Mapping[str, float | int | str | None]:
        """How it runs, by name."""
        now_ns = host_ns()
        return {
            "health": "ok" if self.is_healthy else "failing",
            "stuck": ",".join(sorted(self._watchdog.stuck | self._watchdog.dead)),
            "uptime_s": (now_ns - self._started_ns) * 1e-9,
            "silent_s": (now_ns - self._last_reading_ns) * 1e-9,
            "waiting_images": len(self._images),
            "waiting_framesets": self._inbox.framesets,
            "waiting_results": len(self._results),
            "corner_share": self._load.corner_share,
            "temperature_c": self._temperature_c,
            "skipped_no_room": self._inbox.dropped_framesets,
            "imu_lost": self._inbox.dropped_samples,
            **figures(self._meter, self._latest, now_ns),
            **{name: value for output in self._outputs for name, value in output.status().items()},
        }

    # ------------------------------------------------------------------ the stages

    def _capture(self, stage: Stage) -> None:
        """Sort what the source gives."""
        for reading in self._source.readings():
            with stage.working():
                self._last_reading_ns = host_ns()
                self._take(stage, reading)
        for sample in self._order.flush():
            self._bring(stage, sample, host_ns())

    def _take(self, stage: Stage, reading: ImuReading | CameraFrame | Notice) -> None:
        if isinstance(reading, Notice):
            self._clocks.doubt(reading.clock)
            self._report(reading.arrival_ns, reading.kind, reading.detail)
            return
        if self._source.is_realtime and reading.arrival_ns < self._started_ns:
            return  # sensors may have been started long before
        stamp_ns = self._clocks.map(reading.clock, reading.stamp_ns, reading.arrival_ns)
        if stamp_ns is None:
            return  # one wild stamp, or the first of a clock that begins anew: told by the clock
        if isinstance(reading, ImuReading):
            self._meter.came("imu_samples", reading.arrival_ns)
            self._temperature_c = reading.temperature_c
            came = ImuSample(stamp_ns, reading.angular_velocity, reading.linear_acceleration)
            for sample in self._order.add(came):
                self._bring(stage, sample, reading.arrival_ns)
            return
        self._meter.came("images", reading.arrival_ns)
        with stage.waiting():
            has_room = self._images.put((reading, stamp_ns), waits=not self._source.is_realtime)
        if not has_room:
            self._meter.count("images_not_decoded")

    def _decode(self, stage: Stage) -> None:
        """Decode images, and put them together to framesets."""
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

    def _end_decode(self) -> None:
        self._images.abandon()
        self._inbox.close()

    def _next_image(self, stage: Stage) -> tuple[CameraFrame, int] | None:
        """The next image; None at the end. While none comes, framesets that have waited long enough go on."""
        while (item := self._images.take(_ROUND_S)) is None and not self._images.is_finished:
            if not self._source.is_realtime:
                continue  # its images come when they are taken: time tells nothing of them
            now_ns = host_ns()
            for frameset in self._assembler.advance(now_ns):
                self._bring(stage, frameset, now_ns)
        return item

    def _bring(self, stage: Stage, event: ImuSample | FrameSet, arrival_ns: int) -> None:
        if isinstance(event, FrameSet):
            self._meter.came("framesets", arrival_ns)
        for output in self._outputs:
            output.add_event(event)
        with stage.waiting():
            self._inbox.put(event, arrival_ns)

    def _estimate(self, stage: Stage) -> None:
        """Feed the odometry, and give up what there is no time for."""
        while not self._inbox.is_finished:
            taken = self._inbox.take(_ROUND_S)
            if taken is None:
                continue
            with stage.working():
                self._process(stage, *taken)
        with stage.working():
            for estimate in self._odometry.finish():
                self._deliver(stage, estimate)

    def _end_odometry(self) -> None:
        self._inbox.abandon()
        try:
            self._tell_incidents()
        finally:
            self._results.close()

    def _process(self, stage: Stage, event: ImuSample | FrameSet, arrival_ns: int) -> None:
        begun_ns = host_ns()
        if isinstance(event, FrameSet):
            waited_ms = 1e-6 * (begun_ns - arrival_ns)
            if self._is_limited(arrival_ns) and self._load.must_skip(waited_ms, is_newest=not self._inbox.framesets):
                self._meter.count("skipped_late")
                return
            self._under_way[event.stamp_ns] = _UnderWay(event, arrival_ns, waited_ms)
            if len(self._under_way) > _KEPT_FRAMESETS:
                self._under_way.popitem(last=False)
        estimate = self._odometry.process(event)
        while estimate is not None:
            self._conclude(stage, estimate, begun_ns)
            stage.get_on()
            begun_ns = host_ns()
            estimate = self._odometry.process_due()
        self._tell_incidents()

    def _conclude(self, stage: Stage, estimate: Estimate, begun_ns: int) -> None:
        """An estimate has been made since then."""
        self._tell_incidents()
        under_way = self._under_way.get(estimate.stamp_ns)
        if under_way is not None and self._is_limited(under_way.arrival_ns):
            self._load.note(estimate.stamp_ns, under_way.waited_ms, 1e-6 * (host_ns() - begun_ns))
            if self._load.corner_share != self._corner_share:
                self._corner_share = self._load.corner_share
                self._odometry.limit_corners(self._corner_share)
        self._deliver(stage, estimate)

    def _deliver(self, stage: Stage, estimate: Estimate) -> None:
        under_way, now_ns = self._under_way.pop(estimate.stamp_ns, None), host_ns()
        self._odometry.take_smoothed()  # else they would gather
        self._latest = estimate
        self._meter.came("estimates", now_ns)
        self._meter.count(f"status_{estimate.status}")
        if self._first_pose_ns is None and estimate.nav_T_body is not None:
            self._first_pose_ns = now_ns
        if under_way is not None and self._is_after_start(under_way.arrival_ns):
            self._meter.add_latency(1e-6 * (now_ns - under_way.arrival_ns))
        self.estimates.publish(estimate)
        result = Result(estimate, None if under_way is None else under_way.frameset)
        with stage.waiting():
            has_room = self._results.put(result, waits=not self._source.is_realtime)
        if not has_room:
            self._meter.count("results_not_put_out")

    def _is_after_start(self, arrival_ns: int) -> bool:
        """Whether a frameset need not wait for what went before the first pose: those until then are held until the
        IMU has told the attitude to start from, and worked on all at once."""
        return self._first_pose_ns is not None and arrival_ns > self._first_pose_ns + _START_NS

    def _is_limited(self, arrival_ns: int) -> bool:
        """Whether the limit of the latency holds for a frameset."""
        return self._source.is_realtime and self._is_after_start(arrival_ns)

    def _put_out(self, stage: Stage) -> None:
        """Hand estimates to the outputs."""
        while (result := self._results.take()) is not None:
            with stage.working():
                for output in self._outputs:
                    output.add_result(result.estimate, result.frameset)

    def _end_output(self) -> None:
        self._results.abandon()
        self._close_listeners()
        self._ended.set()

    # ------------------------------------------------------------------ what is told

    def _report(self, stamp_ns: int, kind: str, detail: str) -> None:
        incident = Incident(stamp_ns, kind, detail)
        self._meter.count(f"incident_{kind}")
        self.incidents.publish(incident)
        for output in self._outputs:
            output.add_incident(incident)

    def _tell_now(self, kind: str, detail: str) -> None:
        self._report(host_ns(), kind, detail)

    def _tell_incidents(self) -> None:
        for incident in self._odometry.take_incidents():
            self._report(incident.stamp_ns, incident.kind, incident.detail)

    def _fail(self, stage: Stage, error: BaseException) -> None:
        """A stage is dead: the source ends, by which all others come to their end."""
        self._failures.append(error)
        with suppress(Exception):  # an output may be what failed
            self._tell_now("stage_failed", f"{stage.name}: {error}")
        self._ended.set()
        self._source.close()

    def _silent_s(self) -> float:
        """How long nothing has come from sensors that should deliver."""
        is_awaited = self._source.is_realtime and self._stages[0].is_alive
        return 1e-9 * (host_ns() - self._last_reading_ns) if is_awaited else 0.0

    def _raise_failure(self) -> None:
        if self._failures:
            raise self._failures[0]  # what came after may be for that

    def _close_listeners(self) -> None:
        self.keyframe_log.close()
        for broadcast in (self.estimates, self.predictions, self.incidents):
            broadcast.close()
