from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import pytest
from synthetic import UP, filled_buffer, measured_motion, pose_at, stamps_ns, transform, velocity_at

from graphvio.arrays import Float
from graphvio.backend.factors import b, g, v, x
from graphvio.backend.inertial import ImuBuffer
from graphvio.backend.smoother import Smoother
from graphvio.backend.states import InitialUncertainty, RigState, origin_covariance
from graphvio.config.stages import SmootherConfig
from graphvio.geometry import se3_inverse, se3_log
from graphvio.measurements.motion import RelativeMotion
from graphvio.measurements.sensors import ImuSample
from graphvio.rig import Imu

IMU = Imu()
CONFIG = SmootherConfig(lag_s=1.0, imu_noise_scale=1.0)
TILT_SIGMA, SPEED_SIGMA, GYRO_BIAS_SIGMA = 0.01, 0.1, 0.003
PERIOD_NS = 50_000_000


def known_to(nav_T_body: Float, speed_sigma: float = SPEED_SIGMA) -> InitialUncertainty:
    return InitialUncertainty(origin_covariance(nav_T_body[:3, :3], TILT_SIGMA), speed_sigma, GYRO_BIAS_SIGMA)


@dataclass
class Run:
    """A smoother that is fed the synthetic walk, and what it was initialised with."""

    seed: int
    with_imu: bool = True
    config: SmootherConfig = CONFIG
    duration_s: float = 6.0
    final: list[tuple[int, Float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = rng = np.random.default_rng(self.seed)
        self.gyro_bias, self.accel_bias = 0.003 * rng.standard_normal(3), 0.05 * rng.standard_normal(3)
        self.smoother = Smoother(self.config, IMU if self.with_imu else None)
        tilt = np.array([*(TILT_SIGMA * rng.standard_normal(2)), 0.0])
        pose = pose_at(0.0)
        pose[:3, :3] = transform(tilt, np.zeros(3))[:3, :3] @ pose[:3, :3]
        velocity = velocity_at(0.0) + SPEED_SIGMA * rng.standard_normal(3)
        self.smoother.initialise(0, RigState(pose, velocity, np.zeros(3), np.zeros(3)), known_to(pose))
        self.imu: ImuBuffer | None = None
        if self.with_imu:
            self.imu = filled_buffer(IMU, self.duration_s, rng, self.gyro_bias, self.accel_bias)
        else:
            self.step(PERIOD_NS, gated=False)  # nothing foresees the first motion

    def predict(self, stamp_ns: int, with_imu: bool = True) -> RigState:
        interval = self.imu.interval(self.smoother.latest_ns, stamp_ns) if self.imu and with_imu else None
        return self.smoother.extend(stamp_ns, interval)

    def step(
        self, stamp_ns: int, reference_ns: int | None = None, keep: frozenset[int] = frozenset(), gated: bool = True
    ) -> bool:
        """One frameset, with vision's motion since a reference or since the state before."""
        since = self.smoother.latest_ns if reference_ns is None else reference_ns
        self.predict(stamp_ns)
        motion = measured_motion(since, stamp_ns, self.rng)
        accepted = not gated or self.smoother.gate(motion).accepted
        if accepted:
            self.smoother.add_motion(motion)
        self.final += self.smoother.update(keep)
        return accepted

    def until(self, end_s: float) -> bool:
        accepted = [self.step(stamp) for stamp in stamps_ns(end_s) if stamp > self.smoother.latest_ns]
        return all(accepted)

    def coast(self, duration_s: float, keep: frozenset[int] = frozenset()) -> list[float]:
        """Position's standard deviations while vision is blind."""
        sigmas = []
        end_ns = self.smoother.latest_ns + round(duration_s * 1e9)
        while self.smoother.latest_ns < end_ns:
            self.predict(self.smoother.latest_ns + PERIOD_NS)
            self.final += self.smoother.update(keep)
            sigmas.append(self.sigma())
        return sigmas

    def sigma(self) -> float:
        return float(np.sqrt(np.linalg.eigvalsh(self.smoother.covariance()[3:, 3:])[-1]))

    def error(self) -> Float:
        """Of the newest pose, tangent in body."""
        truth = pose_at(self.smoother.latest_ns * 1e-9)
        return se3_log(se3_inverse(self.smoother.pose(self.smoother.latest_ns)) @ truth)

    def nees(self) -> float:
        error = self.error()
        return float(error @ np.linalg.solve(self.smoother.covariance(), error))


def test_a_walk_with_imu() -> None:
    nees, errors, tilts, biases = [], [], [], []
    for seed in range(8):
        run = Run(seed)
        for end_s in (1.5, 3.0, 4.5, 6.0):
            assert run.until(end_s)
            nees.append(run.nees())
        errors.append(np.linalg.norm(run.error()[3:]))
        estimated = run.smoother.state().nav_T_body[2, :3]
        tilts.append(np.arccos(np.clip(estimated @ pose_at(6.0)[2, :3], -1.0, 1.0)))
        state = run.smoother.state()
        assert np.abs(state.velocity_nav - velocity_at(6.0)).max() < 0.1
        biases.append(state.gyro_bias - run.gyro_bias)
    assert np.mean(errors) < 0.1  # 5 m walked, a noise of 3 mm and 1 mrad in each of 120 motions
    assert np.mean(tilts) < 0.01
    assert np.std(biases) < 0.6 * GYRO_BIAS_SIGMA
    assert 3.0 < np.mean(nees) < 9.0


def test_a_walk_without_imu() -> None:
    nees, errors = [], []
    for seed in range(8):
        run = Run(seed, with_imu=False)
        assert not run.smoother.has_imu
        assert run.until(4.0)
        nees.append(run.nees())
        errors.append(np.linalg.norm(run.error()[3:]))
        state = run.smoother.state()
        assert np.abs(state.velocity_nav - velocity_at(4.0)).max() < 0.4  # seen over one interval
        np.testing.assert_array_equal(state.gyro_bias, np.zeros(3))
    assert np.mean(errors) < 0.12
    assert 2.5 < np.mean(nees) < 10.0


def test_a_start_in_motion_without_imu_is_no_outlier() -> None:
    smoother = Smoother(CONFIG, None)
    standing = RigState(pose_at(0.0), np.zeros(3), np.zeros(3), np.zeros(3))
    smoother.initialise(0, standing, known_to(standing.nav_T_body, 2.0))
    smoother.extend(PERIOD_NS, None)
    assert smoother.gate(measured_motion(0, PERIOD_NS, np.random.default_rng(0))).accepted


def test_final_poses_come_once_and_in_order() -> None:
    run = Run(0)
    run.until(3.0)
    stamps = [stamp for stamp, _ in run.final]
    held = [stamp for stamp, _ in run.smoother.all_poses()]
    assert stamps + held == list(stamps_ns(3.0))
    assert held[0] == 2_000_000_000
    for stamp, pose in run.final:
        assert np.linalg.norm(pose[:3, 3] - pose_at(stamp * 1e-9)[:3, 3]) < 0.1


def test_poses_of_the_window_are_those_of_the_whole_solution() -> None:
    run = Run(3)
    run.until(3.0)
    while run.smoother._advanced < 2:
        run.step(run.smoother.latest_ns + PERIOD_NS)
    left = [run.smoother.pose(stamp) for stamp in run.smoother._stamps]
    returned = [pose for _, pose in run.smoother.all_poses()]
    assert run.smoother._advanced == 0
    run.smoother.optimize()
    whole = [pose for _, pose in run.smoother.all_poses()]
    off_m, off_before_m = (np.abs(np.array(poses) - whole)[:, :3, 3].max() for poses in (returned, left))
    assert off_m < 5e-5
    assert off_before_m > 5e-4


def test_a_blackout_is_coasted_through_and_forgotten() -> None:
    run = Run(1)
    run.until(3.0)
    before = run.sigma()
    reference = run.smoother.latest_ns
    keep = frozenset([reference])
    sigmas = run.coast(1.5, keep)  # longer than the lag
    assert all(b > a for a, b in pairwise([before, *sigmas]))
    assert before < sigmas[-1] < 0.4
    assert np.linalg.norm(run.error()[3:]) < 4.0 * sigmas[-1]
    assert run.nees() < 30.0
    assert run.smoother.knows(reference)
    accepted = run.step(reference + 31 * PERIOD_NS, reference, keep)
    assert accepted
    assert run.sigma() < before + 0.01
    assert run.nees() < 30.0
    assert run.until(5.5)
    assert not run.smoother.knows(reference)  # no longer kept, it is too old
    assert run.nees() < 30.0


def test_a_blackout_without_imu_is_far_less_certain() -> None:
    sighted, blind = Run(2), Run(2, with_imu=False)
    for run in (sighted, blind):
        run.until(2.0)
    with_imu, without = sighted.coast(1.0), blind.coast(1.0)
    assert all(b > a for a, b in pairwise(without))
    assert without[-1] > 5.0 * with_imu[-1]
    # An unknown, constant acceleration moves by a t^2 / 2.
    assert without[-1] == pytest.approx(0.5 * CONFIG.motion_accel_sigma_m_s2, rel=0.2)
    assert blind.nees() < 30.0


def test_an_imu_gap_is_bridged() -> None:
    run = Run(3)
    run.until(2.0)
    for stamp in (2_050_000_000, 2_100_000_000):
        run.predict(stamp, with_imu=False)
        motion = measured_motion(stamp - PERIOD_NS, stamp, run.rng)
        assert run.smoother.gate(motion).accepted
        run.smoother.add_motion(motion)
        run.smoother.update(())
    assert run.until(3.0)
    assert run.nees() < 30.0


@pytest.mark.parametrize(
    "error", [([0.0, 0.0, 0.0], [0.0, 0.15, 0.0]), ([0.05, 0.0, 0.0], [0.0, 0.0, 0.0]), ([0, 0, 0.4], [0.3, 0, 0])]
)
def test_a_motion_that_the_imu_contradicts_is_refused(error: tuple[list[float], list[float]]) -> None:
    run = Run(4)
    run.until(2.0)
    run.predict(2_050_000_000)
    good = measured_motion(2_000_000_000, 2_050_000_000, run.rng)
    wrong = replace(good, reference_T_current=good.reference_T_current @ transform(*error))
    assert run.smoother.gate(good).accepted
    assert not run.smoother.gate(wrong).accepted
    untouched = run.smoother.pose(2_050_000_000)
    run.smoother.gate(wrong)
    assert np.array_equal(run.smoother.pose(2_050_000_000), untouched)


def test_a_wrong_motion_that_passes_the_gate_pulls_less() -> None:
    """After a second in the dark, a motion that is 2 cm off is believed; those after it show that it was wrong."""

    def pose_after(probability: float, off_m: float) -> Float:
        run = Run(4, config=replace(CONFIG, huber_probability=probability))
        run.until(2.0)
        reference_ns = run.smoother.latest_ns
        keep = frozenset([reference_ns])
        run.coast(1.0, keep)
        for k in range(1, 5):
            stamp_ns = reference_ns + 1_000_000_000 + k * PERIOD_NS
            run.predict(stamp_ns)
            motion = measured_motion(reference_ns, stamp_ns, run.rng)
            if k == 1:
                off = transform(np.zeros(3), [0.0, off_m, 0.0])
                motion = replace(motion, reference_T_current=motion.reference_T_current @ off)
                assert run.smoother.gate(motion).accepted
            run.smoother.add_motion(motion)
            run.smoother.update(keep)
        return run.smoother.pose(run.smoother.latest_ns)

    pulled = {}
    for probability in (1.0, 0.999):
        right, wrong = (pose_after(probability, off_m) for off_m in (0.0, 0.02))
        pulled[probability] = float(np.linalg.norm(se3_log(se3_inverse(right) @ wrong)[3:]))
    assert pulled[0.999] < 0.75 * pulled[1.0]


def test_good_motions_pass_the_gate_as_often_as_they_should() -> None:
    passed = []
    for seed in range(4):
        run = Run(10 + seed, config=replace(CONFIG, gate_probability=0.9))
        run.until(1.0)
        for stamp in stamps_ns(6.0):
            if stamp > run.smoother.latest_ns:
                run.predict(stamp)
                motion = measured_motion(stamp - PERIOD_NS, stamp, run.rng)
                passed.append(run.smoother.gate(motion).accepted)
                run.smoother.add_motion(motion)
                run.smoother.update(())
    assert 0.85 < np.mean(passed) < 0.95


def test_covariance_since_a_state_forgets_what_was_before() -> None:
    run = Run(5)
    run.until(4.0)
    now = run.smoother.latest_ns
    assert np.array_equal(run.smoother.covariance_since(now), np.zeros((6, 6)))
    one, ten = (np.trace(run.smoother.covariance_since(now - n * PERIOD_NS)[3:, 3:]) for n in (1, 10))
    assert 0.0 < one < ten < np.trace(run.smoother.covariance()[3:, 3:])
    assert np.sqrt(one / 3.0) < 3.1e-3  # no worse than the measurement


def test_a_new_start_forgets_everything() -> None:
    run = Run(6)
    run.until(1.0)
    state = RigState(transform([0.0, 0.0, 1.0], [1.0, 2.0, 3.0]), np.ones(3), np.zeros(3), np.zeros(3))
    run.smoother.initialise(5_000_000_000, state, known_to(state.nav_T_body))
    assert run.smoother.latest_ns == 5_000_000_000
    assert not run.smoother.knows(1_000_000_000)
    assert run.smoother.latest_rate() is None
    np.testing.assert_allclose(run.smoother.state().nav_T_body, state.nav_T_body, atol=1e-12)
    np.testing.assert_allclose(run.smoother.state().velocity_nav, np.ones(3))
    covariance = run.smoother.covariance()
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [0.01, 0.01, 1e-3, 1e-3, 1e-3, 1e-3], rtol=1e-6)


def test_tilt_is_uncertain_about_navs_axes_and_heading_is_not() -> None:
    run = Run(7)
    leaning = transform([0.0, np.pi / 2.0, 0.0], np.zeros(3))  # body's x axis points down: heading is about it
    run.smoother.initialise(0, RigState(leaning, np.zeros(3), np.zeros(3), np.zeros(3)), known_to(leaning))
    sigmas = np.sqrt(np.diag(run.smoother.covariance()))
    np.testing.assert_allclose(sigmas[:3], [1e-3, 0.01, 0.01], rtol=1e-6)


# ------------------------------------------------------------------ velocity and biases


def test_velocity_and_biases_errors_are_consistent() -> None:
    squares: dict[str, list[float]] = {"velocity": [], "gyro_bias": [], "accel_bias": []}
    for seed in range(20):
        run = Run(100 + seed)
        run.until(4.0)
        state, known = run.smoother.state(), run.smoother.state_covariance()
        np.testing.assert_array_equal(known.pose, run.smoother.covariance())
        errors = {
            "velocity": (state.velocity_nav - velocity_at(4.0), known.velocity),
            "gyro_bias": (state.gyro_bias - run.gyro_bias, known.gyro_bias),
            "accel_bias": (state.accel_bias - run.accel_bias, known.accel_bias),
        }
        for name, (error, covariance) in errors.items():
            assert covariance is not None
            squares[name].append(float(error @ np.linalg.solve(covariance, error)))
    # Of 3, the mean of 20 known to 0.55; the biases sampled here are less than the window is prepared for.
    assert 1.5 < np.mean(squares["velocity"]) < 5.0
    assert 0.5 < np.mean(squares["gyro_bias"]) < 5.0
    assert np.mean(squares["accel_bias"]) < 5.0
    assert Run(0, with_imu=False).smoother.state_covariance().velocity is None


# ------------------------------------------------------------------ zero velocity


def stationary(seed: int, updates: bool, duration_s: float = 4.0) -> Run:
    """A rig that stands still from a start that does not know it."""
    run = Run(seed, duration_s=0.0)
    rng, pose = run.rng, np.eye(4)
    run.smoother.initialise(0, RigState(pose, np.zeros(3), np.zeros(3), np.zeros(3)), known_to(pose))
    run.imu = ImuBuffer(50.0)
    root = np.sqrt(IMU.rate_hz)
    for i in range(round(duration_s * IMU.rate_hz) + 1):
        rate = run.gyro_bias + IMU.gyro_noise_density * root * rng.standard_normal(3)
        force = UP + run.accel_bias + IMU.accel_noise_density * root * rng.standard_normal(3)
        run.imu.add(ImuSample(round(i * 1e9 / IMU.rate_hz), rate, force))
    for stamp in stamps_ns(duration_s):
        if stamp == 0:
            continue
        run.predict(stamp)
        noise = np.repeat([1e-3, 3e-3], 3)
        motion = transform(*(noise * rng.standard_normal(6)).reshape(2, 3))
        still = RelativeMotion(stamp - PERIOD_NS, stamp, motion, np.diag(noise**2), np.zeros((6, 6)), 100)
        if run.smoother.gate(still).accepted:
            run.smoother.add_motion(still)
        if updates:
            assert run.smoother.gate_zero_velocity().accepted
            run.smoother.add_zero_velocity()
        run.smoother.update(())
    return run


def test_standing_still_the_velocity_is_known_and_the_pose_stays() -> None:
    drifts: dict[bool, list[float]] = {False: [], True: []}
    for updates in drifts:
        for seed in range(6):
            run = stationary(seed, updates)
            drifts[updates].append(float(np.linalg.norm(run.smoother.state().nav_T_body[:3, 3])))
    run = stationary(0, True)
    known = run.smoother.state_covariance().velocity
    assert known is not None
    assert np.sqrt(np.trace(known)) < 0.005
    assert np.linalg.norm(run.smoother.state().velocity_nav) < 0.005
    assert np.mean(drifts[True]) < 0.5 * np.mean(drifts[False])


def test_zero_velocity_gate_with_a_certain_velocity_refuses() -> None:
    run = Run(8)
    run.until(2.0)
    run.predict(2_050_000_000)
    assert np.linalg.norm(velocity_at(2.05)) > 0.3
    assert not run.smoother.gate_zero_velocity().accepted


# ------------------------------------------------------------------ resets


@pytest.mark.parametrize("with_imu", [True, False], ids=["imu", "vision"])
def test_a_reset_changes_nothing_but_the_window(with_imu: bool) -> None:
    """Estimates and their covariances stay the same; the window's own position is certain again."""
    never, often = (Run(9, with_imu=with_imu) for _ in range(2))
    for end_s in (1.0, 2.0, 3.0, 4.0, 5.0):
        for run in (never, often):
            run.until(end_s)
        one, other = never.smoother.state_covariance(), often.smoother.state_covariance()
        for before, after in ((one.pose, other.pose), (one.velocity, other.velocity), (one.gyro_bias, other.gyro_bias)):
            if before is not None and after is not None:
                sigmas = np.sqrt(np.diag(before))
                scale = np.outer(sigmas, sigmas)
                np.testing.assert_allclose(after / scale, before / scale, atol=0.02)
        apart = se3_log(se3_inverse(never.smoother.state().nav_T_body) @ often.smoother.state().nav_T_body)
        assert np.abs(apart / np.sqrt(np.diag(one.pose))).max() < 0.05
        often.smoother.reset_position()
        assert own_position_sigma_m(often) == pytest.approx(1e-3, rel=1e-3)
        often.smoother.update(())
    assert own_position_sigma_m(never) > 1e-2


def own_position_sigma_m(run: Run) -> float:
    """What the window does not know of the newest position given all else of that state."""
    smoother = run.smoother
    k = smoother._index_of[smoother.latest_ns]
    keys = [x(k), v(k), b(k), g()] if smoother.has_imu else [x(k)]
    joint = smoother._window.joint_covariance(keys)
    others, position = np.delete(np.arange(len(joint)), slice(3, 6)), np.arange(3, 6)
    gain = np.linalg.solve(joint[np.ix_(others, others)], joint[np.ix_(others, position)])
    own = joint[3:6, 3:6] - joint[np.ix_(position, others)] @ gain
    return float(np.sqrt(np.linalg.eigvalsh(own)[-1]))


# ------------------------------------------------------------------ accelerations


def test_excess_acceleration_beyond_any_rig_is_returned() -> None:
    run = Run(11, with_imu=False)
    run.until(1.0)
    stamp = run.smoother.latest_ns + PERIOD_NS
    run.predict(stamp)
    good = measured_motion(stamp - PERIOD_NS, stamp, run.rng)
    assert run.smoother.excess_acceleration(good) is None
    off = transform(np.zeros(3), [0.3, 0.0, 0.0])  # 0.3 m in a step of 50 ms: 120 m/s^2
    wrong = replace(good, reference_T_current=good.reference_T_current @ off)
    excess = run.smoother.excess_acceleration(wrong)
    assert excess == pytest.approx(120.0, abs=15.0)
    unsure = replace(wrong, covariance=wrong.covariance + np.diag([0, 0, 0, 1, 1, 1]) * 0.1**2)
    assert run.smoother.excess_acceleration(unsure) is None
    run.smoother.update(())
    run.predict(stamp + PERIOD_NS)  # the step before was not seen: where it ended is a guess
    assert run.smoother.excess_acceleration(replace(wrong, stamp_ns=stamp + PERIOD_NS)) is None
