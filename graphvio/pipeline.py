"""A whole run of the odometry, from a source to results."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from graphvio.arrays import Float
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.events import Event, EventKind
from graphvio.measurements.sensors import FrameSet
from graphvio.measurements.window_views import FirstWindow, WindowViews
from graphvio.odometry import Odometry
from graphvio.odometry.step import Step
from graphvio.results import FinishedRun, ResultWriter, Summary
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.findings import described
from graphvio.sources import Source

RESETS = (
    EventKind.GATE_RESET,
    EventKind.NEW_EPOCH,
    EventKind.WINDOW_REBUILT,
    EventKind.IMU_CAME,
    EventKind.TIME_JUMP,
)
"""Kinds of events after which the estimator is reinitialised."""

_MAX_PENDING_FRAMESETS = 100


@dataclass
class Progress:
    """The progress of a run.

    Attributes:
        framesets: number of framesets estimated so far.
        total: largest number of framesets that the source will yield.
        recorded_s: time covered, by the recording's clock.
        wall_s: time spent.
        distance_m: path length so far.
        latest: newest estimate.
    """

    framesets: int
    total: int
    recorded_s: float
    wall_s: float
    distance_m: float
    latest: Estimate


def _ignore(*_: object) -> None:
    """Default callback."""


@dataclass(frozen=True, kw_only=True)
class RunListener:
    """Callbacks that follow a run, in the thread of the run.

    Attributes:
        on_step: receives each step of the odometry, see `graphvio.odometry.Odometry.subscribe`.
        on_estimate: receives the frameset (None if it is no longer in memory) and its estimate.
        on_event: receives each event of the odometry.
        on_calibration: receives the stamp of the frameset and each calibration that came into force.
        on_smoothed: receives stamps and poses ``nav_T_body`` (4, 4) that have left the smoother's window.
        on_views: receives the views of landmarks by a rig of single cameras only, see `graphvio.Odometry.on_views`.
        on_progress: receives the progress after each frameset.
    """

    on_step: Callable[[Step], None] = _ignore
    on_estimate: Callable[[FrameSet | None, Estimate], None] = _ignore
    on_event: Callable[[Event], None] = _ignore
    on_calibration: Callable[[int, CalibrationEstimate], None] = _ignore
    on_smoothed: Callable[[Sequence[tuple[int, Float]]], None] = _ignore
    on_views: Callable[[WindowViews | FirstWindow], None] = _ignore
    on_progress: Callable[[Progress], None] = _ignore


def run(source: Source, odometry: Odometry, writer: ResultWriter, listeners: Sequence[RunListener] = ()) -> Summary:
    """Run the odometry over a source and write the results.

    Args:
        source: source of the measurements.
        odometry: odometry that has processed nothing yet, of the source's rig or of that with another calibration.
        writer: writer of the results.
        listeners: listeners, called in this order.

    Raises:
        GraphvioError: if the source cannot be read or the folder not written.
    """
    return _Run(source, odometry, writer, listeners).execute()


class _Run:
    def __init__(
        self, source: Source, odometry: Odometry, writer: ResultWriter, listeners: Sequence[RunListener]
    ) -> None:
        self._source = source
        self._odometry = odometry
        for listener in listeners:
            self._odometry.subscribe(listener.on_step)
            if listener.on_views is not _ignore:
                self._odometry.on_views(listener.on_views)
        self._writer = writer
        self._listeners = listeners
        self._keeps_framesets = any(listener.on_estimate is not _ignore for listener in listeners)
        self._pending: OrderedDict[int, FrameSet] = OrderedDict()  # not yet estimated
        self._smoothed: list[tuple[int, Float]] = []
        self._frameset_ms: list[float] = []
        self._framesets = 0
        self._before_start = 0  # framesets without a pose while the odometry waits for the IMU
        self._resets = 0
        self._distance_m = 0.0
        self._previous: Estimate | None = None
        self._calibration: CalibrationEstimate | None = None
        self._start = perf_counter()

    def execute(self) -> Summary:
        """Process all measurements; the time that is measured for a frameset is that of the odometry alone."""
        for measurement in self._source:
            if isinstance(measurement, FrameSet):
                self._add_frameset(measurement)
            begin = perf_counter()
            estimate = self._odometry.process(measurement)
            if estimate is not None:
                self._frameset_ms.append(1e3 * (perf_counter() - begin))
                self._add_estimate(estimate)
        begin = perf_counter()
        for estimate in self._odometry.finish():
            self._frameset_ms.append(1e3 * (perf_counter() - begin))
            self._add_estimate(estimate)
            begin = perf_counter()
        wall_s = perf_counter() - self._start
        self._collect()
        for event in self._source.faults.events:
            self._writer.add_event(event)
        return self._writer.finish(self._finished(wall_s), self._source.truth)

    def _finished(self, wall_s: float) -> FinishedRun:
        """Return the data of the finished run, which took ``wall_s``."""
        framesets = self._framesets + self._source.faults.counts.get(EventKind.FRAMESET_EMPTY, 0)
        return FinishedRun(
            wall_s=wall_s,
            frameset_ms=self._frameset_ms,
            smoothed=sorted(self._smoothed, key=lambda stamped: stamped[0]),
            input_faults=self._source.faults.counts,
            framesets=framesets,
            awaited=framesets - self._before_start,
            resets=self._resets,
            warnings=self._odometry.rig_warnings,
            calibration=described(self._odometry.calibration_findings),
            refined_rig=self._odometry.refined_rig,
        )

    def _add_frameset(self, frameset: FrameSet) -> None:
        self._framesets += 1
        if self._keeps_framesets:
            self._pending[frameset.stamp_ns] = frameset
            if len(self._pending) > _MAX_PENDING_FRAMESETS:
                self._pending.popitem(last=False)

    def _add_estimate(self, estimate: Estimate) -> None:
        self._writer.add(estimate)
        self._add_calibration(estimate.stamp_ns)
        self._before_start += estimate.status is Status.INITIALISING and estimate.nav_T_body is None
        self._collect()
        frameset = self._pending.pop(estimate.stamp_ns, None)
        for listener in self._listeners:
            listener.on_estimate(frameset, estimate)
        if self._previous is not None and self._previous.epoch == estimate.epoch:
            self._distance_m += _distance(self._previous, estimate)
        self._previous = estimate
        progress = Progress(
            framesets=len(self._frameset_ms),
            total=self._source.frameset_count,
            recorded_s=(estimate.stamp_ns - self._source.start_ns) * 1e-9,
            wall_s=perf_counter() - self._start,
            distance_m=self._distance_m,
            latest=estimate,
        )
        for listener in self._listeners:
            listener.on_progress(progress)

    def _add_calibration(self, stamp_ns: int) -> None:
        calibration = self._odometry.calibration
        if calibration is None or calibration is self._calibration:
            return
        self._calibration = calibration
        self._writer.add_calibration(stamp_ns, calibration)
        for listener in self._listeners:
            listener.on_calibration(stamp_ns, calibration)

    def _collect(self) -> None:
        smoothed = self._odometry.take_smoothed()
        self._smoothed += smoothed
        for listener in self._listeners:
            listener.on_smoothed(smoothed)
        for event in self._odometry.take_events():
            self._resets += event.kind in RESETS
            self._writer.add_event(event)
            for listener in self._listeners:
                listener.on_event(event)


def _distance(before: Estimate, now: Estimate) -> float:
    if before.nav_T_body is None or now.nav_T_body is None:
        return 0.0
    return float(np.linalg.norm(now.nav_T_body[:3, 3] - before.nav_T_body[:3, 3]))
