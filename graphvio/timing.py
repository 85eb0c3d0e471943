"""Processing time by stage."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from time import perf_counter
from typing import Concatenate, ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

clock: Callable[[], float] = perf_counter
"""The clock, in seconds, by which all stages are timed. A benchmark replaces it by a clock of processor time."""


class HasStageTimes(Protocol):
    """An object that collects the processing time of its stages, milliseconds by name."""

    stage_ms: dict[str, float]


T = TypeVar("T", bound=HasStageTimes)


def timed(stage: str) -> Callable[[Callable[Concatenate[T, P], R]], Callable[Concatenate[T, P], R]]:
    """Return a decorator that makes a method add its processing time to ``self.stage_ms[stage]``."""

    def decorate(method: Callable[Concatenate[T, P], R]) -> Callable[Concatenate[T, P], R]:
        @wraps(method)
        def measured(self: T, *args: P.args, **kwargs: P.kwargs) -> R:
            start = clock()
            try:
                return method(self, *args, **kwargs)
            finally:
                self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + 1e3 * (clock() - start)

        return measured  # type: ignore[return-value]  # wraps() loses the type of self

    return decorate


class Stopwatch:
    """Adds up the time between calls of `lap`, under the name of the stage that has just ended."""

    def __init__(self) -> None:
        self.stage_ms: dict[str, float] = {}
        self._since = clock()

    def lap(self, stage: str) -> None:
        """Add the time since the last call to the time of a stage."""
        now = clock()
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + 1e3 * (now - self._since)
        self._since = now
