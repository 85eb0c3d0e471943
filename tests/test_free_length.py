"""Motions that single cameras alone have measured: their length is free, and no longer than the rig can have moved."""

from __future__ import annotations

import numpy as np
import pytest

from graphvio.arrays import Float
from graphvio.frontend.motion.depth_scale import is_of_singles, with_free_length
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.frontend.motion.refinement import Refined
from graphvio.geometry import se3_exp, se3_inverse
from graphvio.measurements.motion import RelativeMotion
from graphvio.simulation.named_rigs import stereo_and_back

RIG = stereo_and_back()
ARRAYS, N = RigArrays.of(RIG), 6
BODY_T_CAM = RIG.singles[0].left.body_T_cam
COVARIANCE = np.diag(np.repeat([1e-8, 1e-4], 3))


def of_cameras(cameras: list[int]) -> Observations:
    none = np.zeros((N, 2))
    return Observations(np.array(cameras), np.zeros((N, 3)), np.zeros((N, 3, 3)), none, none, np.zeros(N, dtype=bool))


def body_motion(camera_shift: list[float]) -> Float:
    """``cur_T_ref`` of body for a translation of the single camera without rotation."""
    cur_T_ref = np.eye(4)
    cur_T_ref[:3, 3] = camera_shift
    return np.asarray(BODY_T_CAM @ cur_T_ref @ se3_inverse(BODY_T_CAM))


def measured(
    cur_T_ref: Float, cameras: list[int], predicted: Float | None, duration_ns: int = 100_000_000
) -> RelativeMotion:
    refined = Refined(cur_T_ref, COVARIANCE, np.zeros((6, 6)), np.ones(N, dtype=bool), np.zeros(N))
    motion = RelativeMotion(0, duration_ns, se3_inverse(cur_T_ref), COVARIANCE, np.zeros((6, 6)), N)
    return with_free_length(ARRAYS, of_cameras(cameras), refined, motion, predicted)


def of_camera(motion: RelativeMotion) -> tuple[Float, Float]:
    """The single camera's translation, and its standard deviations along x and y."""
    cur_T_ref = se3_inverse(BODY_T_CAM) @ se3_inverse(motion.reference_T_current) @ BODY_T_CAM
    cam_R_body = BODY_T_CAM[:3, :3].T
    return cur_T_ref[:3, 3], np.sqrt(np.diag(cam_R_body @ motion.covariance[3:, 3:] @ cam_R_body.T))[:2]


@pytest.mark.parametrize("cameras", [[0] * N, [0] + [1] * (N - 1)])
def test_motion_of_a_pair_stays_as_it_is(cameras: list[int]) -> None:
    motion = measured(se3_exp(np.full(6, 0.1)), cameras, np.eye(4))
    np.testing.assert_array_equal(motion.covariance, COVARIANCE)
    np.testing.assert_array_equal(motion.reference_T_current, se3_inverse(se3_exp(np.full(6, 0.1))))


def test_length_that_is_possible_stays_and_is_free() -> None:
    shift, sigmas = of_camera(measured(body_motion([0.05, 0.0, 0.0]), [1] * N, body_motion([0.06, 0.0, 0.0])))
    np.testing.assert_allclose(shift, [0.05, 0.0, 0.0], atol=1e-12)
    assert sigmas[0] == pytest.approx(np.hypot(0.05, 0.01), rel=1e-3)
    assert sigmas[1] == pytest.approx(np.hypot(0.01, 0.1 * 0.01), rel=1e-3)


def test_direction_is_as_uncertain_as_a_tenth_of_the_error_of_the_length() -> None:
    """After a standstill of seconds, by depths that are four times as large."""
    far, near = body_motion([0.2, 0.0, 0.0]), body_motion([0.05, 0.0, 0.0])
    shift, sigmas = of_camera(measured(far, [1] * N, near, 4_000_000_000))
    np.testing.assert_allclose(shift, [0.2, 0.0, 0.0], atol=1e-12)
    assert sigmas[1] == pytest.approx(np.hypot(0.01, 0.1 * 0.15), rel=1e-3)


def test_length_that_is_impossible_becomes_that_of_the_prediction() -> None:
    """0.06 m are predicted, and 0.01 m more are possible in 0.1 s: the direction is kept, and is bent by as much."""
    shift, sigmas = of_camera(measured(body_motion([2.0, 0.0, 0.0]), [1] * N, body_motion([0.06, 0.0, 0.0])))
    np.testing.assert_allclose(shift, [0.06, 0.0, 0.0], atol=1e-12)
    assert sigmas[0] == pytest.approx(0.07, rel=1e-3)
    assert sigmas[1] == pytest.approx(np.hypot(0.01 * 0.07 / 2.0, 0.1 * 0.01), rel=1e-2)


def test_only_motions_without_a_point_of_a_pair_are_of_singles() -> None:
    refined = Refined(np.eye(4), COVARIANCE, COVARIANCE, np.array([False] + [True] * (N - 1)), np.zeros(N))
    assert is_of_singles(ARRAYS, of_cameras([0] + [1] * (N - 1)), refined)  # the pair's is an outlier
    assert not is_of_singles(ARRAYS, of_cameras([0, 0] + [1] * (N - 2)), refined)
