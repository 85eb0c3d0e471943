"""Detection of frequent mistakes in a rig from the images of a pair: left and right exchanged, transforms inverted.

Such a pair finds hardly any corner of its left image in its right one, and many with the mistake undone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphvio.arrays import Image
from graphvio.config import Config
from graphvio.errors import RigError
from graphvio.frontend.tracking.tracker import GroupTracker
from graphvio.geometry import se3_inverse
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.motion import VisualResult
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Camera, Rig, StereoPair

_CHECKED_AFTER = (10, 100)  # number of framesets with few depths after which a pair is checked
_CHECKED_AGAIN = 10  # one in so many framesets with more is checked: a wrong calibration matches some, too
_FEW_POINTS = 0.3  # share of the corners; some always match something
_MIN_CORNERS = 30
_MIN_MATCHES = 30
_MAX_SHARE = 0.2  # ratio of corners that match with the rig as it is to those with a mistake undone
_EXCHANGED = "left and right are exchanged (cables, topics, or names in the rig file)"
_INVERTED = "body_T_cam of both cameras is inverted, so that it maps points of the camera to body"


class RigMistakes:
    """Reports pairs whose images match only if a mistake in the rig is undone.

    Args:
        rig: The rig, with the calibration of the rig file.
        config: Configuration of all stages.
        report: Receives one event for each such pair.
    """

    def __init__(self, rig: Rig, config: Config, report: Report) -> None:
        self._pairs = {j: group for j, group in enumerate(rig.groups) if isinstance(group, StereoPair)}
        self._config = config
        self._report = report
        self._with_few_points: dict[int, int] = dict.fromkeys(self._pairs, 0)  # framesets
        self._with_more_points: dict[int, int] = dict.fromkeys(self._pairs, 0)  # since a mistake was found
        self._warnings: dict[int, str] = {}

    @property
    def warnings(self) -> list[str]:
        """Warnings about such pairs, a sentence each."""
        return list(self._warnings.values())

    def update(self, frameset: FrameSet, visual: VisualResult) -> None:
        """Check, twice, a pair that finds few of its corners in its right image; check again one that has a warning."""
        for j in self._pairs.keys() & frameset.images.keys() & visual.pairs.keys():
            seen = visual.pairs[j]
            if len(seen.pixels) < _MIN_CORNERS:
                continue
            if seen.points > _FEW_POINTS * len(seen.pixels):
                self._check_again(j, frameset)
                continue
            self._with_few_points[j] += 1
            if self._with_few_points[j] not in _CHECKED_AFTER or j in self._warnings:
                continue
            mistakes, _ = self._mistakes(j, frameset)
            if mistakes:
                self._with_more_points[j] = 0
                self._warnings[j] = f"{self._pairs[j].name}: its images match only if {' or '.join(mistakes)}"
                self._report(frameset.stamp_ns, EventKind.RIG_MISTAKEN, self._warnings[j])

    def _check_again(self, j: int, frameset: FrameSet) -> None:
        """Withdraw the warning of a pair whose images match the rig again, as after cables were plugged correctly."""
        if j not in self._warnings:
            return
        if self._with_more_points[j] % _CHECKED_AGAIN == 0:
            mistakes, matches = self._mistakes(j, frameset)
            if not mistakes and matches >= _MIN_MATCHES:
                del self._warnings[j]
                self._with_few_points[j] = 0
        self._with_more_points[j] += 1

    def _mistakes(self, j: int, frameset: FrameSet) -> tuple[list[str], int]:
        """Return the mistakes without which the images match, and the number of corners that match without a change.

        Two mistakes may have the same effect, where body has a camera's axes.
        """
        pair = self._pairs[j]
        left, right = (np.ascontiguousarray(image) for image in frameset.images[j])
        n_as_it_is = self._matches(pair, left, right)
        n_undone = {_EXCHANGED: self._matches(pair, right, left)}
        inverted = _inverted(pair)
        if inverted is not None:
            n_undone[_INVERTED] = self._matches(inverted, left, right)
        mistakes = [mistake for mistake, n in n_undone.items() if n >= _MIN_MATCHES and n_as_it_is < _MAX_SHARE * n]
        return mistakes, n_as_it_is

    def _matches(self, pair: StereoPair, left: Image, right: Image) -> int:
        """Return the number of corners of a left image that are matched in the right one."""
        return int(GroupTracker(pair, self._config).observe(0, left, right, None, None).has_depth.sum())


def _inverted(pair: StereoPair) -> StereoPair | None:
    """Return the pair with its cameras' transforms inverted, or None if that is no pair."""

    def invert(camera: Camera) -> Camera:
        return replace(camera, body_T_cam=se3_inverse(camera.body_T_cam))

    try:
        return StereoPair(pair.name, invert(pair.left), invert(pair.right))
    except RigError:
        return None
