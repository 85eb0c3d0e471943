"""The odometry on live sensors, with a thread each for capture, decoding, odometry and outputs."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.live.estimation import FRAMESETS, Estimation
from graphvio.live.figures import Meter, device_figures, run_figures
from graphvio.live.outputs import Output
from graphvio.live.reception import Reception
from graphvio.live.source import LiveSource
from graphvio.live.stages import Stage, Watchdog
from graphvio.measurements.estimate import Estimate, Prediction
from graphvio.measurements.events import Event, EventKind
from graphvio.measurements.readings import DeviceHealth, host_ns
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.odometry import Odometry
from graphvio.queues import Broadcast
from graphvio.rig import Rig
from graphvio.slam.front_end import FrontEnd
from graphvio.slam.keyframe import CorrectionResult
from graphvio.slam.keyframe_log import KeyframeLog

_ROUND_S = 0.05
_END_S = 10.0


class LiveOdometry:
    """Runs the odometry on a source until it ends or is stopped; implements `graphvio.slam.interface.Served`.

    Args:
        source: the opened source.
        rig: the rig that opening the source returned.
        config: configuration of all stages.
        outputs: consumers of all measurements and results.
        wants_keyframes: whether keyframes are made.

    Attributes:
        rig: the source's rig.
        config: configuration of all stages.
        odometry: the odometry, whose `predict` may be called from any thread.
        estimates: broadcast of the estimates of the framesets.
        predictions: broadcast of the predictions at each IMU sample.
        events: broadcast of the run's events.
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
        self.events: Broadcast[Event] = Broadcast()
        self.keyframe_log = KeyframeLog()
        self._source = source
        self.config = config
        self._outputs = list(outputs)
        self._meter = Meter()
        self.odometry = Odometry(rig, config, on_prediction=self.predictions.publish)
        self._front_end = FrontEnd(self.odometry)
        if wants_keyframes:
            self._front_end.on_keyframe(self.keyframe_log.add)
        self._reception = Reception(source, rig, config, self._meter, self._report, self._deliver)
        self._estimation = Estimation(
            self.odometry,
            config.live,
            source.is_realtime,
            self._meter,
            self.estimates.publish,
            self._report_events,
        )
        self._failures: list[BaseException] = []
        self._ended = threading.Event()
        self._stages = [
            Stage("capture", self._reception.capture, self._fail, self._reception.images.close),
            Stage("decode", self._reception.decode, self._fail, self._end_decoding),
            Stage("odometry", self._estimation.estimate, self._fail, self._end_odometry),
            Stage("output", self._put_out, self._fail, self._end_outputs),
        ]
        self._watchdog = Watchdog(self._stages, config.live.stuck_s, self._report_now, self._silences_s)

    def add_output(self, output: Output) -> None:
        """Add a consumer of all measurements and results; before `start`."""
        self._outputs.append(output)

    def start(self) -> None:
        """Start all threads; readings from before the start are not used."""
        self._reception.start()
        for stage in self._stages:
            stage.start()
        self._watchdog.start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for the end of the source, at most for a time, and return whether the run has ended.

        Raises:
            GraphvioError: the error that ended a stage.
        """
        ended = self._ended.wait(timeout_s)
        self._raise_failure()
        return ended

    def stop(self) -> None:
        """Stop the source, process all that has come, and end all threads; a second call does nothing.

        Threads are waited for as long as they make progress. One that makes none is reported as ``stage_stuck`` and
        left behind, and the stages after it end without the items that it holds.

        Raises:
            GraphvioError: the error that ended a stage.
        """
        self._source.close()
        images, inbox, results = self._reception.images, self._estimation.inbox, self._estimation.results
        feeds = (images.close, inbox.close, results.close, results.abandon)
        for stage, end_next in zip(self._stages, feeds, strict=True):
            if stage.is_alive and not self._ends(stage):
                self._report_now(EventKind.STAGE_STUCK, f"{stage.name} does not end; left behind")
                end_next()
        self._close_broadcasts()
        self._ended.set()
        self._watchdog.stop()
        self._raise_failure()

    def _ends(self, stage: Stage) -> bool:
        """Wait for a stage while it, or the stages that it waits for, make progress; return whether it ended.

        In real time, capture waits for no stage, and has to end within `_END_S` as its source was closed.
        """
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
    def is_healthy(self) -> bool:
        """Whether all stages run and none is stuck."""
        return not self._watchdog.stuck and not self._watchdog.dead

    @property
    def devices(self) -> Sequence[DeviceHealth]:
        """State of each device."""
        return self._source.health()

    @property
    def map_T_odom(self) -> Float | None:
        """The correction in force (4, 4), or None before the first correction of the epoch."""
        return self._front_end.map_T_odom

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """See `graphvio.slam.FrontEnd.correct`."""
        return self._front_end.correct(keyframe_id, map_T_body, covariance)

    def status(self) -> Mapping[str, float | int | str | None]:
        """Return the figures of the run by name; from any thread."""
        now_ns = host_ns()
        return {
            "health": "ok" if self.is_healthy else "failing",
            "stuck": ",".join(sorted(self._watchdog.stuck | self._watchdog.dead)),
            "uptime_s": (now_ns - self._reception.started_ns) * 1e-9,
            "silent_s": (now_ns - self._reception.last_ns) * 1e-9,
            "waiting_images": len(self._reception.images),
            "waiting_framesets": self._estimation.inbox.waiting(FRAMESETS),
            "waiting_results": len(self._estimation.results),
            "corner_share": self._estimation.load.corner_share,
            "temperature_c": self._reception.temperature_c,
            "skipped_no_room": self._estimation.inbox.dropped(FRAMESETS),
            "imu_lost": self._estimation.inbox.dropped(),
            **run_figures(self._meter, self._estimation.latest, now_ns),
            **device_figures(self._source.health()),
            **{name: value for output in self._outputs for name, value in output.status().items()},
        }

    # ------------------------------------------------------------------ the stages

    def _end_decoding(self) -> None:
        self._reception.images.abandon()
        self._estimation.inbox.close()

    def _deliver(self, stage: Stage, measurement: Measurement, arrival_ns: int) -> None:
        is_frameset = isinstance(measurement, FrameSet)
        if is_frameset:
            self._meter.add_arrival("framesets", arrival_ns)
        for output in self._outputs:
            output.add_measurement(measurement)
        with stage.waiting():
            self._estimation.inbox.put((measurement, arrival_ns), FRAMESETS if is_frameset else "")

    def _end_odometry(self) -> None:
        self._estimation.inbox.abandon()
        try:
            self._report_events()
        finally:
            self._estimation.results.close()

    def _put_out(self, stage: Stage) -> None:
        """Hand estimates to the outputs until there are no more."""
        while (result := self._estimation.results.get()) is not None:
            with stage.working():
                for output in self._outputs:
                    output.add_result(*result)

    def _end_outputs(self) -> None:
        self._estimation.results.abandon()
        self._close_broadcasts()
        self._ended.set()

    # ------------------------------------------------------------------ events and failures

    def _report(self, stamp_ns: int, kind: str, detail: str) -> None:
        event = Event(stamp_ns, kind, detail)
        self._meter.count(f"event_{kind}")
        self.events.publish(event)
        for output in self._outputs:
            output.add_event(event)

    def _report_now(self, kind: str, detail: str) -> None:
        self._report(host_ns(), kind, detail)

    def _report_events(self) -> None:
        for event in self.odometry.take_events():
            self._report(event.stamp_ns, event.kind, event.detail)

    def _fail(self, stage: Stage, error: BaseException) -> None:
        """Report a stage that failed, and close the source, so that all other stages come to their end."""
        self._failures.append(error)
        with suppress(Exception):  # an output may be what failed
            self._report_now(EventKind.STAGE_FAILED, f"{stage.name}: {error}")
        self._ended.set()
        self._source.close()

    def _silences_s(self) -> Mapping[str, float]:
        """Return the time since the last reading by kind of sensor, of the kinds that should deliver."""
        if not (self._source.is_realtime and self._stages[0].is_alive):
            return {}
        awaited = {"cameras": "images"} | ({} if self.rig.imu is None else {"imu": "imu_samples"})
        started_ns, now_ns = self._reception.started_ns, host_ns()
        return {
            kind: 1e-9 * (now_ns - max(self._meter.newest_ns(counted) or started_ns, started_ns))
            for kind, counted in awaited.items()
        }

    def _raise_failure(self) -> None:
        if self._failures:
            raise self._failures[0]  # later ones may be consequences of it

    def _close_broadcasts(self) -> None:
        self.keyframe_log.close()
        for broadcast in (self.estimates, self.predictions, self.events):
            broadcast.close()
