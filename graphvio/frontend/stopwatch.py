"""Time by stage."""

from time import perf_counter


class Stopwatch:
    """Adds up the time between calls, under the name of the stage that has just ended."""

    def __init__(self) -> None:
        self.stage_ms: dict[str, float] = {}
        self._since = perf_counter()

    def lap(self, stage: str) -> None:
        """The time since the last call belongs to this stage."""
        now = perf_counter()
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + 1e3 * (now - self._since)
        self._since = now
