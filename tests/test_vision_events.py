"""Events of the front-end that last: a pair that takes part in no motion, and none where that is not so."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from recordings import small_rig

from graphvio.measurements.events import EventKind
from graphvio.measurements.motion import PairReport, Quality, VisualResult
from graphvio.odometry.vision_events import VisionEvents

MS = 1_000_000
PERIOD_NS = 50 * MS


def report_of(inliers: int) -> PairReport:
    return PairReport(100, inliers, np.zeros((100, 2)), np.arange(100) < inliers)


def events_of(
    inliers_of_back: Sequence[int | None], quality: Quality = Quality.GOOD
) -> tuple[list[tuple[int, str]], list[str]]:
    """Events and warnings where the front pair has 50 inliers in each frameset, the back pair these, or no images."""
    reported: list[tuple[int, str]] = []
    events = VisionEvents(small_rig(), lambda stamp_ns, kind, _: reported.append((stamp_ns // PERIOD_NS, kind)))
    for k, inliers in enumerate(inliers_of_back):
        pairs = {0: report_of(50)} | ({} if inliers is None else {1: report_of(inliers)})
        reason = "" if quality is Quality.GOOD else "blurred"
        events.update(k * PERIOD_NS, VisualResult(None, quality, reason, pairs), {})
    return [each for each in reported if each[1] == EventKind.PAIR_UNUSED], events.rig_warnings


def test_pair_that_takes_part_in_no_motion_is_reported_once_and_in_the_warnings() -> None:
    reported, warnings = events_of([0] * 300)
    assert reported == [(101, EventKind.PAIR_UNUSED)]
    assert len(warnings) == 1
    assert "none of 300 motions" in warnings[0]


def test_pair_that_comes_back_and_goes_is_reported_again_but_is_no_warning() -> None:
    reported, warnings = events_of([0] * 150 + [20] + [0] * 150)
    assert [k for k, _ in reported] == [101, 251]
    assert warnings == []


@pytest.mark.parametrize(
    "inliers",
    [[0] * 90 + [1] + [0] * 90, [0] * 30, [None] * 300, [30] * 300],
    ids=["dark for 4.5 s", "short", "no images", "used"],
)
def test_pair_that_is_used_now_and_then_or_has_no_images_is_not_reported(inliers: list[int | None]) -> None:
    assert events_of(inliers) == ([], [])


def test_pair_is_not_reported_where_no_motion_is_good() -> None:
    assert events_of([0] * 300, Quality.WEAK) == ([], [])
