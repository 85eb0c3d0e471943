"""Depth of single cameras' features from the motion between places, and resection by it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from synthetic_session import make_session

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.geometry import se3, se3_exp, se3_inverse, se3_log, so3_exp
from graphvio.optimization.loops.motion_depth import (
    FEATURE_SIGMA_PX,
    Features,
    PlaceMotion,
    located,
    place_motion,
    undetermined,
)
from graphvio.optimization.loops.resection import resect_features
from graphvio.optimization.record import SessionRecord
from graphvio.rig import Imu
from graphvio.simulation import default_rig

RIG = default_rig().without_pairs()
CAMERA = RIG.singles[0].left
SIDEWAYS = se3(so3_exp(np.array([0.01, 0.02, 0.05])), np.array([0.05, 0.4, 0.02]))
SIGMAS = np.repeat([2e-4, 2e-3], 3)


def descriptors(count: int) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    """Descriptors of which no two are alike, of COLMAP's length."""
    rows = np.random.default_rng(17).random((count, 128)) ** 4
    return np.asarray(np.rint(512.0 * rows / np.linalg.norm(rows, axis=1, keepdims=True)), dtype=np.uint8)


def points_of(rng: np.random.Generator, count: int) -> Float:
    """Points (N, 3) in body that the camera sees."""
    depth = rng.uniform(2.0, 7.0, count)
    rays = np.column_stack([rng.uniform(-0.4, 0.4, (count, 2)), np.ones(count)])
    return np.asarray((rays * depth[:, None]) @ CAMERA.body_T_cam[:3, :3].T + CAMERA.body_T_cam[:3, 3])


def seen(points: Float, body_T_then: Float, rng: np.random.Generator) -> Features:
    """Points (N, 3) in body then, as the camera sees them from another pose of body, with noise."""
    in_body = (points - body_T_then[:3, 3]) @ body_T_then[:3, :3]
    pixels, _ = CAMERA.project(in_body @ CAMERA.cam_T_body[:3, :3].T + CAMERA.cam_T_body[:3, 3])
    noise = FEATURE_SIGMA_PX * rng.standard_normal(pixels.shape)
    return Features(pixels + noise, descriptors(len(points)))


def measured(motion: Float, rng: np.random.Generator) -> PlaceMotion:
    return PlaceMotion(motion @ se3_exp(SIGMAS * rng.standard_normal(6)), np.diag(SIGMAS**2))


def test_located_depth_is_consistent() -> None:
    """Covariances hold the noise of both images, and shifts that of the motion."""
    rng = np.random.default_rng(5)
    squares = []
    for _ in range(6):
        points = points_of(rng, 60)
        place = seen(points, np.eye(4), rng)
        found = located(CAMERA, 1, place, [(seen(points, SIDEWAYS, rng), measured(SIDEWAYS, rng))])
        frame = found.frame
        assert frame.is_single
        assert frame.has_depth.mean() > 0.6
        in_camera = points @ CAMERA.cam_T_body[:3, :3].T + CAMERA.cam_T_body[:3, 3]
        errors = frame.points[:, 2] - 1.0 / in_camera[:, 2]
        variances = FEATURE_SIGMA_PX**2 * frame.covariances[:, 2, 2] + (found.shifts**2).sum(axis=0)
        squares += (errors**2 / variances)[frame.has_depth].tolist()
    assert 0.3 < np.mean(squares) < 1.5


def test_located_takes_the_neighbour_that_knows_a_depth_best() -> None:
    rng = np.random.default_rng(6)
    points = points_of(rng, 80)
    place = seen(points, np.eye(4), rng)
    near, far = (se3(np.eye(3), np.array([0.0, metres, 0.0])) for metres in (0.1, 0.5))
    neighbours = [(seen(points, each, rng), measured(each, rng)) for each in (near, far)]
    both, one = (located(CAMERA, 1, place, given).frame for given in (neighbours, neighbours[:1]))
    shared = one.has_depth & both.has_depth
    assert both.has_depth.sum() >= one.has_depth.sum()
    assert np.median(both.covariances[shared, 2, 2] / one.covariances[shared, 2, 2]) < 0.3


def test_located_without_baseline_has_no_depth() -> None:
    rng = np.random.default_rng(7)
    points = points_of(rng, 50)
    # Body turns about the camera's centre, which does not move.
    turn = CAMERA.body_T_cam @ se3(so3_exp(np.array([0.0, 0.1, 0.0])), np.zeros(3)) @ CAMERA.cam_T_body
    neighbours = [(seen(points, turn, rng), measured(turn, rng))]
    for given in (neighbours, []):
        assert not located(CAMERA, 1, seen(points, np.eye(4), rng), given).frame.has_depth.any()


def test_resect_features_of_single_cameras_is_consistent() -> None:
    """With a third of the matches wrong, in metres: the later place needs no depth."""
    rng = np.random.default_rng(8)
    squares = []
    for _ in range(8):
        points = points_of(rng, 200)
        reference = located(
            CAMERA, 1, seen(points, np.eye(4), rng), [(seen(points, SIDEWAYS, rng), measured(SIDEWAYS, rng))]
        )
        ref_T_cur = se3(so3_exp(rng.normal(0.0, 0.05, 3)), rng.normal(0.0, 0.2, 3))
        current = undetermined(CAMERA, 2, seen(points, ref_T_cur, rng).pixels)
        rows = np.column_stack([np.arange(200), np.arange(200)])
        wrong = rng.choice(200, 66, replace=False)
        rows[wrong, 1] = rng.permutation(rows[wrong, 1])
        shifts = {0: reference.shifts}
        found = resect_features(RIG, {0: reference.frame}, {0: current}, {(0, 0): rows}, Config(), [1], shifts)
        assert found is not None
        assert not found.is_registered
        error = se3_log(found.cur_T_ref @ ref_T_cur)
        assert np.linalg.norm(error[3:]) < 0.05
        squares.append(error @ np.linalg.solve(found.covariance + found.shared_covariance, error))
    assert np.mean(squares) < 15.0


@pytest.fixture(scope="module")
def record() -> SessionRecord:
    """A session whose keyframes' motions are known, but for one."""
    made = make_session(10.0, 1, Imu(), 0).record
    keyframes = np.flatnonzero(made.is_keyframe)
    made.keyframe_before[keyframes[1:]] = keyframes[:-1]
    made.keyframe_covariance[keyframes[1:]] = np.diag(SIGMAS**2)
    made.keyframe_before[keyframes[5]] = -1
    return made


def test_place_motion_covariance_adds_up_along_the_chain(record: SessionRecord) -> None:
    """Compared with random errors of the single motions."""
    rows = np.flatnonzero(record.is_keyframe)[:4]
    rng = np.random.default_rng(9)
    steps = [se3_inverse(record.smoothed[a]) @ record.smoothed[b] for a, b in pairwise(rows)]
    there, back = (place_motion(record, *map(int, ends)) for ends in ((rows[0], rows[-1]), (rows[-1], rows[0])))
    assert there is not None
    assert back is not None
    errors = []
    for _ in range(3000):
        chain = np.eye(4)
        for step in steps:
            chain = chain @ step @ se3_exp(SIGMAS * rng.standard_normal(6))
        pair = (there.place_T_neighbour, chain), (back.place_T_neighbour, se3_inverse(chain))
        errors.append([se3_log(se3_inverse(mean) @ one) for mean, one in pair])
    for which, motion in enumerate((there, back)):
        sampled = np.cov(np.array(errors)[:, which].T)
        whitened = np.linalg.solve(motion.covariance, sampled)
        np.testing.assert_allclose(np.linalg.eigvals(whitened).real, 1.0, atol=0.15)


def test_place_motion_of_a_broken_chain_is_not_known(record: SessionRecord) -> None:
    rows = np.flatnonzero(record.is_keyframe)
    assert place_motion(record, int(rows[3]), int(rows[6])) is None
    assert place_motion(record, int(rows[6]), int(rows[3])) is None
    assert place_motion(record, int(rows[5]), int(rows[6])) is not None
