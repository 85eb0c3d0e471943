"""Velocity, biases and gravity that an adjusted window hands over to the state estimator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from walked_views import Walk

from graphvio import Config
from graphvio.arrays import Float
from graphvio.backend.initial_state import with_inertial_state
from graphvio.backend.smoother import Smoother
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.backend.states import InitialUncertainty, RigState, StateCovariance, certain_origin, level_gravity
from graphvio.geometry import se3, so3_exp
from graphvio.measurements.inertial_state import InertialState
from graphvio.measurements.sensors import ImuSample
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.self_calibration.adjustment import adjusted
from graphvio.self_calibration.collector import WindowCollector
from graphvio.self_calibration.evidence import Evidence
from graphvio.self_calibration.inertial_state import newest_inertial_state
from graphvio.self_calibration.parameters import RigCalibration
from graphvio.self_calibration.prior import file_prior
from graphvio.self_calibration.window import Keyframe
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.simulation.default_rig import default_rig
from graphvio.simulation.imu import measure

STEP_NS, BASE_NS = 50_000_000, 10_000_000_000
INERTIAL = slice(9, 12)


def normalised_error2(level: int, seed: int) -> float:
    """Return the squared Mahalanobis distance of what a window of 1.6 s hands over, per dimension."""
    error = draw(default_rig(), CalibrationErrorSizes.of_level(level), seed)
    written, walk = error.written_rig, Walk(error.true_rig, seed=seed)
    keyframes = tuple(Keyframe(*frameset) for frameset in walk.framesets(1.6))[::2]
    collector = WindowCollector(written)
    for sample in walk.samples(1.6):
        collector.add_sample(sample)
    of_file, nominal = file_prior(written), RigCalibration.of(written)
    prior = Evidence.none(len(of_file.group)).given(of_file, np.full(of_file.n_groups, {1: 0.3, 2: 1.0, 3: 3.0}[level]))
    solution = adjusted(keyframes, collector.samples_of(keyframes), nominal, prior.mean, prior, 0.15)
    found = newest_inertial_state(keyframes[-1].stamp_ns, solution)
    seconds, imu = np.array([found.stamp_ns * 1e-9]), error.true_rig.imu
    assert imu is not None
    states = walk._motion.at(seconds)
    body_R_world = states.world_T_body[0, :3, :3].T
    h = 1e-3
    after, before = (walk.pose(float(seconds[0]) + sign * h)[:3, 3] for sign in (1.0, -1.0))
    times = np.arange(0.0, 1.6, 1.0 / imu.rate_hz)
    track = measure(walk._motion, imu, times, np.round(times * 1e9).astype(np.int64), seed)
    off = np.concatenate(
        [
            found.velocity - body_R_world @ (after - before) / (2.0 * h),
            found.accel_bias - track.accel_bias[-1],
            found.gyro_bias - track.gyro_bias[-1],
            found.gravity - body_R_world @ level_gravity(),
        ]
    )
    return float(off @ np.linalg.solve(found.covariance, off)) / len(off)


@pytest.mark.parametrize("level", [1, 2, 3])
def test_newest_inertial_state_is_within_its_covariance(level: int) -> None:
    # The noise of corners and of the IMU is taken to be twice what it is: a quarter is expected.
    errors2 = [normalised_error2(level, seed) for seed in range(12)]
    assert 0.1 < np.mean(errors2) < 1.0
    assert np.max(errors2) < 3.0


def known(covariance: Float | None = None) -> InertialState:
    return InertialState(
        BASE_NS,
        np.array([1.0, -0.2, 0.1]),
        np.array([0.05, -0.03, 0.02]),
        np.array([0.004, -0.002, 0.001]),
        np.array([0.3, -0.1, -9.804]),
        1e-4 * np.eye(12) if covariance is None else covariance,
    )


def test_with_inertial_state_goes_on_by_the_measured_force() -> None:
    state, force, since_s, blind_s = known(), np.array([0.4, 0.2, 9.9]), 0.3, 0.1
    nav_R_body = so3_exp(np.array([0.0, 0.0, 1.0]))
    wrong = RigState(se3(nav_R_body, np.zeros(3)), np.array([0.5, 0.5, 0.0]), np.zeros(3), np.array([0.2, 0.3, -0.1]))
    gained = since_s * (nav_R_body @ (force - wrong.accel_bias) + wrong.gravity_nav)
    now = replace(wrong, velocity_nav=wrong.velocity_nav + gained)
    now_ns = BASE_NS + round(since_s * 1e9)
    covariance = StateCovariance(pose=1e-6 * np.eye(6))
    initial = with_inertial_state(state, wrong, now_ns, now, blind_s, covariance)
    velocity = nav_R_body @ (state.velocity + since_s * (force - state.accel_bias + state.gravity))
    assert initial.stamp_ns == now_ns
    assert initial.state.velocity_nav == pytest.approx(velocity)
    assert initial.state.gravity_nav == pytest.approx(nav_R_body @ state.gravity)
    assert initial.state.accel_bias == pytest.approx(state.accel_bias)
    assert initial.state.gyro_bias == pytest.approx(state.gyro_bias)
    assert initial.state.nav_T_body[:3, 3] == pytest.approx(blind_s * (velocity - now.velocity_nav))
    # The velocity's covariance grows by that of biases and gravity.
    assert initial.uncertainty.inertial is not None
    assert initial.uncertainty.inertial[:3, :3] == pytest.approx(1e-4 * (1.0 + 2.0 * since_s**2) * np.eye(3))


def test_smoother_that_is_initialised_with_an_inertial_covariance_has_it() -> None:
    rng = np.random.default_rng(0)
    root = 1e-2 * rng.standard_normal((12, 12))
    covariance = root @ root.T + 1e-4 * np.eye(12)
    smoother = Smoother(Config().smoother, default_rig().imu)
    state = RigState(np.eye(4), np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))
    smoother.initialise(0, state, InitialUncertainty(certain_origin(), 0.1, 0.1, inertial=covariance))
    smoother.optimize()
    found = smoother.state_covariance()
    # Gravity's length is known from elsewhere.
    along = np.concatenate([np.zeros(9), np.array([0.0, 0.0, -1.0])])
    gain = covariance @ along / (along @ covariance @ along + 0.02**2)
    expected = covariance - np.outer(gain, along @ covariance)
    for part, at in ((found.velocity, slice(0, 3)), (found.accel_bias, slice(3, 6)), (found.gyro_bias, slice(6, 9))):
        assert part == pytest.approx(expected[at, at], rel=1e-3, abs=1e-7)
    assert found.gravity == pytest.approx(expected[INERTIAL, INERTIAL], rel=1e-3, abs=1e-7)


def standing() -> SmootherEstimator:
    """Return an estimator that has stood still for half a second; a bias and a tilt look the same to it."""
    config, rig = Config(), default_rig()
    synchroniser = Synchroniser(rig, config, lambda *_: None)
    for stamp_ns in range(BASE_NS - 1_000_000_000, BASE_NS + 2_000_000_000, 5_000_000):
        synchroniser.add_sample(ImuSample(stamp_ns, np.zeros(3), np.array([0.3, 0.0, 9.8])))
    estimator = SmootherEstimator(rig, config, lambda *_: None)
    estimator.initialise(BASE_NS - 10 * STEP_NS, synchroniser.initial_interval(BASE_NS - 10 * STEP_NS))
    estimator.update(BASE_NS - 10 * STEP_NS, True, frozenset())
    for n in range(-9, 3):
        stamp_ns = BASE_NS + n * STEP_NS
        estimator.predict(stamp_ns, synchroniser.interval(stamp_ns - STEP_NS, stamp_ns))
        estimator.update(stamp_ns, True, frozenset([BASE_NS - 5 * STEP_NS]))
    return estimator


def test_use_inertial_state_takes_over_what_is_known_better() -> None:
    estimator, state = standing(), known(1e-6 * np.eye(12))
    before, kept_ns = estimator.state(), BASE_NS - 5 * STEP_NS
    motion, covariance = estimator.motion_since(kept_ns), estimator.covariance_since(kept_ns)
    assert motion is not None
    assert covariance is not None
    assert estimator.use_inertial_state(state)
    assert estimator.state().accel_bias == pytest.approx(state.accel_bias, abs=1e-6)
    assert estimator.state().gravity_nav == pytest.approx(before.nav_T_body[:3, :3] @ state.gravity, abs=0.01)
    assert estimator.state().nav_T_body == pytest.approx(before.nav_T_body, abs=1e-9)
    assert estimator.initialisations == 1
    assert estimator.epoch == 0
    # The next keyframe is tied to the one before.
    assert estimator.motion_since(kept_ns) == pytest.approx(motion, abs=1e-4)
    assert estimator.covariance_since(kept_ns) == pytest.approx(covariance, rel=1e-3, abs=1e-12)
    estimator.predict(BASE_NS + 3 * STEP_NS, None)
    assert estimator.motion_since(kept_ns) is None


@pytest.mark.parametrize(
    "state", [known(np.eye(12)), replace(known(1e-6 * np.eye(12)), stamp_ns=BASE_NS - 1)], ids=["uncertain", "unknown"]
)
def test_use_inertial_state_keeps_a_state_that_is_known_better_or_whose_keyframe_has_left(state: InertialState) -> None:
    estimator = standing()
    before = estimator.state()
    assert not estimator.use_inertial_state(state)
    assert estimator.state().gravity_nav == pytest.approx(before.gravity_nav)
    assert estimator.initialisations == 1


def test_use_inertial_state_waits_while_the_imu_is_left_out() -> None:
    estimator = standing()
    estimator.leave_imu_out()
    assert not estimator.use_inertial_state(known(1e-6 * np.eye(12)))
