"""Standing still, recognised from the images."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.frontend.tracks import PairFrame, common_rows

_USUAL_PX = 0.15  # half of the points must not have moved more
_MOST_PX = 0.5
_MOST = 0.9  # of the points must not have moved more than that
_FEWEST_POINTS = 25
_LEAST_S = 0.25  # a slow motion does not show at once


class Standstill:
    """Holds each pair's frames against the one since which it may have been at rest."""

    def __init__(self) -> None:
        self._since: dict[int, PairFrame] = {}

    def look(self, frames: Mapping[int, PairFrame], explained: Mapping[int, Int]) -> bool:
        """Whether the rig has been at rest for a while.

        Args:
            frames: the newest of each pair.
            explained: pair -> identities of the points that the rig's motion explains, increasing.
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
        unmoved = len(distance) >= _FEWEST_POINTS and bool(
            np.mean(distance < _USUAL_PX) > 0.5 and np.mean(distance < _MOST_PX) >= _MOST
        )
        if not unmoved:
            self._since.update(frames)
        return unmoved and elapsed_s >= _LEAST_S
