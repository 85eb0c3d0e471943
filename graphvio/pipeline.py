"""A whole run: source -> odometry -> results and viewer."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.odometry import Odometry
from graphvio.optimization.record import Recorder
from graphvio.results import ResultWriter, Summary
from graphvio.sources import Source
from graphvio.viewer import Viewer

RESETS = ("gate_reset", "new_epoch", "window_rebuilt", "imu_came", "time_jump")
"""Kinds of events after which the estimation started anew."""

_KEPT_FRAMESETS = 100  # held by the odometry for lack of IMU samples, at the most


@dataclass
class Progress:
    """How far a run has come.

    Attributes:
        framesets: estimated so far.
        total: framesets that the source will yield at most.
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


def run(
    source: Source,
    config: Config,
    writer: ResultWriter,
    *,
    viewer: Viewer | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    recorder: Recorder | None = None,
) -> Summary:
    """Run the odometry over a source and write the results.

    Args:
        source: of the measurements; its rig is used.
        config: of the odometry.
        writer: of the results.
        viewer: shows or saves what happens, or None.
        on_progress: called after each frameset.
        recorder: takes all that an optimisation of the session needs, or None.

    Raises:
        GraphvioError: if the source cannot be read or the folder not written.
    """
    odometry = Odometry(source.rig, config, on_step=None if recorder is None else recorder.add)
    return _Run(source, odometry, writer, viewer, on_progress, recorder).go()


class _Run:
    def __init__(
        self,
        source: Source,
        odometry: Odometry,
        writer: ResultWriter,
        viewer: Viewer | None,
        on_progress: Callable[[Progress], None] | None,
        recorder: Recorder | None,
    ) -> None:
        self._source = source
        self._odometry = odometry
        self._writer = writer
        self._viewer = viewer
        self._on_progress = on_progress
        self._recorder = recorder
        self._waiting: OrderedDict[int, FrameSet] = OrderedDict()  # for the viewer, until they are estimated
        self._smoothed: list[tuple[int, Float]] = []
        self._frameset_ms: list[float] = []
        self._delivered = 0
        self._before_start = 0  # framesets that came before the IMU did: no pose can be asked of them
        self._resets = 0
        self._distance_m = 0.0
        self._last: Estimate | None = None
        self._start = perf_counter()

    def go(self) -> Summary:
        """Feed every measurement, then what is still held; only the odometry's own time is taken for a frameset's."""
        for measurement in self._source:
            self._remember(measurement)
            begin = perf_counter()
            estimate = self._odometry.process(measurement)
            if estimate is not None:
                self._frameset_ms.append(1e3 * (perf_counter() - begin))
                self._take(estimate)
        begin = perf_counter()
        for estimate in self._odometry.finish():
            self._frameset_ms.append(1e3 * (perf_counter() - begin))
            self._take(estimate)
            begin = perf_counter()
        wall_s = perf_counter() - self._start
        self._collect()
        for event in self._source.faults.events:
            self._writer.add_event(event)
        return self._writer.finish(
            wall_s=wall_s,
            frameset_ms=self._frameset_ms,
            smoothed=sorted(self._smoothed, key=lambda stamped: stamped[0]),
            input_faults=self._source.faults.counts,
            framesets=self._delivered,
            awaited=self._delivered - self._before_start,
            resets=self._resets,
            warnings=self._odometry.rig_warnings,
            truth=self._source.truth,
        )

    def _remember(self, measurement: Measurement) -> None:
        if isinstance(measurement, FrameSet):
            self._delivered += 1
            if self._viewer is not None:
                self._waiting[measurement.stamp_ns] = measurement
                if len(self._waiting) > _KEPT_FRAMESETS:
                    self._waiting.popitem(last=False)

    def _take(self, estimate: Estimate) -> None:
        self._writer.add(estimate)
        self._before_start += estimate.status is Status.INITIALISING and estimate.nav_T_body is None
        self._collect()
        if self._viewer is not None:
            self._viewer.show(self._waiting.pop(estimate.stamp_ns, None), estimate)
        before, self._last = self._last, estimate
        if before is not None and before.epoch == estimate.epoch:
            self._distance_m += _distance(before, estimate)
        if self._on_progress is not None:
            self._on_progress(
                Progress(
                    framesets=len(self._frameset_ms),
                    total=self._source.frameset_count,
                    recorded_s=(estimate.stamp_ns - self._source.start_ns) * 1e-9,
                    wall_s=perf_counter() - self._start,
                    distance_m=self._distance_m,
                    latest=estimate,
                )
            )

    def _collect(self) -> None:
        final = self._odometry.take_smoothed()
        self._smoothed += final
        if self._recorder is not None:
            self._recorder.add_smoothed(final)
        for event in self._odometry.take_events():
            self._resets += event.kind in RESETS
            self._writer.add_event(event)
            if self._viewer is not None:
                self._viewer.show_event(event)


def _distance(before: Estimate, now: Estimate) -> float:
    if before.nav_T_body is None or now.nav_T_body is None:
        return 0.0
    return float(np.linalg.norm(now.nav_T_body[:3, 3] - before.nav_T_body[:3, 3]))
