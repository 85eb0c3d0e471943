"""Detection of a standstill from the images."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.frontend.depth.tracks import TrackedFrame, common_rows
from graphvio.frontend.thresholds import THRESHOLDS

_T = THRESHOLDS.standstill


class Standstill:
    """Detects a standstill by comparing each pair's newest frame with the one at which it may have begun."""

    def __init__(self) -> None:
        self._since: dict[int, TrackedFrame] = {}

    def update(self, frames: Mapping[int, TrackedFrame], explained: Mapping[int, Int]) -> bool:
        """Return whether the rig has stood still for a while.

        Args:
            frames: Newest frame of each pair.
            explained: Pair index -> identities, increasing, of the points that the rig's motion explains.
        """
        moved: list[Float] = []
        elapsed_s = np.inf
        for j, frame in frames.items():
            since = self._since.setdefault(j, frame)
            elapsed_s = min(elapsed_s, (frame.stamp_ns - since.stamp_ns) * 1e-9)
            if j not in explained:
                continue
            now, _ = common_rows(frame.ids, explained[j])
            at_now, at_then = common_rows(frame.ids[now], since.ids)
            moved.append(np.hypot(*(frame.pixels[now[at_now]] - since.pixels[at_then]).T))
        distance = np.concatenate(moved) if moved else np.zeros(0)
        unmoved = len(distance) >= _T.min_points and bool(
            np.mean(distance < _T.max_median_px) > 0.5 and np.mean(distance < _T.max_moved_px) >= _T.min_unmoved_share
        )
        if not unmoved:
            self._since.update(frames)
        return unmoved and elapsed_s >= _T.min_duration_s
