"""Calibration of cameras from trajectories on clocks of their own."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hand_eye import LEFT2_T_LEFT1
from monte_carlo import band
from recordings import REAL_DATA
from scipy.stats import chi2

from graphvio import Calibration, CalibrationError, calibrate_trajectories
from graphvio.arrays import Float
from graphvio.calibration.clocks import ClockRelation
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

SECONDS = 30.0
OFFSET_S = 123.4567
WORLD_T_WORLD = se3_exp(np.array([0.3, -0.2, 2.0, 5.0, -3.0, 1.0]))
SIGMAS = np.repeat([8e-4, 1.5e-3], 3)  # of each pose


def walk(time_s: float) -> Float:
    waves = np.array([1.1, 0.7, 0.45, 0.5, 0.3, 0.6]) * time_s + np.arange(6)
    swing = np.array([0.3, 0.5, 0.8, 0.4, 0.8, 0.6]) * np.sin(waves) + 0.1 * np.sin(2.3 * waves)
    return se3_exp(np.ascontiguousarray(swing))


def trajectory(
    seed: int,
    rate_hz: float,
    place: Float,
    *,
    offset_s: float = 0.0,
    drift: float = 0.0,
    scale: float = 1.0,
    begin_s: float = 0.0,
    end_s: float = SECONDS,
) -> Trajectory:
    """Trajectory that an odometry measures for a camera at a pose on the rig."""
    rng = np.random.default_rng(seed)
    times = np.arange(begin_s, end_s, 1.0 / rate_hz) + 1e-3 * rng.random()
    poses = []
    for time in times:
        pose = WORLD_T_WORLD @ walk(float(time)) @ place @ se3_exp(SIGMAS * rng.standard_normal(6))
        pose[:3, 3] *= scale
        poses.append(pose)
    stamps = np.round((times + offset_s + drift * (times - 0.5 * SECONDS)) * 1e9).astype(np.int64) + 10**18
    return Trajectory(stamps, np.array(poses))


@cache
def first() -> Trajectory:
    return trajectory(1, 33.0, np.eye(4))


def second(**options: float) -> Trajectory:
    return trajectory(2, 50.0, se3_inverse(LEFT2_T_LEFT1), **options)


@cache
def calibration() -> Calibration:
    """Of clocks that are apart, and go alike."""
    return calibrate_trajectories([first(), second(offset_s=OFFSET_S)])


def check(found: Calibration) -> None:
    off = se3_log(se3_inverse(found.left2_T_left1) @ LEFT2_T_LEFT1)
    assert off @ np.linalg.solve(found.covariance, off) < chi2.isf(1e-4, 6)
    sigmas = np.sqrt(np.diag(found.covariance))
    assert sigmas[:3].max() < 2e-3
    assert sigmas[3:].max() < 7e-3


def test_calibrate_trajectories_finds_offset_and_pose() -> None:
    found = calibration()
    check(found)
    assert found.clocks is not None
    clock = found.clocks[0, 1]
    assert abs(clock.relation.offset_ns * 1e-9 - OFFSET_S) < 4.0 * clock.offset_sigma_s
    assert clock.offset_sigma_s < 1e-3
    assert not clock.drifts
    assert found.warnings == ()


def test_calibrate_trajectories_drift_is_corrected() -> None:
    drift = 4e-4
    found = calibrate_trajectories([first(), second(offset_s=OFFSET_S, drift=drift)])
    check(found)
    assert found.clocks is not None
    clock = found.clocks[0, 1]
    assert clock.drifts
    assert abs(clock.relation.drift - drift) < 4.0 * clock.drift_sigma
    assert any("drift apart by" in sentence for sentence in found.warnings)


def test_calibrate_trajectories_same_clock_has_no_relation() -> None:
    found = calibrate_trajectories([first(), second()], same_clock=True)
    check(found)
    assert found.clocks is None


def test_calibrate_trajectories_wrong_scale_is_found() -> None:
    found = calibrate_trajectories([first(), second(offset_s=OFFSET_S, scale=1.04)], ["left", "right"])
    check(found)
    assert found.pair.scale_estimated
    assert abs(found.pair.scale.log_ratio - np.log(1.04)) < 4.0 * found.pair.scale.sigma
    assert any("right measures lengths" in sentence and "longer than left" in sentence for sentence in found.warnings)


def test_calibrate_trajectories_jumps_are_outliers() -> None:
    jumping = second(offset_s=OFFSET_S)
    poses = jumping.nav_T_body.copy()
    for k in range(200, len(poses), 300):
        poses[k:, :3, 3] += 0.2
    found = calibrate_trajectories([first(), Trajectory(jumping.stamps_ns, poses)])
    check(found)
    assert 0.8 < found.inliers.mean() < 1.0


def test_calibrate_trajectories_repeated_gives_same_bits() -> None:
    one, other = calibration(), calibrate_trajectories([first(), second(offset_s=OFFSET_S)])
    np.testing.assert_array_equal(one.left2_T_left1, other.left2_T_left1)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_calibrate_trajectories_wrong_same_clock_raises() -> None:
    with pytest.raises(CalibrationError, match="do not overlap in time; if each has a clock of its own"):
        calibrate_trajectories([first(), second(offset_s=OFFSET_S)], same_clock=True)


def test_calibrate_trajectories_one_trajectory_raises() -> None:
    with pytest.raises(CalibrationError, match="takes two or more"):
        calibrate_trajectories([first()])


def test_calibrate_trajectories_errors_are_within_sigmas() -> None:
    """Over several runs, offset, drift and pose scatter by their sigmas."""
    offsets, drifts, squares = [], [], []
    for seed in range(6):
        one = trajectory(100 + seed, 17.0, np.eye(4))
        other = trajectory(200 + seed, 25.0, se3_inverse(LEFT2_T_LEFT1), offset_s=OFFSET_S)
        found = calibrate_trajectories([one, other])
        assert found.clocks is not None
        clock = found.clocks[0, 1]
        offset_s = clock.relation.offset_ns * 1e-9 - OFFSET_S
        offsets.append(offset_s / clock.offset_sigma_s)
        drifts.append(clock.relation.drift / clock.drift_sigma)
        off = se3_log(se3_inverse(found.left2_T_left1) @ LEFT2_T_LEFT1)
        squares.append(off @ np.linalg.solve(found.covariance, off))
    _, high = band(6, 1)
    assert np.mean(np.square(offsets)) < 1.5 * high
    assert np.mean(np.square(drifts)) < 1.5 * high
    assert np.mean(squares) < band(6)[1]
    assert np.mean(squares) > 0.3 * band(6)[0]


def test_calibrate_trajectories_same_trajectory_raises() -> None:
    with pytest.raises(CalibrationError, match="are the same trajectory"):
        calibrate_trajectories([first(), first()])


def test_calibrate_trajectories_equal_names_raises() -> None:
    with pytest.raises(CalibrationError, match="as many different names"):
        calibrate_trajectories([first(), second()], ["a", "a"])


def test_calibrate_trajectories_different_walks_raises() -> None:
    elsewhere = replace(second(), nav_T_body=np.array([se3_inverse(pose) for pose in second().nav_T_body[::-1]]))
    with pytest.raises(CalibrationError, match="camera 0 and camera 1: "):
        calibrate_trajectories([first(), elsewhere])


def test_clock_relation_maps_stamps() -> None:
    relation = ClockRelation(offset_ns=5, drift=1e-3, at_ns=1_000_000)
    np.testing.assert_array_equal(relation.of(np.array([1_000_000, 2_000_000])), [1_000_005, 2_001_005])


@pytest.mark.skipif(not (REAL_DATA / "tango_triplet").is_dir(), reason="shared/data/tango_triplet is not here")
def test_calibrate_trajectories_real_devices_close_loop() -> None:
    files: list[Path] = sorted((REAL_DATA / "tango_triplet").glob("*.csv"))
    whole = [load_trajectory(file) for file in files]
    begins = [each.select(slice(0, 3 * len(each) // 4)) for each in whole]
    found = calibrate_trajectories(begins, [file.stem[:6] for file in files])
    (loop,) = found.places.loops
    assert np.rad2deg(np.linalg.norm(loop.error[:3])) < 0.3
    assert np.linalg.norm(loop.error[3:]) < 0.012
    assert loop.statistic < chi2.isf(1e-3, 6)
    assert max(found.places.distances.values()) < chi2.isf(1e-3, 6)
    assert found.clocks is not None
    offsets = [found.clocks[pair].relation.offset_ns * 1e-9 for pair in ((0, 1), (1, 2), (0, 2))]
    assert abs(offsets[0] + offsets[1] - offsets[2]) < 3e-3
