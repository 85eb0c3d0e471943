"""Timing of several pipelines that process the same framesets in turns, so that the load is similar for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Protocol

import cv2
import numpy as np

from benchmarks.recordings import Footage
from benchmarks.reference import ReferencePipeline
from graphvio.config import Config
from graphvio.frontend.tracking.steady_motion import SteadyMotion
from graphvio.frontend.visual import VisualFrontend
from graphvio.odometry import Odometry

WARM_UP = 20
"""Number of framesets at the beginning that are not counted, while caches fill and the odometry initialises."""
_TURN = 10  # framesets in a turn: more than one, since each change of turns makes OpenCV create its threads again
_OWN_THREADS = -1


class Contender(Protocol):
    """A pipeline that is timed."""

    opencv_threads: int
    """Number of OpenCV's threads during this pipeline's turn."""

    def step(self, index: int) -> dict[str, float]:
        """Process the next frameset; return stage -> milliseconds, as the pipeline reports them itself."""

    def close(self) -> None:
        """End its threads."""


@dataclass
class Timings:
    """Milliseconds for each counted frameset, in total and by stage."""

    total_ms: list[float] = field(default_factory=list)
    stage_ms: dict[str, list[float]] = field(default_factory=dict)

    def add(self, other: Timings) -> None:
        """Add the framesets of other timings."""
        self.total_ms += other.total_ms
        for name, values in other.stage_ms.items():
            self.stage_ms.setdefault(name, []).extend(values)

    @property
    def median_ms(self) -> float:
        """Median of the total."""
        return float(np.median(self.total_ms))

    @property
    def p95_ms(self) -> float:
        """95th percentile of the total."""
        return float(np.percentile(self.total_ms, 95))


def take_turns(contenders: Sequence[Contender], count: int) -> list[Timings]:
    """Time pipelines on framesets 0 to ``count`` in turns of ten framesets; the order changes from turn to turn.

    Returns:
        Timings of each pipeline, for the framesets from `WARM_UP` on.
    """
    timings = [Timings() for _ in contenders]
    try:
        for turn, begin in enumerate(range(0, count, _TURN)):
            for k in range(len(contenders)):
                i = (k + turn) % len(contenders)
                _set_opencv_threads(contenders[i].opencv_threads)
                for index in range(begin, min(begin + _TURN, count)):
                    _step(contenders[i], index, timings[i])
    finally:
        for contender in contenders:
            contender.close()
        cv2.setNumThreads(_OWN_THREADS)
    return timings


def _step(contender: Contender, index: int, timings: Timings) -> None:
    start = perf_counter()
    stages = contender.step(index)
    total_ms = 1e3 * (perf_counter() - start)
    if index < WARM_UP:
        return
    timings.total_ms.append(total_ms)
    for name, ms in stages.items():
        timings.stage_ms.setdefault(name, []).append(ms)


def _set_opencv_threads(threads: int) -> None:
    """Set the number of OpenCV's threads, and let OpenCV create them before the time is measured."""
    cv2.setNumThreads(threads)
    noise = np.zeros((480, 640), dtype=np.uint8)
    for _ in range(2):
        cv2.goodFeaturesToTrack(noise, 10, 0.01, 10.0)
        cv2.resize(noise, (1280, 960))


class FrontendContender:
    """The front-end alone; its prediction is that the last motion continues."""

    def __init__(self, footage: Footage, config: Config) -> None:
        cv2.setNumThreads(_OWN_THREADS)
        self._frontend = VisualFrontend(footage.rig, config)
        self.opencv_threads = cv2.getNumThreads()  # as set by the front-end
        self._framesets = footage.framesets
        self._predictor = SteadyMotion()
        self.tracks: list[int] = []
        """Number of tracks in the left image, for each counted frameset and pair."""
        self.points: list[int] = []
        """Number of candidate points of the estimation, for each counted frameset and pair."""
        self.failures = 0
        """Number of counted framesets without a motion."""

    def step(self, index: int) -> dict[str, float]:
        """Time one frameset."""
        frameset = self._framesets[index]
        self._predictor.begin(frameset.stamp_ns)
        result = self._frontend.process(frameset, self._predictor.predict)
        self._predictor.end(result.motion)
        if index >= WARM_UP:
            self.tracks += [len(report.pixels) for report in result.pairs.values()]
            self.points += [report.points for report in result.pairs.values()]
            self.failures += result.motion is None
        return dict(result.stage_ms)

    def close(self) -> None:
        """End its threads."""
        self._frontend.close()


class OdometryContender:
    """The complete odometry, with the IMU if the rig has one; a frameset's time includes its IMU samples."""

    def __init__(self, footage: Footage, config: Config) -> None:
        cv2.setNumThreads(_OWN_THREADS)
        self._odometry = Odometry(footage.rig, config)
        self.opencv_threads = cv2.getNumThreads()
        self._steps = footage.steps

    def step(self, index: int) -> dict[str, float]:
        """Time one frameset and the samples before it."""
        stage_ms: dict[str, float] = {}
        for measurement in self._steps[index]:
            estimate = self._odometry.process(measurement)
            if estimate is not None:
                stage_ms = dict(estimate.stage_ms)
        return stage_ms

    def close(self) -> None:
        """End its threads."""
        self._odometry.finish()


class ReferenceContender:
    """The reference pipeline, with OpenCV's own threads."""

    def __init__(self, footage: Footage, corners: int = 300, min_distance_px: float = 10.0) -> None:
        self.opencv_threads = _OWN_THREADS
        self.pipeline = ReferencePipeline(footage.rig, corners, min_distance_px)
        self._framesets = footage.framesets

    def step(self, index: int) -> dict[str, float]:
        """Time one frameset."""
        return self.pipeline.process(self._framesets[index])

    def close(self) -> None:
        """Do nothing: no threads are left."""
