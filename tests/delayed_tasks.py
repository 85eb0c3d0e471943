"""An executor with random delays, for code whose results must not depend on the timing of its threads."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")


class DelayedExecutor(ThreadPoolExecutor):
    """An executor whose tasks start up to some milliseconds late, so that they start and end in any order."""

    def __init__(self, threads: int, seed: int, max_delay_ms: float = 6.0) -> None:
        super().__init__(threads)
        self._rng = np.random.default_rng(seed)
        self._max_delay_ms = max_delay_ms
        self.delays_ms: list[float] = []

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """Start a task after a random time; `map` submits its tasks through here as well."""
        delay_ms = float(self._rng.choice([0.0, self._rng.uniform(0.0, self._max_delay_ms)]))
        self.delays_ms.append(delay_ms)

        def late(*args: P.args, **kwargs: P.kwargs) -> R:
            time.sleep(1e-3 * delay_ms)
            return fn(*args, **kwargs)

        return super().submit(late, *args, **kwargs)
