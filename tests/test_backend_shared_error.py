"""Motions from one keyframe share the error of its points: Monte Carlo of what the smoother makes of that."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache

import gtsam
import numpy as np
import pytest
from monte_carlo import band
from synthetic import filled_buffer, pose_at, random_covariance, transform, velocity_at

from graphvio.arrays import Float
from graphvio.backend.factors import x
from graphvio.backend.noise import gaussian
from graphvio.backend.smoother import Smoother
from graphvio.backend.states import InitialUncertainty, RigState, origin_covariance
from graphvio.config.stages import SmootherConfig
from graphvio.geometry import se3_adjoint, se3_inverse, se3_log
from graphvio.measurements.motion import RelativeMotion
from graphvio.rig import Imu

IMU = Imu(accel_random_walk=1e-5, gyro_random_walk=1e-7)  # biases are sampled once
PERIOD_NS = 200_000_000  # a keyframe then lasts long enough that errors look different from its two ends
KEYFRAMES = 5  # framesets from one to the next
FIRST, FRAMES = 2, 20  # the pose is composed from the first of these over so many: between two that are no keyframes
SEEDS = 60
SCALE = np.diag(np.repeat([2e-3, 4e-3], 3))
SHARED, OWN = (
    SCALE @ random_covariance(np.random.default_rng(number), 6, sigma) @ SCALE for number, sigma in ((1, 1.0), (2, 0.4))
)
# Vision alone: what is foreseen counts for nothing.
CONFIG = SmootherConfig(
    lag_s=10.0, imu_noise_scale=1.0, motion_accel_sigma_m_s2=1e3, motion_angular_accel_sigma_rad_s2=1e3
)


def sampled(covariance: Float, rng: np.random.Generator) -> Float:
    return np.asarray(np.linalg.cholesky(covariance) @ rng.standard_normal(6))


def motion_from(start_ns: int, end_ns: int, shared_error: Float, rng: np.random.Generator) -> RelativeMotion:
    """What vision says of the walk: the error of the reference is in body there, the motion's own in body now."""
    truth = np.linalg.inv(pose_at(start_ns * 1e-9)) @ pose_at(end_ns * 1e-9)
    own = sampled(OWN, rng)
    measured = transform(shared_error[:3], shared_error[3:]) @ truth @ transform(own[:3], own[3:])
    adjoint = se3_adjoint(se3_inverse(truth))
    shared = adjoint @ SHARED @ adjoint.T
    return RelativeMotion(start_ns, end_ns, measured, shared + OWN, shared, 100)


@dataclass
class Run:
    """A smoother that is fed the synthetic walk by keyframes.

    Attributes:
        split: whether the smoother knows which part of the covariance is shared.
        statistics: the gate's, of motions that are not the first from their reference.
    """

    seed: int
    with_imu: bool = False
    split: bool = True
    config: SmootherConfig = CONFIG
    statistics: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        self.smoother = Smoother(self.config, IMU if self.with_imu else None)
        tilt = np.array([*(3e-3 * rng.standard_normal(2)), 0.0])
        pose = transform(tilt, np.zeros(3)) @ pose_at(0.0)
        gyro_bias, accel_bias = 1e-3 * rng.standard_normal(3), 0.2 * rng.standard_normal(3)
        velocity = velocity_at(0.0) + 0.1 * rng.standard_normal(3)
        start = InitialUncertainty(origin_covariance(pose[:3, :3], 3e-3), 0.1, 1e-3)
        self.smoother.initialise(0, RigState(pose, velocity, np.zeros(3), np.zeros(3)), start)
        last = FIRST + FRAMES
        if self.with_imu:
            buffer = filled_buffer(IMU, last * PERIOD_NS * 1e-9, rng, gyro_bias, accel_bias)
        for k in range(1, last + 1):
            reference = (k - 1) // KEYFRAMES * KEYFRAMES
            if k == reference + 1:
                shared_error = sampled(SHARED, rng)
            motion = motion_from(reference * PERIOD_NS, k * PERIOD_NS, shared_error, rng)
            if not self.split:
                motion = replace(motion, shared_covariance=np.zeros((6, 6)))
            interval = buffer.interval((k - 1) * PERIOD_NS, k * PERIOD_NS) if self.with_imu else None
            self.smoother.extend(k * PERIOD_NS, interval)
            if k > reference + 1:
                self.statistics.append(self.smoother.gate(motion).statistic)
            self.smoother.add_motion(motion)
            self.smoother.update({k // KEYFRAMES * KEYFRAMES * PERIOD_NS, FIRST * PERIOD_NS})

    def nees(self) -> float:
        """Of the pose composed over twenty framesets."""
        first, last = FIRST * PERIOD_NS, (FIRST + FRAMES) * PERIOD_NS
        moved = se3_inverse(self.smoother.pose(first)) @ self.smoother.pose(last)
        error = se3_log(se3_inverse(moved) @ np.linalg.inv(pose_at(first * 1e-9)) @ pose_at(last * 1e-9))
        return float(error @ np.linalg.solve(self.smoother.covariance_since(first), error))


@cache
def runs(with_imu: bool, split: bool) -> list[Run]:
    return [Run(seed, with_imu, split) for seed in range(SEEDS)]


def test_covariances_of_two_motions_from_one_keyframe() -> None:
    """From the keyframe there is all of a motion's covariance; between their ends the shared part is gone."""
    rng = np.random.default_rng(0)
    stamps = (0, 1_000_000_000, 2_500_000_000)
    smoother = Smoother(CONFIG, None)
    start = InitialUncertainty(1e-12 * np.eye(6), 10.0, 1.0)
    smoother.initialise(0, RigState(pose_at(0.0), velocity_at(0.0), np.zeros(3), np.zeros(3)), start)
    for stamp_ns in stamps[1:]:
        truth = np.linalg.inv(pose_at(0.0)) @ pose_at(stamp_ns * 1e-9)  # covariances need no errors
        motion = replace(motion_from(0, stamp_ns, np.zeros(6), rng), reference_T_current=truth)
        smoother.extend(stamp_ns, None)
        smoother.add_motion(motion)
        smoother.update({0})
        sigmas = np.sqrt(np.diag(motion.covariance))
        scale = np.outer(sigmas, sigmas)
        np.testing.assert_allclose(smoother.covariance_since(0) / scale, motion.covariance / scale, atol=0.01)
    last_T_first = se3_inverse(smoother.pose(stamps[2])) @ smoother.pose(stamps[1])
    adjoint = se3_adjoint(np.ascontiguousarray(last_T_first))
    between = adjoint @ OWN @ adjoint.T + OWN
    sigmas = np.sqrt(np.diag(between))
    scale = np.outer(sigmas, sigmas)
    np.testing.assert_allclose(smoother.covariance_since(stamps[1]) / scale, between / scale, atol=0.01)


@pytest.mark.parametrize("with_imu", [False, True], ids=["vision", "imu"])
def test_a_pose_composed_over_twenty_frames_is_within_its_covariance(with_imu: bool) -> None:
    low, high = band(SEEDS)
    assert low < np.mean([run.nees() for run in runs(with_imu, True)]) < high


def test_shared_error_taken_for_independent_is_inconsistent() -> None:
    """Vision alone does not know that it cancels between two motions; an IMU seems to average it away."""
    low, high = band(SEEDS)
    assert np.mean([run.nees() for run in runs(False, False)]) < low - 0.3
    assert np.mean([run.nees() for run in runs(True, False)]) > high + 2.0


def test_the_gate_knows_what_a_motion_shares_with_those_before() -> None:
    statistics = np.array([run.statistics for run in runs(True, True)])
    low, high = band(statistics.size)
    assert low < statistics.mean() < high


@pytest.mark.parametrize("with_imu", [False, True], ids=["vision", "imu"])
def test_keyframes_that_leave_the_window_take_nothing_along(with_imu: bool) -> None:
    long, short = (Run(3, with_imu, config=replace(CONFIG, lag_s=lag_s)) for lag_s in (10.0, 0.5))
    assert len(long.smoother.all_poses()) == FIRST + FRAMES + 1
    assert len(short.smoother.all_poses()) < 5
    newest, covariance = long.smoother.latest_ns, long.smoother.covariance()
    sigmas = np.sqrt(np.diag(covariance))
    scale = np.outer(sigmas, sigmas)
    np.testing.assert_allclose(short.smoother.covariance() / scale, covariance / scale, atol=0.01)
    apart = se3_log(se3_inverse(long.smoother.pose(newest)) @ short.smoother.pose(newest))
    assert np.abs(apart / sigmas).max() < 0.1  # what is linearised too early


def test_what_is_kept_goes_along_where_only_the_newest_states_are_corrected() -> None:
    """The keyframe's pose, and not only its view."""
    rng, shared_error = np.random.default_rng(5), np.zeros(6)
    smoother = Smoother(CONFIG, None)
    anywhere = InitialUncertainty(np.eye(6), 10.0, 1.0)
    smoother.initialise(0, RigState(pose_at(0.0), velocity_at(0.0), np.zeros(3), np.zeros(3)), anywhere)
    for k in range(1, 5):
        smoother.extend(k * PERIOD_NS, None)
        smoother.add_motion(motion_from(0, k * PERIOD_NS, shared_error, rng))
        smoother.update({0})
    before, newest = smoother.pose(0), smoother.pose(4 * PERIOD_NS)
    found = gtsam.Pose3(transform(np.zeros(3), np.array([4e-3, -5e-3, 3e-3])) @ newest)
    smoother._window.add(gtsam.PriorFactorPose3(x(4), found, gaussian(1e-10 * np.eye(6))))
    smoother.update({0})
    assert smoother._advanced
    assert np.linalg.norm(smoother.pose(0)[:3, 3] - before[:3, 3]) > 5e-3
    motion, covariance = (se3_inverse(smoother.pose(0)) @ smoother.pose(4 * PERIOD_NS)), smoother.covariance_since(0)
    smoother._window.optimize()
    whole = se3_inverse(smoother.pose(0)) @ smoother.pose(4 * PERIOD_NS)
    assert np.abs(se3_log(se3_inverse(whole) @ motion) / np.sqrt(np.diag(covariance))).max() < 0.01
