"""Calibration of two pairs from the motion that each measures."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hand_eye import FRAMES, LEFT2_T_LEFT1, PERIOD_NS, Walk, motions, planar, straight, turning
from monte_carlo import band

from graphvio.arrays import Float
from graphvio.calibration.pair_calibration import PairCalibration, calibrate_pair
from graphvio.calibration.segments import Segments, all_segments
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_exp, se3_inverse, se3_log


def segments(walk: Walk, seed: int, moved: Float | None = None) -> Segments:
    rng = np.random.default_rng(seed)
    one, other = motions(walk, np.eye(4), rng), motions(walk, se3_inverse(LEFT2_T_LEFT1), rng, moved)
    return all_segments(one.stamps_ns.tolist(), [one.between, other.between])


@cache
def calibrated(walk: Walk, seed: int) -> PairCalibration:
    return calibrate_pair(segments(walk, seed))


def test_calibrate_pair_errors_are_within_covariance() -> None:
    runs = 8
    found = [calibrated(turning, seed) for seed in range(runs)]
    low, high = band(runs)
    assert low < np.mean([each.distance(LEFT2_T_LEFT1) for each in found]) < high
    for each in found:
        assert each.dispersion == 1.0
        assert not each.scale.is_wrong
        sigmas = np.sqrt(np.diag(each.covariance))
        assert sigmas[:3].max() < 2e-3
        assert sigmas[3:].max() < 6e-3
        assert each.inlier.mean() > 0.98
        assert each.alignment_errors_m.mean() < 5e-3


def test_calibrate_pair_sound_recording_passes_checks() -> None:
    found = calibrated(turning, 3)
    assert found.warnings == ()
    assert found.halves is not None
    assert found.halves.agree
    own, crossed = found.halves.own_m, found.halves.crossed_m
    assert max(crossed) < 1.3 * max(own)
    sigmas, resampled = (np.sqrt(np.diag(each)) for each in (found.covariance, found.resampled_covariance))
    assert np.all(resampled < 2.0 * sigmas)
    assert np.all(resampled > 0.3 * sigmas)
    sizes = [np.trace(grown.covariance) for grown in found.growth]
    assert len(sizes) > 3
    assert all(later < earlier for earlier, later in pairwise(sizes))
    np.testing.assert_allclose(found.growth[-1].left2_T_left1, found.left2_T_left1, atol=1e-9)


@pytest.mark.parametrize("wrong_by", [0.02, -0.03])
def test_calibrate_pair_wrong_baseline_is_corrected(wrong_by: float) -> None:
    made = segments(turning, 5)
    made.motions[:, 1, :3, 3] *= 1.0 + wrong_by
    found = calibrate_pair(made)
    assert found.scale.is_wrong
    assert found.scale_estimated
    assert abs(found.scale.log_ratio - np.log1p(wrong_by)) < 4.0 * found.scale.sigma
    assert found.scale.sigma < 0.005
    assert found.distance(LEFT2_T_LEFT1) < 22.5
    fixed = calibrate_pair(made, scale_mode="fixed")
    assert not fixed.scale_estimated
    assert fixed.scale.is_wrong
    assert fixed.distance(LEFT2_T_LEFT1) > found.distance(LEFT2_T_LEFT1)


def test_calibrate_pair_correlated_errors_enlarge_covariance() -> None:
    """One camera's scale wanders in time: the covariance of a single motion cannot show that."""
    made = segments(turning, 6)
    wandering = 1.0 + 0.06 * np.sin(made.start_ns * 1e-9)
    made.motions[:, 1, :3, 3] *= wandering[:, None]
    found = calibrate_pair(made, scale_mode="fixed")
    assert found.dispersion > 1.5
    sound = calibrated(turning, 6)
    assert np.trace(found.covariance[3:, 3:]) > 1.4 * np.trace(sound.covariance[3:, 3:])


def test_calibrate_pair_planar_motion_is_partial() -> None:
    found = calibrated(planar, 0)
    assert not found.observability.is_complete
    assert any("offset along y (down) cannot be found" in sentence for sentence in found.warnings)
    off = se3_log(se3_inverse(found.left2_T_left1) @ LEFT2_T_LEFT1)
    assert np.linalg.norm(off[:3]) < 5e-3
    assert np.linalg.norm(off[[3, 5]]) < 0.01
    sigmas = np.sqrt(np.diag(found.covariance))
    assert sigmas[4] > 1.0  # the height is not determined
    assert sigmas[[3, 5]].max() < 0.02


def test_calibrate_pair_without_rotation_raises() -> None:
    with pytest.raises(CalibrationError, match="turn the rig about two axes"):
        calibrated(straight, 0)


def test_calibrate_pair_moved_camera_halves_inliers() -> None:
    """Half of the motions fit one place, half another."""
    moved = se3_inverse(se3_exp(np.array([0.0, 0.2, 0.1, 0.1, 0.0, 0.1])) @ LEFT2_T_LEFT1)
    found = calibrate_pair(segments(turning, 1, moved))
    assert found.inlier.mean() < 0.9
    early = found.pairs.end_ns < FRAMES // 2 * PERIOD_NS
    assert min(found.inlier[early].mean(), found.inlier[~early].mean()) < 0.3
    assert max(found.inlier[early].mean(), found.inlier[~early].mean()) > 0.9


def test_calibrate_pair_no_common_instants_raises() -> None:
    rng = np.random.default_rng(2)
    one = motions(turning, np.eye(4), rng)
    with pytest.raises(CalibrationError, match="needs 3 pose pairs and has 0"):
        calibrate_pair(all_segments([], [one.between, one.between]))
