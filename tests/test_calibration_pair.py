"""Two pairs calibrated from what each tells of its own motion."""

from collections.abc import Callable

import numpy as np
import pytest
from hand_eye import LEFT2_T_LEFT1, PERIOD_NS
from monte_carlo import band

from graphvio.arrays import Float
from graphvio.calibration.camera_motions import CameraMotions
from graphvio.calibration.pair_calibration import PairCalibration, calibrate_pair
from graphvio.calibration.spans import Stretches, all_stretches
from graphvio.errors import CalibrationError
from graphvio.frontend.motion import RelativeMotion
from graphvio.geometry import se3_exp, se3_inverse, se3_log

FRAMES = 240
SIGMAS = np.repeat([3e-4, 5e-4], 3)
Walk = Callable[[float], Float]


def turning(time_s: float) -> Float:
    """A walk with turns about all axes."""
    waves = np.sin(np.array([1.1, 0.7, 0.4, 0.5, 0.3, 0.6]) * time_s + np.arange(6))
    return se3_exp(np.array([0.3, 0.5, 0.8, 0.4, 0.8, 0.6]) * waves)


def planar(time_s: float) -> Float:
    """A cart: it turns about the camera's y axis, which is vertical, and moves on the floor."""
    turned = se3_exp(np.array([0.0, 0.9 * np.sin(0.5 * time_s), 0.0, 0.0, 0.0, 0.0]))
    turned[:3, 3] = [np.sin(0.4 * time_s), 0.0, 0.5 * np.cos(0.3 * time_s)]
    return turned


def straight(time_s: float) -> Float:
    moved = np.eye(4)
    moved[:3, 3] = [0.3 * np.sin(time_s), 0.2 * np.cos(0.7 * time_s), 0.5 * time_s]
    return moved


def motions(walk: Walk, to_camera: Float, rng: np.random.Generator, moved: Float | None = None) -> CameraMotions:
    """What a camera on the walk tells of itself from frame to frame.

    Args:
        walk: poses of the first camera at times.
        to_camera: pose of the camera in the first one.
        rng: source of errors.
        moved: pose in the first camera from the middle of the walk on, if it was knocked.
    """
    stamps = [k * PERIOD_NS for k in range(FRAMES)]
    told = []
    for k in range(1, FRAMES):
        place = to_camera if moved is None or k < FRAMES // 2 else moved
        one, other = (walk(stamps[i] * 1e-9) @ place for i in (k - 1, k))
        measured = np.linalg.inv(one) @ other @ se3_exp(SIGMAS * rng.standard_normal(6))
        told.append(RelativeMotion(stamps[k - 1], stamps[k], measured, np.diag(SIGMAS**2), np.zeros((6, 6)), 200))
    return CameraMotions(stamps, told, np.eye(4))


def stretches(walk: Walk, seed: int, moved: Float | None = None) -> Stretches:
    rng = np.random.default_rng(seed)
    one, other = motions(walk, np.eye(4), rng), motions(walk, se3_inverse(LEFT2_T_LEFT1), rng, moved)
    return all_stretches(one.stamps_ns.tolist(), [one.between, other.between])


def calibrated(walk: Walk, seed: int) -> PairCalibration:
    return calibrate_pair(stretches(walk, seed))


def test_errors_are_within_what_is_told() -> None:
    runs = 24
    found = [calibrated(turning, seed) for seed in range(runs)]
    low, high = band(runs)
    assert low < np.mean([each.distance(LEFT2_T_LEFT1) for each in found]) < high
    for each in found:
        assert each.warnings == ()
        sigmas = np.sqrt(np.diag(each.covariance))
        assert sigmas[:3].max() < 2e-3
        assert sigmas[3:].max() < 6e-3
        assert each.inlier.mean() > 0.98
        assert each.alignment_errors_m.mean() < 5e-3


def test_planar_motion_gives_a_partial_answer_that_says_so() -> None:
    found = calibrated(planar, 0)
    assert not found.observability.is_complete
    assert any("offset along y (down) cannot be found" in sentence for sentence in found.warnings)
    off = se3_log(se3_inverse(found.left2_T_left1) @ LEFT2_T_LEFT1)
    assert np.linalg.norm(off[:3]) < 5e-3
    assert np.linalg.norm(off[[3, 5]]) < 0.01
    sigmas = np.sqrt(np.diag(found.covariance))
    assert sigmas[4] > 1.0  # nothing is claimed of the height
    assert sigmas[[3, 5]].max() < 0.02


def test_moving_without_turning_is_refused() -> None:
    with pytest.raises(CalibrationError, match="turn it about two axes"):
        calibrated(straight, 0)


def test_a_camera_that_was_knocked_is_told() -> None:
    """Half of the motions fit one place, half another."""
    moved = se3_inverse(se3_exp(np.array([0.0, 0.2, 0.1, 0.1, 0.0, 0.1])) @ LEFT2_T_LEFT1)
    found = calibrate_pair(stretches(turning, 1, moved))
    assert found.inlier.mean() < 0.9
    early = found.pairs.end_ns < FRAMES // 2 * PERIOD_NS
    assert min(found.inlier[early].mean(), found.inlier[~early].mean()) < 0.3
    assert max(found.inlier[early].mean(), found.inlier[~early].mean()) > 0.9


def test_without_common_instants_there_is_nothing_to_calibrate_from() -> None:
    rng = np.random.default_rng(2)
    one = motions(turning, np.eye(4), rng)
    with pytest.raises(CalibrationError, match="needs 3 pose pairs and has 0"):
        calibrate_pair(all_stretches([], [one.between, one.between]))
