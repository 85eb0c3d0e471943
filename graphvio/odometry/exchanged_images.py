"""Pairs whose left and right images are exchanged: they match only the other way round."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Image
from graphvio.config import Config
from graphvio.frontend.tracker import GroupTracker
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.motion import VisualResult
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Rig, StereoPair

_CHECKED_AFTER = (10, 100)  # framesets in which few of a pair's corners have a depth
_FEW_POINTS = 0.3  # of the corners; some always match something
_MIN_CORNERS = 30
_MIN_MATCHES = 30
_MAX_SHARE = 0.2  # of the corners that are matched as they should be, of those that are when exchanged


class ExchangedImages:
    """Reports pairs whose left and right images are exchanged, as by cables, topics or a rig file.

    Args:
        rig: Of the rig file.
        config: Of the front-end.
        report: Receives one event for each such pair.
    """

    def __init__(self, rig: Rig, config: Config, report: Report) -> None:
        self._pairs = {j: group for j, group in enumerate(rig.groups) if isinstance(group, StereoPair)}
        self._config = config
        self._report = report
        self._with_few_points: dict[int, int] = dict.fromkeys(self._pairs, 0)  # framesets
        self._warnings: dict[int, str] = {}

    @property
    def warnings(self) -> list[str]:
        """Such pairs, a sentence each."""
        return list(self._warnings.values())

    def update(self, frameset: FrameSet, visual: VisualResult) -> None:
        """Check a pair that finds few of its corners in its right image, twice; nothing is done for any other pair."""
        for j in self._pairs.keys() & frameset.images.keys() & visual.pairs.keys():
            seen = visual.pairs[j]
            if len(seen.pixels) < _MIN_CORNERS:
                continue
            if seen.points > _FEW_POINTS * len(seen.pixels):
                self._warnings.pop(j, None)  # somebody has plugged the cables right
                continue
            self._with_few_points[j] += 1
            if self._with_few_points[j] not in _CHECKED_AFTER or j in self._warnings:
                continue
            left, right = (np.ascontiguousarray(image) for image in frameset.images[j])
            if self._are_exchanged(self._pairs[j], left, right):
                self._warnings[j] = (
                    f"{self._pairs[j].name}: its left images match its right ones only when they are exchanged; check "
                    "which camera is left and which right (cables, topics, rig file)"
                )
                self._report(frameset.stamp_ns, EventKind.IMAGES_EXCHANGED, self._warnings[j])

    def _are_exchanged(self, pair: StereoPair, left: Image, right: Image) -> bool:
        exchanged = self._matches(pair, right, left)
        return exchanged >= _MIN_MATCHES and self._matches(pair, left, right) < _MAX_SHARE * exchanged

    def _matches(self, pair: StereoPair, left: Image, right: Image) -> int:
        """Count the corners of a left image that have a depth by the right one."""
        return int(GroupTracker(pair, self._config).observe(0, left, right, None, None).has_depth.sum())
