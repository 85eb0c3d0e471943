"""How the newest pose depends on the calibration since a keyframe: of wrong extrinsics, and of wrong depths."""

from __future__ import annotations

import numpy as np
import pytest

from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log
from graphvio.measurements.motion import RelativeMotion
from graphvio.self_calibration.motion_gains import MotionGains
from graphvio.self_calibration.parameters import about_origin, depths_of_pair, extrinsics_of, n_camera_parameters
from graphvio.simulation.default_rig import default_rig

RIG = default_rig()
N = n_camera_parameters(RIG)
STEP = se3_exp(np.array([0.05, -0.1, 0.2, 0.3, 0.05, -0.1]))
NONE: frozenset[int] = frozenset()


def motion(reference_ns: int, stamp_ns: int, by_depth_errors: np.ndarray | None) -> RelativeMotion:
    return RelativeMotion(reference_ns, stamp_ns, STEP, np.eye(6), np.zeros((6, 6)), 100, by_depth_errors)


def test_gain_of_wrong_extrinsics_is_that_of_the_motion_in_another_body() -> None:
    """All cameras are displaced in body by ``exp(d)``, and so is each motion that they measure."""
    gains, poses = MotionGains(RIG), [np.linalg.matrix_power(STEP, k) for k in range(4)]
    for k, pose in enumerate(poses):
        gains.add(k, k, pose, None, NONE)
        if k == 1:
            gains.note_keyframe(k)
    found = gains.since(1)
    assert found is not None
    d = 1e-4 * np.array([1.0, -2.0, 0.5, 1.0, 3.0, -1.0])
    change = np.zeros(N)
    for j in range(len(RIG.pairs)):
        change[extrinsics_of(RIG, j)] = np.linalg.solve(about_origin(RIG, j), d)
    true = se3_inverse(poses[1]) @ poses[3]
    measured = se3_exp(d) @ true @ se3_inverse(se3_exp(d))
    np.testing.assert_allclose(found.by_cameras @ change, se3_log(se3_inverse(true) @ measured), rtol=0.02, atol=1e-7)
    assert gains.since(2) is None  # no keyframe


def test_gain_of_wrong_depths_adds_up_over_references() -> None:
    rng = np.random.default_rng(0)
    of_first, of_second = rng.standard_normal((2, 2, 2, 6))
    gains, poses = MotionGains(RIG), [np.linalg.matrix_power(STEP, k) for k in range(3)]
    gains.add(0, 0, poses[0], None, NONE)
    gains.note_keyframe(0)
    gains.add(1, 1, poses[1], motion(0, 1, of_first), frozenset({0}))
    gains.add(2, 2, poses[2], motion(1, 2, of_second), frozenset({1}))
    found = gains.since(0)
    assert found is not None
    change = np.zeros(N)
    change[:8] = 1e-3 * rng.standard_normal(8)  # of a lens: depths, and no extrinsics
    depths = np.array([depths_of_pair(RIG, j) @ change for j in range(2)])
    first, second = (-np.einsum("jk,jkt", depths, each) for each in (of_first, of_second))
    expected = se3_adjoint(se3_inverse(STEP)) @ first + second
    np.testing.assert_allclose(found.by_cameras @ change, expected, atol=1e-12)


def test_framesets_that_nothing_needs_are_forgotten() -> None:
    gains = MotionGains(RIG)
    for k in range(500):
        gains.add(k, k, np.eye(4), None, frozenset({3}))
        if k % 2:
            gains.note_keyframe(k)
    assert len(gains._framesets) < 70
    assert gains.since(499) is not None
    assert gains.since(1) is None
    gains.restart()
    assert gains.since(499) is None


def test_gain_since_the_keyframe_that_was_adjusted_last_is_known_however_long_ago_it_was() -> None:
    gains = MotionGains(RIG)
    for k in range(500):
        gains.add(k, 1000 + k, np.linalg.matrix_power(STEP, k % 7), None, NONE, None if k < 2 else 1001)
        gains.note_keyframe(1000 + k)
    found = gains.since(1001)
    assert found is not None
    assert found.by_cameras[:, extrinsics_of(RIG, 0)].any()
    assert gains.since(1002) is None


@pytest.mark.parametrize("stamp_ns", [0, 7])
def test_gain_without_a_frameset_is_unknown(stamp_ns: int) -> None:
    assert MotionGains(RIG).since(stamp_ns) is None
