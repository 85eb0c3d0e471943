"""The turn of a rig between two images, by the tracks of its single cameras."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import Generator

from graphvio.arrays import Float
from graphvio.frontend.tracking.turn import turn_between
from graphvio.geometry import se3, se3_inverse, so3_exp, so3_log
from graphvio.measurements.motion import CameraTracks
from graphvio.simulation.named_rigs import stereo_and_back

NOISE_PX = 0.2
RIG = stereo_and_back().without_pairs()


def scene(rng: Generator, count: int = 150) -> Float:
    """Points (N, 3) in front of the camera, in body when it is at the origin."""
    rays = np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)), np.ones(count)])
    camera = rng.uniform(1.5, 8.0, (count, 1)) * rays
    body_T_cam = RIG.cameras[0].body_T_cam
    return camera @ body_T_cam[:3, :3].T + body_T_cam[:3, 3]


def wall(rng: Generator, count: int = 150) -> Float:
    points = np.column_stack([rng.uniform(-1.5, 1.5, (count, 2)), np.full(count, 2.5)])
    body_T_cam = RIG.cameras[0].body_T_cam
    return points @ body_T_cam[:3, :3].T + body_T_cam[:3, 3]


def camera_tracks(points: Float, world_T_body: Float, rng: Generator) -> CameraTracks:
    cam_T_world = RIG.cameras[0].cam_T_body @ se3_inverse(world_T_body)
    seen = points @ cam_T_world[:3, :3].T + cam_T_world[:3, 3]
    noise = NOISE_PX / RIG.cameras[0].focal_px * rng.standard_normal((len(points), 2))
    return CameraTracks(np.arange(len(points)), seen[:, :2] / seen[:, 2:] + noise)


MOTIONS = [
    pytest.param(np.array([0.0, 0.0, 0.05]), np.array([0.1, 0.02, 0.0]), id="turns and walks"),
    pytest.param(np.array([0.03, -0.02, 0.0]), np.array([0.0, 0.08, 0.03]), id="goes sideways"),
    pytest.param(np.array([0.0, 0.06, 0.02]), np.zeros(3), id="turns on the spot"),
]


@pytest.mark.parametrize(("turn", "step_m"), MOTIONS)
def test_turn_between_is_that_of_body(turn: Float, step_m: Float) -> None:
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points = scene(rng)
        then = camera_tracks(points, np.eye(4), rng)
        now = camera_tracks(points, se3(so3_exp(turn), step_m), rng)
        found = turn_between(RIG, {0: then}, {0: now})
        if found is not None:
            errors.append(np.linalg.norm(so3_log(np.ascontiguousarray(found @ so3_exp(turn).T))))
    if step_m.any():
        assert len(errors) == 20
    assert np.max(errors, initial=0.0) < 0.004


def test_turn_between_ignores_tracks_of_what_moves() -> None:
    rng = np.random.default_rng(5)
    points, turn = scene(rng), np.array([0.0, 0.0, 0.04])
    then = camera_tracks(points, np.eye(4), rng)
    points[:40] += np.array([0.3, 0.2, 0.1])
    now = camera_tracks(points, se3(so3_exp(turn), np.array([0.08, 0.0, 0.02])), rng)
    found = turn_between(RIG, {0: then}, {0: now})
    assert found is not None
    np.testing.assert_allclose(found, so3_exp(turn), atol=0.004)


def test_turn_between_in_front_of_a_wall_is_unknown() -> None:
    """A plane has two essential matrices, and each of them fits."""
    rng = np.random.default_rng(6)
    points = wall(rng)
    then = camera_tracks(points, np.eye(4), rng)
    now = camera_tracks(points, se3(so3_exp(np.array([0.0, 0.0, 0.05])), np.array([0.0, 0.2, 0.1])), rng)
    assert turn_between(RIG, {0: then}, {0: now}) is None


def test_turn_between_needs_tracks_in_common() -> None:
    rng = np.random.default_rng(7)
    seen = camera_tracks(scene(rng, count=20), np.eye(4), rng)
    other = camera_tracks(scene(rng), np.eye(4), rng)._replace(ids=np.arange(1000, 1150))
    assert turn_between(RIG, {0: seen}, {0: seen}) is None
    assert turn_between(RIG, {0: other}, {0: seen}) is None
    assert turn_between(RIG, {}, {0: seen}) is None
