"""What goes into the back-end over a run, noted so that it can be repeated; and the factors that it makes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, takewhile
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import gtsam

from graphvio.backend import smoother
from graphvio.backend.window import Window
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement
from graphvio.odometry import Odometry
from graphvio.rig import Rig
from graphvio.sources import open_source

_STEPS = ("start", "predict", "use", "update")


class Call(NamedTuple):
    """A step of the back-end, see `graphvio.backend.estimator.StateEstimator`, and what it was given."""

    name: str
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Stream:
    """What the back-end was given for each frameset of a recording.

    Attributes:
        rig: of the recording.
        framesets: the calls for each, the last of which is ``update``.
        prediction_us: what `Odometry.predict` took at each sample of the IMU beyond the newest frameset.
    """

    rig: Rig
    framesets: list[list[Call]]
    prediction_us: list[float]


def note_stream(folder: Path, most: int) -> Stream:
    """Run the odometry on the first framesets of a recording, and note what its back-end is given."""
    source = open_source(folder)
    odometry = Odometry(source.rig)
    framesets: list[list[Call]] = [[]]
    estimator: Any = odometry._estimator
    for name in _STEPS:
        _note(estimator, name, framesets)
    prediction_us = []
    for measurement in list(
        takewhile(_before(most), source)
    ):  # decoded before, so that no time is of the threads for that
        odometry.process(measurement)
        if isinstance(measurement, ImuSample):
            start = perf_counter()
            if odometry.predict(measurement.stamp_ns) is not None:
                prediction_us.append(1e6 * (perf_counter() - start))
    odometry.finish()
    return Stream(source.rig, [calls for calls in framesets if calls][:most], prediction_us)


def _before(most: int) -> Callable[[Measurement], bool]:
    """Whether a measurement is one of the first framesets, or comes before the next one."""
    framesets = count()
    return lambda measurement: not isinstance(measurement, FrameSet) or next(framesets) < most


def _note(estimator: Any, name: str, framesets: list[list[Call]]) -> None:
    step = getattr(estimator, name)

    def noted(*arguments: Any) -> Any:
        kept = (replace(arguments[0], pairs={}), *arguments[1:]) if name == "use" else arguments
        framesets[-1].append(Call(name, kept))
        if name == "update":
            framesets.append([])
        return step(*arguments)

    setattr(estimator, name, noted)


class Added(NamedTuple):
    """What the smoother inserted for a frameset.

    Attributes:
        factors: in the order in which they were inserted.
        values: the variables that are new with them, as they were predicted.
    """

    factors: gtsam.NonlinearFactorGraph
    values: gtsam.Values


class FactorLog:
    """What the windows of all smoothers that are made from now on insert."""

    def __init__(self) -> None:
        self._added = Added(gtsam.NonlinearFactorGraph(), gtsam.Values())
        smoother.Window = partial(_NotedWindow, self)  # type: ignore[assignment, attr-defined]

    def take(self) -> Added:
        """What was inserted since the last call."""
        taken, self._added = self._added, Added(gtsam.NonlinearFactorGraph(), gtsam.Values())
        return taken

    def add(self, factor: gtsam.NonlinearFactor, new: set[int], values: gtsam.Values) -> None:
        """Note a factor, and its variables that are new, which have values."""
        self._added.factors.push_back(factor)
        for key in new:
            kind = chr(gtsam.Symbol(key).chr())
            if kind == "v":
                self._added.values.insert(key, values.atVector(key))
            elif kind == "b":
                self._added.values.insert(key, values.atConstantBias(key))
            else:
                self._added.values.insert(key, values.atPose3(key))


class _NotedWindow(Window):
    def __init__(self, log: FactorLog, min_iterations: int = 1) -> None:
        super().__init__(min_iterations)
        self._log = log
        self._noted: set[int] = set()

    def add(self, factor: gtsam.NonlinearFactor) -> None:
        super().add(factor)
        new = set(factor.keys()) - self._noted
        self._noted |= new
        self._log.add(factor, new, self.values)
