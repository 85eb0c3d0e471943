"""How long the stages of mapping take."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class StageTimes:
    """Sums by stage, in the order in which the stages were first reached."""

    def __init__(self) -> None:
        self._total_s: dict[str, float] = {}
        self._count: dict[str, int] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count what is done inside, however it ends."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._total_s[name] = self._total_s.get(name, 0.0) + time.perf_counter() - begin
            self._count[name] = self._count.get(name, 0) + 1

    def summary(self) -> dict[str, float]:
        """Mean milliseconds of each stage."""
        return {f"{name}_ms": 1e3 * total / self._count[name] for name, total in self._total_s.items()}
