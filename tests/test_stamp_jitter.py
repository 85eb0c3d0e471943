"""Jitter of the framesets' stamps, and the odometry of cameras that are stamped when their images arrive."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from real_clip import CLIP, half_size_clip

from graphvio import FrameSet, Imu, Odometry, open_source
from graphvio.backend.preintegration import interval_params, is_as_stated, preintegrate, preintegration_params
from graphvio.backend.states import RigState
from graphvio.evaluation import evaluate
from graphvio.geometry import so3_log
from graphvio.measurements.events import EventKind
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.sensors import GRAVITY_M_S2 as G
from graphvio.odometry.stamp_jitter import StampJitter
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

PERIOD_NS = 50_000_000


def sigma_ms(stamps_ns: np.ndarray, groups: tuple[int, ...] = (0,)) -> float:
    jitter = StampJitter()
    for k, stamp_ns in enumerate(np.sort(stamps_ns).tolist()):
        jitter.add(stamp_ns, groups[k % len(groups)])
    return 1e3 * jitter.sigma_s


def test_regular_stamps_have_no_jitter() -> None:
    stamps = np.arange(40) * PERIOD_NS
    assert sigma_ms(stamps) == 0.0
    assert sigma_ms(stamps[:3]) == 0.0
    rng = np.random.default_rng(1)
    assert sigma_ms(stamps[rng.random(40) > 0.3]) == 0.0  # images are missing
    assert sigma_ms(stamps[np.arange(40) % 3 > 0]) == 0.0  # every third one
    assert sigma_ms(np.concatenate([stamps, stamps + 14_000_000]), (0, 1)) == 0.0  # pairs one after the other
    assert StampJitter().sigma_s == 0.0


def test_stamps_without_a_period_say_nothing() -> None:
    rng = np.random.default_rng(2)
    shown = [sigma_ms(np.cumsum(5e6 + rng.exponential(50e6, 40)).astype(np.int64)) for _ in range(200)]
    assert np.mean(np.array(shown) == 0.0) > 0.8


@pytest.mark.parametrize("share_missing", [0.0, 0.3])
@pytest.mark.parametrize("true_ms", [0.5, 3.0, 6.0])
def test_jitter_is_estimated(true_ms: float, share_missing: float) -> None:
    rng, shown = np.random.default_rng(3), []
    for _ in range(50):
        stamps = np.arange(60) * PERIOD_NS + (1e6 * true_ms * rng.standard_normal(60)).astype(np.int64)
        shown.append(sigma_ms(stamps[rng.random(60) >= share_missing]))
    assert np.median(shown) == pytest.approx(true_ms, rel=0.15)
    assert np.quantile(shown, 0.05) > 0.6 * true_ms


def test_covariance_of_an_interval_covers_what_its_stamps_err_by() -> None:
    """A rig that turns at 1 rad/s and moves at 2 m/s, integrated over intervals whose ends err by 3 ms."""
    imu, rate, velocity, force = Imu(), np.array([0.0, 0.0, 1.0]), np.array([2.0, 0.0, 0.0]), np.array([0.0, 0.0, G])
    state = RigState(np.eye(4), velocity, np.zeros(3), np.zeros(3))

    def integrated(duration_s: float, sigma_s: float) -> gtsam.PreintegratedCombinedMeasurements:
        steps = np.full(10, duration_s / 10)
        interval = ImuInterval(steps, np.tile(rate, (10, 1)), np.tile(force, (10, 1)), stamp_sigma_s=sigma_s)
        assert is_as_stated(interval, imu, 3.0) == (sigma_s == 0.0)
        return preintegrate(interval, interval_params(interval, imu, 3.0, state), gtsam.imuBias.ConstantBias())

    ends = 0.003 * np.random.default_rng(4).standard_normal((500, 2))
    turns, moves = [], []
    for first, last in ends:
        predicted = integrated(0.05 + last - first, 0.0).predict(
            gtsam.NavState(gtsam.Pose3(np.eye(4)), velocity), gtsam.imuBias.ConstantBias()
        )
        turns.append(so3_log(predicted.pose().matrix()[:3, :3].copy())[2])
        moves.append(predicted.position()[0])
    covariance = integrated(0.05, 0.003).preintMeasCov()
    assert np.sqrt(covariance[2, 2]) == pytest.approx(np.std(turns), rel=0.1)
    assert np.sqrt(covariance[3, 3]) == pytest.approx(np.std(moves), rel=0.1)
    as_stated = integrated(0.05, 0.0).preintMeasCov()
    usual = preintegrate(
        ImuInterval(np.full(10, 0.005), np.tile(rate, (10, 1)), np.tile(force, (10, 1))),
        preintegration_params(imu, 3.0),
        gtsam.imuBias.ConstantBias(),
    )
    np.testing.assert_array_equal(as_stated, usual.preintMeasCov())


@pytest.mark.skipif(not CLIP.exists(), reason="the real recording is not here")
def test_images_that_are_stamped_when_they_arrive() -> None:
    """By intervals that are wrong by 4 ms, the IMU contradicted good images: it was left out, its scale corrected."""
    source, rng = open_source(half_size_clip()), np.random.default_rng(5)
    measurements = [
        replace(each, stamp_ns=each.stamp_ns + int(rng.normal(0.0, 3e6))) if isinstance(each, FrameSet) else each
        for each in open_source(half_size_clip(), to_s=12.0)
    ]
    odometry = Odometry(source.rig)
    estimates = [odometry.process(each) for each in sorted(measurements, key=lambda each: each.stamp_ns)]
    poses = [
        (each.stamp_ns, each.nav_T_body)
        for each in (*estimates, *odometry.finish())
        if each is not None and each.nav_T_body is not None
    ]
    events = [event.kind for event in odometry.take_events()]
    assert not set(events) & {EventKind.IMU_LEFT_OUT, EventKind.LOST, EventKind.CALIBRATION_CORRECTED}
    assert events.count(EventKind.VISION_GATED) < 5  # while the period is not yet known
    assert source.truth is not None
    estimated = Trajectory(np.array([stamp_ns for stamp_ns, _ in poses]), np.array([pose for _, pose in poses]))
    assert evaluate(estimated, load_trajectory(source.truth)).ate_position_m.rmse < 0.012
