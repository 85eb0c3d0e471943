"""A rig file that is far off at the first images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from real_clip import CLIP, real_clip

from graphvio import Config, Estimate, Odometry, open_source
from graphvio.evaluation import evaluate
from graphvio.measurements.events import EventKind
from graphvio.measurements.sensors import ImuSample
from graphvio.rig import Rig
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.sources import Source
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory


def with_lower_right_images(rig: Rig, rows_px: float) -> Rig:
    """Return a rig of the front pair alone, whose file has all of the right image some rows too low."""
    pair = rig.pairs[0]
    right = replace(pair.right, intrinsics=pair.right.intrinsics + np.array([0.0, 0.0, 0.0, rows_px]))
    return replace(rig, pairs=(replace(pair, right=right),))


def ate_m(estimates: list[Estimate], source: Source) -> float:
    """Return the root mean square of the errors of all positions, after alignment to the recording's truth."""
    assert source.truth is not None
    stamps = [estimate.stamp_ns for estimate in estimates if estimate.nav_T_body is not None]
    poses = [estimate.nav_T_body for estimate in estimates if estimate.nav_T_body is not None]
    return evaluate(Trajectory(np.array(stamps), np.array(poses)), load_trajectory(source.truth)).ate_position_m.rmse


@pytest.mark.parametrize("rows_px", [-6.0, 4.0])
def test_first_images_correct_epipolar_lines_that_are_rows_off(room_walk: Path, rows_px: float) -> None:
    rig = with_lower_right_images(open_source(room_walk).rig, rows_px)
    source = open_source(room_walk, rig, to_s=3.0)
    assert source.truth is not None
    truth = load_trajectory(source.truth)
    odometry = Odometry(rig, Config())
    estimates = [estimate for estimate in map(odometry.process, source) if estimate is not None]
    estimates += odometry.finish()
    failed = [event for event in odometry.take_events() if event.kind in (EventKind.VISION_FAILED, EventKind.LOST)]
    assert not failed
    assert odometry.calibration is not None
    assert not odometry.calibration.is_file_exact
    moved = [pose[:3, 3] for pose in truth.nav_T_body]
    true_m = {int(ns): float(np.linalg.norm(p - moved[0])) for ns, p in zip(truth.stamps_ns, moved, strict=True)}
    last = estimates[-1]
    assert last.nav_T_body is not None
    assert true_m[last.stamp_ns] > 0.5
    assert np.linalg.norm(last.nav_T_body[:3, 3]) == pytest.approx(true_m[last.stamp_ns], rel=0.01)


@pytest.mark.skipif(not CLIP.exists(), reason="the real recording is not here")
@pytest.mark.parametrize("rows_px", [-6.0, 4.0])
def test_real_texture_that_looks_alike_by_chance_does_not_hide_lines_that_are_rows_off(rows_px: float) -> None:
    source = open_source(real_clip())
    rig = with_lower_right_images(source.rig.without_imu(), rows_px)
    odometry = Odometry(rig, Config())
    estimates = [
        estimate for estimate in map(odometry.process, open_source(real_clip(), rig, to_s=3.0)) if estimate is not None
    ]
    estimates += odometry.finish()
    failed = [event for event in odometry.take_events() if event.kind in (EventKind.VISION_FAILED, EventKind.LOST)]
    assert not failed
    assert ate_m(estimates, source) < 0.005


@pytest.mark.skipif(not CLIP.exists(), reason="the real recording is not here")
@pytest.mark.parametrize("draw_seed", [0, 5])
def test_imu_of_another_clock_is_kept_from_a_start_in_motion(draw_seed: int) -> None:
    """The time offset is 8 ms off, and vision is refused until that is known: the IMU is corrected, not left out."""
    estimates, kinds = run_with_files_of_long_ago(draw_seed, 0.0, 5.0)
    assert not kinds & {EventKind.IMU_LEFT_OUT, EventKind.LOST, EventKind.VISION_FAILED}
    assert ate_m(estimates, open_source(real_clip())) < 0.01


@pytest.mark.skipif(not CLIP.exists(), reason="the real recording is not here")
@pytest.mark.parametrize(("draw_seed", "from_s"), [(2, 2.0), (2, 4.0)])
def test_single_camera_does_not_begin_with_a_scale_by_files_that_it_contradicts(draw_seed: int, from_s: float) -> None:
    """By the file as it is, one motion fits, and the IMU agrees, with a scale that is far off: 6 and 8 cm."""
    estimates, kinds = run_with_files_of_long_ago(draw_seed, from_s, from_s + 5.0, cameras=["cam0"])
    assert not kinds & {EventKind.LOST, EventKind.VISION_FAILED}
    poses = [estimate for estimate in estimates if estimate.nav_T_body is not None]
    assert len(poses) > 30
    assert ate_m(poses, open_source(real_clip())) < 0.02


def run_with_files_of_long_ago(
    draw_seed: int, from_s: float, to_s: float, cameras: list[str] | None = None
) -> tuple[list[Estimate], set[str]]:
    """Run a part of the clip by a rig file that is wrong, and an IMU with scale and misalignment."""
    source = open_source(real_clip())
    error = draw(source.rig, CalibrationErrorSizes.of_level(3), draw_seed)
    assert error.true_rig.imu is not None
    rig = replace(error.written_rig, imu=error.true_rig.imu)  # the samples are as they are, and the rig is off
    if cameras is not None:
        rig = rig.with_only(cameras)
    odometry, estimates = Odometry(rig, Config()), []
    for measurement in open_source(real_clip(), rig, from_s=from_s, to_s=to_s):
        if isinstance(measurement, ImuSample):
            rate, force = measurement.angular_velocity, measurement.linear_acceleration
            measurement = ImuSample(measurement.stamp_ns, error.imu.gyro_matrix @ rate, error.imu.accel_matrix @ force)
        estimates.append(odometry.process(measurement))
    estimates += odometry.finish()
    found = [estimate for estimate in estimates if estimate is not None]
    return found, {event.kind for event in odometry.take_events()}
