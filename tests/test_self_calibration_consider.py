"""What errors of the calibration add to the pose's covariance."""

import numpy as np
import pytest
from walked_views import Walk

from graphvio.arrays import Float
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log
from graphvio.self_calibration.adjustment import adjusted
from graphvio.self_calibration.consider import ConsiderCovariance
from graphvio.self_calibration.evidence import Gaussian
from graphvio.self_calibration.parameters import PAIR, STEREO, RigCalibration
from graphvio.self_calibration.prior import file_prior
from graphvio.self_calibration.window import Keyframe
from graphvio.simulation.default_rig import default_rig

N = 4


def keyframe(stamp_ns: int, seed: int) -> Keyframe:
    return Keyframe(stamp_ns, se3_exp(np.random.default_rng(seed).normal(0.0, 0.3, 6)), {})


def covariance(rng: np.random.Generator) -> Float:
    root = rng.standard_normal((N, N))
    return root @ root.T + 0.1 * np.eye(N)


def test_consider_covariance_before_any_keyframe_is_zero() -> None:
    assert not ConsiderCovariance(N).at(np.eye(4)).any()


def test_consider_covariance_of_motions_with_one_calibration_adds_their_errors_and_not_their_squares() -> None:
    rng, known = np.random.default_rng(0), covariance(np.random.default_rng(1))
    keyframes = [keyframe(k, k) for k in range(6)]
    by_cameras = np.concatenate([np.zeros((1, 6, N)), rng.standard_normal((5, 6, N))])
    whole, grown = ConsiderCovariance(N), ConsiderCovariance(N)
    for consider, sizes in ((whole, (6,)), (grown, (1, 3, 4, 6))):
        consider.set_calibration_in_force(np.zeros(N), known)
        for size in sizes:
            consider.extend(keyframes[:size], by_cameras[:size])
    expected = by_cameras[-1] @ known @ by_cameras[-1].T
    newest = keyframes[-1].odom_T_body
    np.testing.assert_allclose(whole.at(newest), expected, atol=1e-12)
    np.testing.assert_allclose(grown.at(newest), expected, atol=1e-9)


def test_consider_covariance_with_a_better_calibration_is_that_of_the_errors() -> None:
    rng = np.random.default_rng(0)
    start, first, second = keyframe(0, 0), keyframe(1, 1), keyframe(2, 2)
    carried = se3_adjoint(se3_inverse(second.odom_T_body) @ first.odom_T_body)
    of_first, of_second = 1e-3 * rng.standard_normal((2, 6, N))  # errors so small that they add up
    before, measured = covariance(rng), rng.standard_normal((2, N))
    gain = before @ measured.T @ np.linalg.inv(measured @ before @ measured.T + 0.1 * np.eye(2))
    after = before - gain @ measured @ before
    nees, squares, reported = [], np.zeros((6, 6)), np.zeros((6, 6))
    for _ in range(4000):
        true = rng.multivariate_normal(np.zeros(N), before)
        learnt = gain @ (measured @ true + np.sqrt(0.1) * rng.standard_normal(2))
        consider = ConsiderCovariance(N)
        consider.set_calibration_in_force(np.zeros(N), before)
        consider.extend([start, first], np.array([np.zeros((6, N)), of_first]))
        consider.set_calibration_in_force(learnt, after)
        consider.extend([first, second], np.array([np.zeros((6, N)), of_second]))
        error = carried @ of_first @ true + of_second @ (true - learnt)
        added = consider.at(second.odom_T_body)
        nees.append(error @ np.linalg.solve(added + 1e-9 * np.eye(6), error))
        squares, reported = squares + np.outer(error, error) / 4000, reported + added / 4000
    assert reported == pytest.approx(squares, abs=0.1 * np.abs(squares).max())
    assert 3.0 < np.mean(nees) < 5.0  # four parameters, and what was learnt of them


def test_consider_covariance_of_large_turns_has_their_terms_of_second_order() -> None:
    rng, nees = np.random.default_rng(3), []
    for _ in range(200):
        consider = ConsiderCovariance(N)
        consider.extend([Keyframe(0, np.eye(4), {}), Keyframe(1, np.eye(4), {})], np.zeros((2, 6, N)))
        pose = np.eye(4)
        for change in rng.normal(0.0, [0.03, 0.03, 0.03, 0.1, 0.1, 0.1], (4, 6)):
            consider.correct(change)
            pose = pose @ se3_exp(change)
        error, added = se3_log(pose), consider.at(np.eye(4))
        assert np.linalg.matrix_rank(added) == 6
        nees.append(error @ np.linalg.solve(added, error) / 6)
    assert 0.1 < np.median(nees) < 1.0
    assert np.quantile(nees, 0.95) < 3.0


def test_consider_covariance_at_a_later_pose_grows_with_the_lever_arm() -> None:
    consider = ConsiderCovariance(N)
    consider.set_calibration_in_force(np.zeros(N), np.eye(N))
    by_cameras = np.zeros((2, 6, N))
    by_cameras[1, 2, 0] = 0.01  # a turn about z
    consider.extend([Keyframe(0, np.eye(4), {}), Keyframe(1, np.eye(4), {})], by_cameras)
    ahead = np.eye(4)
    ahead[0, 3] = 2.0
    added = consider.at(ahead)
    assert np.sqrt(added[2, 2]) == pytest.approx(0.01)
    assert np.sqrt(added[4, 4]) == pytest.approx(0.02)


def test_consider_covariance_after_a_knock_keeps_what_there_is_and_no_correlation() -> None:
    consider = ConsiderCovariance(N)
    consider.set_calibration_in_force(np.zeros(N), np.eye(N))
    frames = [keyframe(0, 0), keyframe(1, 1)]
    consider.extend(frames, np.array([np.zeros((6, N)), np.ones((6, N))]))
    before = consider.at(frames[1].odom_T_body)
    consider.forget()
    consider.set_calibration_in_force(np.ones(N), 100.0 * np.eye(N))
    np.testing.assert_allclose(consider.at(frames[1].odom_T_body), before)


@pytest.mark.parametrize("parameter", [0, 2, STEREO + 1, STEREO + 3, PAIR + STEREO + 1, 2 * PAIR - 6])
def test_poses_by_cameras_equal_the_poses_of_another_calibration(parameter: int) -> None:
    rig = default_rig().without_imu()
    nominal, walk = RigCalibration.of(rig), Walk(rig, sigma_px=0.0)
    keyframes = tuple(
        Keyframe(round(1e9 * at_s), walk.pose(at_s), walk.views(walk.pose(at_s))) for at_s in (3.0, 3.2, 3.4, 3.6)
    )
    sigma = np.sqrt(np.diag(file_prior(rig).covariance))[parameter]
    step = np.zeros(2 * PAIR)
    step[parameter] = 0.1 * sigma

    def solved(difference: Float) -> tuple[Float, Float]:
        exactly = Gaussian(difference, 1e20 * np.eye(len(difference)))
        solution = adjusted(keyframes, None, nominal, difference, exactly, 0.15)
        return solution.states.poses, solution.poses_by_cameras(len(difference))

    poses, by_cameras = solved(np.zeros(2 * PAIR))
    moved, _ = solved(step)
    assert not by_cameras[0].any()
    found = np.array([se3_log(se3_inverse(pose) @ other) for pose, other in zip(poses[1:], moved[1:], strict=True)])
    expected = by_cameras[1:, :, parameter] * step[parameter]
    assert np.abs(found).max() > 1e-7
    np.testing.assert_allclose(found, expected, atol=0.03 * np.abs(expected).max())
