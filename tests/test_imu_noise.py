"""The white noise that IMU samples show, and what it is used for."""

from __future__ import annotations

import numpy as np
import pytest
from real_clip import CLIP, half_size_clip

from graphvio import FrameSet, ImuSample, Odometry, open_source
from graphvio.backend.inertial import ImuBuffer
from graphvio.evaluation import evaluate
from graphvio.measurements.events import EventKind
from graphvio.measurements.imu_noise import shown_noise
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory

DENSITIES = np.array([1.4e-3, 2.0e-2])
GAP_NS = 50_000_000


def moving_samples(stamps_ns: np.ndarray, rate_hz: float, seed: int = 0) -> np.ndarray:
    """Readings (N, 6) of brisk motion by hand, 1 rad/s and 5 m/s^2 at 1 Hz, with white noise."""
    t = 1e-9 * stamps_ns[:, None]
    smooth = np.repeat([1.0, 5.0], 3) * np.sin(2.0 * np.pi * t + np.arange(6))
    sigmas = np.repeat(DENSITIES, 3) * np.sqrt(rate_hz)
    return np.asarray(smooth + sigmas * np.random.default_rng(seed).standard_normal((len(t), 6)))


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 400.0])
def test_shown_noise_is_that_of_samples_in_motion(rate_hz: float) -> None:
    stamps = np.round(np.arange(1000) * 1e9 / rate_hz).astype(np.int64)
    np.testing.assert_allclose(shown_noise(stamps, moving_samples(stamps, rate_hz), GAP_NS), DENSITIES, rtol=0.06)


def test_shown_noise_of_irregular_samples_and_across_gaps() -> None:
    rng = np.random.default_rng(3)
    steps = 5_000_000 + rng.integers(-1_500_000, 1_500_000, 1000)
    steps[::100] = 400_000_000
    stamps = np.cumsum(steps)
    np.testing.assert_allclose(shown_noise(stamps, moving_samples(stamps, 200.0), GAP_NS), DENSITIES, rtol=0.08)
    assert not shown_noise(stamps[:20], moving_samples(stamps[:20], 200.0), GAP_NS).any()  # too few to say


def test_interval_has_the_noise_of_samples_before_it() -> None:
    buffer, stamps = ImuBuffer(50.0), np.arange(0, 1_000_000_000, 5_000_000)
    values = moving_samples(stamps, 200.0)
    for stamp_ns, value in zip(stamps.tolist(), values, strict=True):
        assert buffer.add(ImuSample(stamp_ns, value[:3], value[3:])) == ""
    buffer.discard_before(650_000_000)
    interval = buffer.interval(900_000_000, 950_000_000)
    assert interval is not None
    np.testing.assert_allclose(interval.noise_densities, DENSITIES, rtol=0.25)


@pytest.mark.skipif(not CLIP.exists(), reason="the real recording is not here")
def test_imu_with_eight_times_the_stated_noise() -> None:
    """By the stated noise, good images contradict the IMU: they were refused, the rig was lost, the IMU left out."""
    source, rng = open_source(half_size_clip()), np.random.default_rng(2)
    assert source.rig.imu is not None
    sigmas = 8.0 * np.sqrt(200.0) * np.repeat(source.rig.imu.noise_densities, 3)
    odometry, estimates = Odometry(source.rig), []
    for measurement in open_source(half_size_clip(), to_s=12.0):
        if not isinstance(measurement, FrameSet):
            noise = sigmas * rng.standard_normal(6)
            rate, force = measurement.angular_velocity + noise[:3], measurement.linear_acceleration + noise[3:]
            measurement = ImuSample(measurement.stamp_ns, rate, force)
        estimates.append(odometry.process(measurement))
    poses = [
        (each.stamp_ns, each.nav_T_body)
        for each in (*estimates, *odometry.finish())
        if each is not None and each.nav_T_body is not None
    ]
    refused = {EventKind.VISION_GATED, EventKind.GATE_RESET, EventKind.IMU_LEFT_OUT, EventKind.LOST}
    assert not {event.kind for event in odometry.take_events()} & refused
    assert source.truth is not None
    estimated = Trajectory(np.array([stamp_ns for stamp_ns, _ in poses]), np.array([pose for _, pose in poses]))
    assert evaluate(estimated, load_trajectory(source.truth)).ate_position_m.rmse < 0.008
