"""Logs of the back-end: its inputs over a run, so that it can process them again, and the factors that it creates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from inspect import signature
from itertools import count, takewhile
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import gtsam

from graphvio.backend import smoother
from graphvio.backend.window import GraphWindow
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement
from graphvio.odometry import Odometry
from graphvio.rig import Rig
from graphvio.sources import open_source

_STEPS = ("initialise", "predict", "apply", "update")


class Call(NamedTuple):
    """A call of a method of `graphvio.backend.estimator.StateEstimator`."""

    name: str
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Stream:
    """Inputs of the back-end for each frameset of a recording.

    Attributes:
        rig: rig of the recording.
        framesets: for each frameset, the calls of the back-end's methods; the last of them is ``update``.
        prediction_us: times of `Odometry.predict` at the IMU samples after the newest frameset, microseconds.
    """

    rig: Rig
    framesets: list[list[Call]]
    prediction_us: list[float]


def log_stream(folder: Path, most: int) -> Stream:
    """Run the odometry on the first ``most`` framesets of a recording, and log the calls of its back-end."""
    source = open_source(folder)
    odometry = Odometry(source.rig)
    framesets: list[list[Call]] = [[]]
    estimator: Any = odometry._estimator
    for name in _STEPS:
        _log_calls(estimator, name, framesets)
    prediction_us = []
    # All images are decoded first, so that no decoding threads run meanwhile.
    for measurement in list(takewhile(_before(most), source)):
        odometry.process(measurement)
        if isinstance(measurement, ImuSample):
            start = perf_counter()
            if odometry.predict(measurement.stamp_ns) is not None:
                prediction_us.append(1e6 * (perf_counter() - start))
    odometry.finish()
    return Stream(source.rig, [calls for calls in framesets if calls][:most], prediction_us)


def _before(most: int) -> Callable[[Measurement], bool]:
    """Return a predicate that is true until it has seen ``most`` framesets."""
    framesets = count()
    return lambda measurement: not isinstance(measurement, FrameSet) or next(framesets) < most


def _log_calls(estimator: Any, name: str, framesets: list[list[Call]]) -> None:
    step = getattr(estimator, name)

    def logged(*positional: Any, **named: Any) -> Any:
        arguments = signature(step).bind(*positional, **named).args
        kept = (replace(arguments[0], pairs={}), *arguments[1:]) if name == "apply" else arguments
        framesets[-1].append(Call(name, kept))
        if name == "update":
            framesets.append([])
        return step(*arguments)

    setattr(estimator, name, logged)


class Added(NamedTuple):
    """Factors and variables that the smoother inserted for a frameset.

    Attributes:
        factors: the factors, in the order in which they were inserted.
        values: the new variables, with their predicted values.
    """

    factors: gtsam.NonlinearFactorGraph
    values: gtsam.Values


class FactorLog:
    """Log of the factors that are inserted by all smoothers that are created after the log."""

    def __init__(self) -> None:
        self._added = Added(gtsam.NonlinearFactorGraph(), gtsam.Values())
        smoother.GraphWindow = partial(_LoggedWindow, self)  # type: ignore[assignment, attr-defined]

    def take(self) -> Added:
        """Return what was inserted since the last call."""
        taken, self._added = self._added, Added(gtsam.NonlinearFactorGraph(), gtsam.Values())
        return taken

    def add(self, factor: gtsam.NonlinearFactor, new: set[int], values: gtsam.Values) -> None:
        """Log a factor and its new variables, whose values are given."""
        self._added.factors.push_back(factor)
        for key in new:
            kind = chr(gtsam.Symbol(key).chr())
            if kind in "vg":
                self._added.values.insert(key, values.atVector(key))
            elif kind == "b":
                self._added.values.insert(key, values.atConstantBias(key))
            else:
                self._added.values.insert(key, values.atPose3(key))


class _LoggedWindow(GraphWindow):
    def __init__(self, log: FactorLog, min_iterations: int = 1) -> None:
        super().__init__(min_iterations)
        self._log = log
        self._logged: set[int] = set()

    def add(self, factor: gtsam.NonlinearFactor) -> None:
        super().add(factor)
        new = set(factor.keys()) - self._logged
        self._logged |= new
        self._log.add(factor, new, self.values)
