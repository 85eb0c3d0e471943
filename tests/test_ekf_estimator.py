"""The paper's filter in the odometry's place: what it uses, refuses, forgets and reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import filled_buffer, measured_motion, pose_at, transform, two_pair_rig

from graphvio import Config, ConfigError, FrameSet, Odometry, Status, open_source
from graphvio.arrays import Float
from graphvio.backend.ekf.estimator import FilterEstimator
from graphvio.config.stages import FilterConfig
from graphvio.geometry import se3_inverse
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.rig import Imu
from graphvio.trajectory_files import load_trajectory

IMU = Imu()
PERIOD_NS = 50_000_000
GYRO_BIAS = np.array([0.02, -0.01, 0.015])
PAPER = "fusion: {estimator: filter}\nmotion: {reference: previous, selection: best_pair}\n"


@dataclass
class Walk:
    """A filter that is fed the synthetic walk frame by frame."""

    config: FilterConfig = field(default_factory=FilterConfig)
    with_imu: bool = True
    seed: int = 0
    kinds: list[str] = field(default_factory=list)
    statuses: list[Status] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        rig = two_pair_rig(IMU if self.with_imu else None)
        config = replace(Config.from_yaml(PAPER), filter=self.config)
        self.estimator = FilterEstimator(rig, config, lambda _, kind, detail: self.kinds.append(kind))
        self.imu = filled_buffer(IMU, 20.0, self.rng, GYRO_BIAS, np.zeros(3))
        interval = self.imu.segment(0, 1_000_000_000) if self.with_imu else None
        self.now_ns = 1_000_000_000
        self.estimator.initialise(self.now_ns, None if interval is None else (interval[0], 1.0))
        self.estimator.update(self.now_ns, True, frozenset())

    def interval(self, start_ns: int, end_ns: int) -> ImuInterval | None:
        return self.imu.interval(start_ns, end_ns) if self.with_imu else None

    def step(self, blind: bool = False, off: Float | None = None) -> bool:
        """One frameset; whether vision was used."""
        before, self.now_ns = self.now_ns, self.now_ns + PERIOD_NS
        self.estimator.predict(self.now_ns, self.interval(before, self.now_ns))
        motion: RelativeMotion | None = None
        if not blind:
            motion = measured_motion(before, self.now_ns, self.rng)
            if off is not None:
                motion = replace(motion, reference_T_current=motion.reference_T_current @ off)
        used = (
            self.estimator.apply(VisualResult(motion, Quality.GOOD if motion else Quality.FAILED, "", {}), False).motion
            is not None
        )
        self.statuses.append(self.estimator.update(self.now_ns, used, frozenset()).status)
        return used

    def steps(self, seconds: float, blind: bool = False, off: Float | None = None) -> list[bool]:
        return [self.step(blind, off) for _ in range(round(seconds * 1e9 / PERIOD_NS))]

    def sigma_m(self) -> float:
        return float(np.sqrt(np.linalg.eigvalsh(self.estimator.covariance.pose[3:, 3:])[-1]))


def moved(poses: Sequence[tuple[int, Float]]) -> tuple[Float, Float]:
    """The motion (4, 4) from the first to the last pose, and what it truly was."""
    (first_ns, first), (last_ns, last) = poses[0], poses[-1]
    return se3_inverse(first) @ last, np.linalg.inv(pose_at(first_ns * 1e-9)) @ pose_at(last_ns * 1e-9)


@pytest.mark.parametrize("with_imu", [True, False])
@pytest.mark.parametrize("bias", ["estimated", "none"])
def test_it_follows_a_walk(with_imu: bool, bias: str) -> None:
    walk = Walk(FilterConfig(bias=bias), with_imu)  # type: ignore[arg-type]
    walk.steps(1.0)
    walk.estimator.take_final()
    assert all(walk.steps(5.0))
    assert set(walk.statuses[20:]) == {Status.TRACKING}
    found, truth = moved(walk.estimator.take_final())
    assert np.linalg.norm(found[:3, 3] - truth[:3, 3]) < 0.15  # 100 motions of 3 mm and 1 mrad
    if with_imu and bias == "estimated":
        np.testing.assert_allclose(walk.estimator.state().gyro_bias, GYRO_BIAS, atol=4e-3)
    else:
        assert bias == "estimated" or not walk.estimator.state().gyro_bias.any()


def test_the_first_approach_uses_the_gyro_only_where_it_differs_from_vision() -> None:
    """A threshold above the bias leaves the gyro out while vision is good; one below it lets the bias in."""
    errors = []
    for threshold in (0.2, 1e-6):
        walk = Walk(FilterConfig(bias="none", gyro_threshold_rad_s=threshold, gyro_sigma_rad_s=0.005))
        walk.steps(1.0)
        walk.estimator.take_final()
        walk.steps(8.0)
        found, truth = moved(walk.estimator.take_final())
        errors.append(np.arccos(np.clip(0.5 * (np.trace(found[:3, :3].T @ truth[:3, :3]) - 1.0), -1.0, 1.0)))
    assert errors[0] < 0.5 * errors[1]


def test_an_impossible_acceleration_is_refused() -> None:
    walk = Walk(FilterConfig(gate_probability=0.9999999999, accel_sigma_m_s2=20.0))
    walk.steps(2.0)
    assert not walk.step(off=transform(np.zeros(3), [0.2, 0.0, 0.0]))  # 4 m/s within 50 ms
    assert walk.kinds.count("vision_gated") == 1
    assert walk.step()


def test_a_wrong_motion_is_gated_and_what_follows_is_not() -> None:
    walk = Walk()
    walk.steps(2.0)
    assert not walk.step(off=transform([0.0, 0.3, 0.0], np.zeros(3)))
    assert walk.kinds == ["vision_gated"]
    assert walk.statuses[-1] is Status.COASTING
    assert all(walk.steps(1.0))


def test_blind_the_gyro_holds_the_attitude_and_the_position_is_lost_in_the_end() -> None:
    walk = Walk()
    walk.steps(2.0)
    before = walk.sigma_m()
    walk.steps(0.5, blind=True)
    assert set(walk.statuses[-10:]) == {Status.COASTING}
    assert np.sqrt(walk.sigma_m() ** 2 - before**2) > 0.2  # of the blind half second alone
    pose = walk.estimator.state().nav_T_body
    found, truth = moved([(3_000_000_000, walk.estimator.take_final()[40][1]), (walk.now_ns, pose)])
    assert np.arccos(np.clip(0.5 * (np.trace(found[:3, :3].T @ truth[:3, :3]) - 1.0), -1.0, 1.0)) < 0.03
    walk.steps(4.0, blind=True)
    assert walk.statuses[-1:] == [Status.LOST]
    assert walk.kinds.count("lost") == 1
    walk.steps(0.5)
    assert walk.statuses[-1:] == [Status.TRACKING]
    assert (walk.kinds[-1], walk.estimator.epoch) == ("new_epoch", 1)


def test_a_gate_that_shuts_for_long_opens_again() -> None:
    """The rig moves otherwise than foreseen: a jump of its velocity that lasts."""
    walk = Walk(FilterConfig(accel_sigma_m_s2=1.5, max_gated_s=0.5))
    walk.steps(2.0)
    walk.steps(1.5, off=transform(np.zeros(3), [0.3, 0.0, 0.0]))
    assert walk.kinds.count("gate_reset") == 1
    assert walk.statuses[-1:] == [Status.TRACKING]


def test_position_reset_does_not_change_estimates() -> None:
    never, often = (Walk(FilterConfig(reset_s=reset_s)) for reset_s in (100.0, 0.5))
    for walk in (never, often):
        walk.steps(6.0)
    assert never.estimator._reset_covariance.max() == 0.0 < often.estimator._reset_covariance.max()
    np.testing.assert_allclose(often.estimator.state().nav_T_body, never.estimator.state().nav_T_body, atol=1e-6)
    np.testing.assert_allclose(often.estimator.covariance.pose, never.estimator.covariance.pose, rtol=0.05, atol=1e-6)


def test_a_long_gap_opens_an_epoch() -> None:
    walk = Walk(with_imu=False)
    walk.steps(1.0)
    walk.now_ns += 5_000_000_000
    before = walk.sigma_m()
    walk.step()
    assert (walk.kinds[-1], walk.estimator.epoch) == ("time_jump", 1)
    assert walk.sigma_m() > before + 0.9


def test_a_refused_translation_does_not_leave_the_gyro_out() -> None:
    """The first approach leaves it out where vision agrees with it, but vision must have been used."""
    rates = []
    for off in (np.zeros(3), np.array([1.0, 0.0, 0.0])):
        walk = Walk(FilterConfig(bias="none", gyro_threshold_rad_s=10.0))
        walk.steps(1.0)
        before = walk.estimator._running.covariance[9:12, 9:12].trace()
        walk.step(off=transform(np.zeros(3), off))
        rates.append(walk.estimator._running.covariance[9:12, 9:12].trace() / before)
    assert rates[1] < 2.0  # the gyro measured the rate in vision's place


def test_a_second_start_forgets_what_the_first_one_left() -> None:
    walk = Walk(FilterConfig(reset_s=0.5))
    walk.steps(5.0)
    assert walk.estimator._reset_covariance.any()
    walk.estimator.initialise(walk.now_ns, None)
    walk.estimator.update(walk.now_ns, True, frozenset())
    assert not walk.estimator._reset_covariance.any()
    assert walk.estimator.latest_rate() is None


def test_it_needs_motions_over_one_step() -> None:
    with pytest.raises(ConfigError, match="reference: previous"):
        Config.from_yaml("fusion: {estimator: filter}")


@pytest.mark.parametrize("bias", ["estimated", "none"])
def test_the_odometry_runs_with_it(room_walk: Path, bias: str) -> None:
    source = open_source(room_walk)
    odometry = Odometry(source.rig, Config.from_yaml(f"{PAPER}filter: {{bias: {bias}}}\n"))
    measurements = list(source)
    estimates = [
        e for measurement in measurements if (e := odometry.process(measurement)) is not None
    ] + odometry.finish()
    assert len(estimates) == sum(isinstance(measurement, FrameSet) for measurement in measurements)
    assert all(e.nav_T_body is not None for e in estimates)
    assert all(e.covariance is not None and np.linalg.eigvalsh(e.covariance)[0] > 0 for e in estimates)
    smoothed = odometry.take_smoothed()
    assert [stamp for stamp, _ in smoothed] == [e.stamp_ns for e in estimates]
    truth = load_trajectory(room_walk / "mav0/state_groundtruth_estimate0/data.csv")
    stamps = np.array([estimates[0].stamp_ns, estimates[-1].stamp_ns])
    true, _ = truth.at(stamps, 0.1)
    walked = np.linalg.norm(true.positions[1] - true.positions[0])
    end = estimates[-1].nav_T_body
    assert end is not None
    assert np.linalg.norm(end[:3, 3]) == pytest.approx(walked, abs=0.05)
