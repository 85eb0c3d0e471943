"""Tracks that are followed to the next repetition of a texture, and an object that moves as far."""

from functools import partial

import numpy as np
from test_frontend_tracker import BASELINE, DISTANCE, FOCAL, X, Y, on_wall, rectified
from waves import picture, waves

from graphvio.arrays import Float, Image
from graphvio.config import Config
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
