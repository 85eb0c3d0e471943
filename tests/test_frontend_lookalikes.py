"""Tracks that are followed to the next repetition of a texture, and an object that moves as far."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_frontend_tracker import BASELINE, DISTANCE, FOCAL, X, Y, on_wall, rectified
from waves import picture, waves

from graphvio.arrays import Bool, Float, Image, Int
from graphvio.config import Config
from graphvio.frontend.lookalikes import without_lookalikes
from graphvio.frontend.pairs.agreement import Agreement
from graphvio.frontend.tracking.tracker import GroupTracker
from graphvio.frontend.visual import VisualFrontend
from graphvio.geometry import se3
from graphvio.measurements.motion import Quality
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Rig

PERIOD_PX = 16.0
STEP_M = 0.05  # to the left: the wall moves to the right
PERIOD_M = PERIOD_PX * DISTANCE / FOCAL


def view(camera_x_m: float, seed: int, *, repeats: bool, moved_px: float = 0.0) -> Image:
    """The wall as a camera sees it, with a part of it that repeats, or that moves along the wall."""
    points = on_wall(np.column_stack([X.ravel(), Y.ravel()]), se3(np.eye(3), np.array([-camera_x_m, 0.0, 0.0])))
    u, v = (FOCAL / DISTANCE * points[:, k].reshape(X.shape) for k in (0, 1))
    part = (v > 30.0) & (np.abs(u - moved_px) < 110.0)
    there = np.mod(u, PERIOD_PX) if repeats else u - moved_px
    noise = 1.5 / 45.0 * np.random.default_rng(seed).standard_normal(X.shape)
    return picture(np.where(part, waves(there + 500.0, v), waves(u, v)) + noise)


def predicted_motion(metres: float | None, _: int) -> Float | None:
    return None if metres is None else se3(np.eye(3), np.array([metres, 0.0, 0.0]))


def measured(*, repeats: bool, object_px: float = 0.0) -> tuple[Quality, str, Float | None]:
    """Return quality, why, and the motion over a step whose prediction is off by one repetition."""
    frontend = VisualFrontend(Rig((rectified(),)), Config())
    for k, predicted_m in enumerate((None, STEP_M + PERIOD_M)):
        images = tuple(
            view(STEP_M * -k + x, 10 * k + side, repeats=repeats, moved_px=object_px * k)
            for side, x in enumerate((0.0, BASELINE))
        )
        found = frontend.process(FrameSet(50_000_000 * k, {0: images}), partial(predicted_motion, predicted_m))
    return found.quality, found.reason, None if found.motion is None else found.motion.reference_T_current


def test_tracks_that_were_followed_to_the_next_repetition_are_no_second_motion() -> None:
    quality, reason, motion = measured(repeats=True)
    assert (quality, reason) == (Quality.GOOD, "")
    assert motion is not None
    np.testing.assert_allclose(motion[:3, 3], [-STEP_M, 0.0, 0.0], atol=1e-3)


def test_object_that_moves_is_a_second_motion() -> None:
    quality, reason, _ = measured(repeats=False, object_px=PERIOD_PX)
    assert quality is Quality.WEAK
    assert "two motions are seen" in reason


def test_tracks_are_also_where_a_motion_has_them_only_if_they_were_followed_elsewhere() -> None:
    tracker = GroupTracker(rectified(), Config())
    moved, followed = (se3(np.eye(3), np.array([x, 0.0, 0.0])) for x in (STEP_M, STEP_M + PERIOD_M))
    tracker.observe(0, view(0.0, 0, repeats=True), view(BASELINE, 1, repeats=True), None, None)
    tracker.keep_keyframe_patches()
    now = view(-STEP_M, 2, repeats=True), view(BASELINE - STEP_M, 3, repeats=True)
    frame = tracker.observe(50_000_000, *now, followed, followed)
    assert tracker.are_also_at(0, frame.ids, moved).sum() > 10
    assert tracker.are_also_at(0, frame.ids, followed).sum() < 3  # there they are
    assert not tracker.are_also_at(50_000_000, frame.ids, moved).any()  # of another keyframe there are no patches


@pytest.mark.parametrize(("back", "left"), [(0.0, 1), (0.8, 2)])
def test_motions_that_explain_each_others_points_both_stay(back: float, left: int) -> None:
    """A share of the second one's points is where the first has them, too, and a share of the first's the other way."""
    one, other = (
        SimpleNamespace(refined=SimpleNamespace(inlier=k, cur_T_ref=k * np.eye(4)), support=10) for k in (1, 2)
    )

    class Tracker:
        def are_also_at(self, _: int, ids: Int, motion: Float) -> Bool:
            return np.arange(len(ids)) < len(ids) * (0.8 if motion[0, 0] == 1.0 else back)

    identities = SimpleNamespace(identities=lambda *_: {0: np.arange(10)})
    seen: Any = SimpleNamespace(correspondences=identities, frames={}, reference_stamp_ns=0)
    hypotheses: Any = (one, other)
    trackers: Any = [Tracker()]
    found = without_lookalikes(Agreement(hypotheses, {}), seen, trackers, np.eye(4)[None])
    assert len(found.hypotheses) == left
