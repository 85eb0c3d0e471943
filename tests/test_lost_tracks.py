"""Tracks that a wrong prediction has lost are found again."""

from __future__ import annotations

import numpy as np
import pytest
from real_clip import CLIP, real_clip
from waves import picture, waves

from graphvio import Config, FrameSet, Odometry, open_source
from graphvio.evaluation import evaluate
from graphvio.frontend.tracking.lost_tracks import image_shift, motion_of_found
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.measurements.events import EventKind
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

FOCAL_PX = 400.0


@pytest.mark.parametrize("shift_px", [(0.0, 0.0), (6.0, -3.0), (-11.0, 4.0)])
def test_image_shift_of_a_moved_image_is_measured(shift_px: tuple[float, float]) -> None:
    x, y = np.meshgrid(np.arange(94.0), np.arange(60.0))
    before, now = picture(waves(x, y)), picture(waves(x - shift_px[0], y - shift_px[1]))
    np.testing.assert_allclose(image_shift(before, now), shift_px, atol=1.0)


def test_motion_of_found_tracks_foretells_the_others() -> None:
    """Half of what was found is wrong, and of a third of the points no depth is known."""
    rng = np.random.default_rng(1)
    n = 60
    rays, inverse_depths = rng.uniform(-0.6, 0.6, (n, 2)), rng.uniform(0.1, 1.0, n)
    now_T_then = se3_exp(np.array([0.05, -0.12, 0.08, 0.1, -0.03, 0.15]))
    points = np.column_stack([rays, np.ones(n)]) / inverse_depths[:, None]
    moved = points @ now_T_then[:3, :3].T + now_T_then[:3, 3]
    seen = moved[:, :2] / moved[:, 2:] + rng.normal(0.0, 0.5 / FOCAL_PX, (n, 2))
    found = np.arange(n) < 40
    seen[:20] += rng.uniform(0.05, 0.3, (20, 2))
    estimated = motion_of_found(rays, inverse_depths, seen, found, FOCAL_PX)
    assert estimated is not None
    assert np.linalg.norm(se3_log(np.ascontiguousarray(se3_inverse(now_T_then) @ estimated))) < 0.03
    assert motion_of_found(rays, inverse_depths, rng.uniform(-0.6, 0.6, (n, 2)), found, FOCAL_PX) is None
    assert motion_of_found(rays, inverse_depths, seen, np.arange(n) < 5, FOCAL_PX) is None


@pytest.mark.skipif(not CLIP.exists(), reason="the real recording is not here")
def test_every_third_image_of_a_shaken_pair_without_imu() -> None:
    """At 7 Hz the velocity of one step says little about the next one: turns change by 3 degrees from step to step."""
    source = open_source(real_clip())
    rig = source.rig.without_imu()
    framesets = [each for each in open_source(real_clip(), rig, to_s=12.0) if isinstance(each, FrameSet)]
    odometry = Odometry(rig, Config())
    estimates = [estimate for estimate in map(odometry.process, framesets[::3]) if estimate is not None]
    estimates += odometry.finish()
    assert not {event.kind for event in odometry.take_events()} & {EventKind.VISION_FAILED, EventKind.LOST}
    poses = [estimate.nav_T_body for estimate in estimates if estimate.nav_T_body is not None]
    assert len(poses) == len(estimates)
    assert source.truth is not None
    estimated = Trajectory(np.array([estimate.stamp_ns for estimate in estimates]), np.array(poses))
    assert evaluate(estimated, load_trajectory(source.truth)).ate_position_m.rmse < 0.015
