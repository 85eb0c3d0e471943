"""Poses at the IMU's rate: against the motion's truth, the estimator's own prediction, and what must not be said."""

import threading

import numpy as np
import pytest
from synthetic import filled_buffer, imu_at, pose_at, velocity_at

from graphvio.arrays import Float, Int
from graphvio.backend.inertial import NO_SAMPLES
from graphvio.backend.propagation import Propagator
from graphvio.backend.states import RigState
from graphvio.geometry import se3_inverse, se3_log
from graphvio.rig import Imu

MS = 1_000_000
IMU = Imu(rate_hz=200.0)
GYRO_BIAS, ACCEL_BIAS = np.array([0.01, -0.02, 0.015]), np.array([0.1, -0.05, 0.08])


def state_at(time_s: float) -> RigState:
    return RigState(pose_at(time_s), velocity_at(time_s), GYRO_BIAS, ACCEL_BIAS)


def samples(start_s: float, end_s: float) -> tuple[Int, Float]:
    stamps = np.arange(round(start_s * 1e3), round(end_s * 1e3) + 1, 5, dtype=np.int64) * MS
    bias = np.concatenate([GYRO_BIAS, ACCEL_BIAS])
    return stamps, np.array([np.concatenate(imu_at(ns * 1e-9)) + bias for ns in stamps.tolist()])


def propagator(start_s: float = 1.0, end_s: float = 1.1) -> Propagator:
    made = Propagator(200.0, 50.0)
    made.restart(round(start_s * 1e9), state_at(start_s), 3, np.zeros(3), *samples(start_s, end_s))
    return made


@pytest.mark.parametrize("at_ms", [1000, 1003, 1050, 1099, 1100])
def test_poses_between_samples_are_those_of_the_motion(at_ms: int) -> None:
    predicted = propagator().predict(at_ms * MS)
    assert predicted is not None
    error = se3_log(se3_inverse(pose_at(at_ms * 1e-3)) @ predicted.nav_T_body)
    assert np.abs(error).max() < 2e-5
    np.testing.assert_allclose(predicted.velocity_nav, velocity_at(at_ms * 1e-3), atol=1e-3)
    np.testing.assert_allclose(predicted.angular_velocity, imu_at(at_ms * 1e-3)[0], atol=1e-3)
    assert predicted.stamp_ns == at_ms * MS
    assert predicted.epoch == 3


def test_add_one_by_one_predicts_the_same() -> None:
    whole, stepwise = propagator(), propagator(1.0, 1.0)
    stamps, values = samples(1.0, 1.1)
    for stamp, value in zip(stamps[1:].tolist(), values[1:], strict=True):
        assert stepwise.add(stamp, value)
        predicted, expected = stepwise.predict(stamp), whole.predict(stamp)
        assert predicted is not None
        assert expected is not None
        np.testing.assert_array_equal(predicted.nav_T_body, expected.nav_T_body)


def test_beyond_the_newest_sample_it_goes_on_for_a_while() -> None:
    predicted = propagator().predict(1150 * MS)
    assert predicted is not None
    assert np.abs(se3_log(se3_inverse(pose_at(1.15)) @ predicted.nav_T_body)).max() < 2e-2
    assert propagator().predict(1301 * MS) is None
    assert propagator().predict(999 * MS) is None
    assert Propagator(200.0, 50.0).predict(0) is None


def test_predict_across_a_gap_or_once_forgotten_is_none() -> None:
    gap = propagator()
    assert not gap.add(1151 * MS, np.zeros(6))
    assert gap.predict(1152 * MS) is None
    assert gap.predict(1050 * MS) is None
    lost = propagator()
    lost.forget()
    assert lost.predict(1050 * MS) is None
    assert not lost.add(1105 * MS, np.zeros(6))


def test_samples_behind_a_gap_are_not_reached() -> None:
    stamps, values = samples(1.0, 1.1)
    made = Propagator(200.0, 50.0)
    made.restart(
        1000 * MS,
        state_at(1.0),
        0,
        np.zeros(3),
        np.delete(stamps, range(3, 16)),
        np.delete(values, range(3, 16), axis=0),
    )
    predicted, expected = made.predict(1100 * MS), Propagator(200.0, 50.0)
    expected.restart(1000 * MS, state_at(1.0), 0, np.zeros(3), stamps[:3], values[:3])
    held = expected.predict(1100 * MS)
    assert predicted is not None
    assert held is not None
    np.testing.assert_array_equal(predicted.nav_T_body, held.nav_T_body)


def test_an_imu_alone_is_not_believed_for_ever() -> None:
    made = propagator(1.0, 1.0)
    stamps, values = samples(1.0, 6.5)
    predicted = [made.add(stamp, value) for stamp, value in zip(stamps.tolist(), values, strict=True)]
    assert predicted[1:1001] == [True] * 1000
    assert not any(predicted[1001:])


def test_a_sample_that_is_known_already_changes_nothing() -> None:
    made = propagator()
    before = made.predict(1100 * MS)
    assert not made.add(1100 * MS, np.full(6, 7.0))
    after = made.predict(1100 * MS)
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(before.nav_T_body, after.nav_T_body)


def test_without_samples_velocity_and_rate_in_body_go_on() -> None:
    made, rate = Propagator(200.0, 50.0), np.array([0.1, -0.2, 0.5])
    state = RigState(pose_at(1.0), velocity_at(1.0), np.zeros(3), np.zeros(3))
    made.restart(1000 * MS, state, 0, rate, *NO_SAMPLES)
    assert not made.add(1010 * MS, np.zeros(6))  # the rig has no IMU that could be used
    once, twice = made.predict(1080 * MS), made.predict(1160 * MS)
    assert once is not None
    assert twice is not None
    step = se3_inverse(state.nav_T_body) @ once.nav_T_body
    np.testing.assert_allclose(once.nav_T_body @ step, twice.nav_T_body, atol=1e-12)
    in_body = once.nav_T_body[:3, :3].T @ once.velocity_nav
    np.testing.assert_allclose(in_body, state.nav_T_body[:3, :3].T @ state.velocity_nav, atol=1e-12)
    np.testing.assert_array_equal(once.angular_velocity, rate)
    assert made.predict(1201 * MS) is None


def test_buffer_since_an_instant_interpolates() -> None:
    buffer = filled_buffer(IMU, 0.1, np.random.default_rng(1), GYRO_BIAS, ACCEL_BIAS)
    stamps, values = buffer.since(52 * MS)
    interval = buffer.interval(52 * MS, 100 * MS)
    assert interval is not None
    assert stamps[0] == 52 * MS
    assert stamps[-1] == 100 * MS
    means = 0.5 * (values[1:] + values[:-1])
    np.testing.assert_allclose(means, np.hstack([interval.angular_velocity, interval.linear_acceleration]), atol=1e-12)
    np.testing.assert_allclose(np.diff(stamps) * 1e-9, interval.steps_s, atol=1e-15)
    assert len(buffer.since(50 * MS)[0]) == 11
    assert len(buffer.since(100 * MS)[0]) == 1
    for beyond in (-1, 101 * MS):
        assert len(buffer.since(beyond)[0]) == 0


def test_one_thread_asks_while_another_works() -> None:
    made, wrong, done = propagator(1.0, 1.0), [], threading.Event()
    stamps, values = samples(1.0, 1.2)

    def ask() -> None:
        while not done.is_set():
            predicted = made.predict(1150 * MS)
            if predicted is not None and np.abs(se3_log(se3_inverse(pose_at(1.15)) @ predicted.nav_T_body)).max() > 0.2:
                wrong.append(predicted)

    asking = threading.Thread(target=ask)
    asking.start()
    for _ in range(100):
        made.restart(1000 * MS, state_at(1.0), 0, np.zeros(3), stamps[:1], values[:1])
        for stamp, value in zip(stamps[1:].tolist(), values[1:], strict=True):
            assert made.add(stamp, value)
    done.set()
    asking.join()
    assert not wrong
