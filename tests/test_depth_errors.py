"""What errors within a pair do to depths, and those to a motion, against wrong pairs and refined motions."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import seen_points, transform, two_pair_rig

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.frontend.depth.stereo import triangulate
from graphvio.frontend.motion.depth_errors import by_depth_errors
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.frontend.motion.refinement import refine
from graphvio.geometry import se3_inverse, se3_log
from graphvio.rig import Rig
from graphvio.self_calibration.parameters import (
    BODY,
    PAIR,
    RIGHT,
    STEREO,
    depths_of_pair,
    moved_cameras,
    n_camera_parameters,
)

RIG = two_pair_rig()
MOTION = transform([0.05, -0.1, 0.08], [0.2, -0.12, 0.15])
OFFSET, SHARE = 0, 1
CENTRE_AND_STEREO = [2, 3, RIGHT + 2, RIGHT + 3, *range(STEREO, BODY)]


def with_wrong_depths(observations: Observations, pair: int, offset: float, share: float) -> Observations:
    """Both instants as a pair sees them whose inverse depths are wrong."""
    arrays, rows = RigArrays.of(RIG), observations.pair == pair
    left_motion = arrays.cam_T_body[pair, 0] @ MOTION @ arrays.body_T_left[pair]
    points, right = observations.points.copy(), observations.right.copy()
    x, y, inverse = observations.points[rows].T
    moved = np.column_stack([x, y, np.ones(len(x))]) @ left_motion[:3, :3].T + inverse[:, None] * left_motion[:3, 3]
    inverse_now = inverse / moved[:, 2]
    points[rows, 2] += offset + share * inverse
    wrong_now = inverse_now + offset + share * inverse_now
    right_T_left = arrays.cam_T_body[pair, 1] @ se3_inverse(arrays.cam_T_body[pair, 0])
    rays = np.column_stack([observations.left[rows], np.ones(len(x))])
    seen = rays @ right_T_left[:3, :3].T + wrong_now[:, None] * right_T_left[:3, 3]
    right[rows] = seen[:, :2] / seen[:, 2:]
    return observations._replace(points=points, right=right)


@pytest.mark.parametrize("pair", [0, 1])
@pytest.mark.parametrize(("kind", "step"), [(OFFSET, 1e-4), (SHARE, 1e-3)])
def test_motion_by_wrong_depths_is_as_its_derivatives_say(pair: int, kind: int, step: float) -> None:
    arrays, config = RigArrays.of(RIG), Config().motion
    observations = seen_points(RIG, MOTION, 150, np.random.default_rng(3))
    right = refine(arrays, observations, MOTION, config)
    offset, share = (step, 0.0) if kind == OFFSET else (0.0, step)
    wrong = refine(arrays, with_wrong_depths(observations, pair, offset, share), MOTION, config)
    expected = se3_log(wrong.cur_T_ref @ se3_inverse(right.cur_T_ref)) / step
    found = by_depth_errors(arrays, observations, right.inlier, np.ascontiguousarray(right.cur_T_ref))
    assert np.linalg.norm(expected[3:]) > 0.01
    np.testing.assert_allclose(found[pair, kind], expected, atol=0.3 * np.abs(expected).max())


def test_motion_by_one_pair_does_not_depend_on_the_others_depths() -> None:
    arrays = RigArrays.of(RIG)
    observations = seen_points(RIG, MOTION, 50, np.random.default_rng(4)).of_pair(1)
    found = by_depth_errors(arrays, observations, np.ones(50, dtype=bool), MOTION)
    assert not found[0].any()
    assert found[1].any()


def inverse_depth_in_the_middle(rig: Rig, pair: int, nominal: Rig, inverse_depth: float) -> float:
    """What a rig makes of a point in the middle of the left image of the nominal one, by the same pixels."""
    seen_by, taken_for = nominal.pairs[pair], rig.pairs[pair]
    point = np.array([0.0, 0.0, 1.0])
    there = seen_by.right_T_left[:3, :3] @ point + inverse_depth * seen_by.right_T_left[:3, 3]
    pixels = [
        camera.intrinsics[:2] * ray[:2] / ray[2] + camera.intrinsics[2:]
        for camera, ray in ((seen_by.left, point), (seen_by.right, there))
    ]
    left, right = (
        ((pixel - camera.intrinsics[2:]) / camera.intrinsics[:2])[None]
        for camera, pixel in zip((taken_for.left, taken_for.right), pixels, strict=True)
    )
    points, _, _ = triangulate(left, right, taken_for.right_T_left, 1.0, 1.0)
    return float(points[0, 2])


def other_depths(difference: Float, pair: int, inverse_depth: float) -> float:
    return inverse_depth_in_the_middle(moved_cameras(RIG, difference), pair, RIG, inverse_depth) - inverse_depth


@pytest.mark.parametrize("pair", [0, 1])
@pytest.mark.parametrize("parameter", CENTRE_AND_STEREO)
def test_depths_of_a_pair_change_with_its_calibration(pair: int, parameter: int) -> None:
    difference = np.zeros(n_camera_parameters(RIG))
    difference[PAIR * pair + parameter] = step = 1e-3 if parameter < STEREO else 1e-6
    offset, share = depths_of_pair(RIG, pair) @ difference / step
    far = other_depths(difference, pair, 0.0) / step
    near = (other_depths(difference, pair, 0.2) / step - far) / 0.2
    assert offset == pytest.approx(far, rel=0.02, abs=1e-6)
    assert share == pytest.approx(near, rel=0.1, abs=0.3)


def test_depths_of_a_pair_do_not_change_with_another_one() -> None:
    rows = depths_of_pair(RIG, 0)
    assert rows[:, :PAIR].any()
    assert not rows[:, PAIR:].any()
