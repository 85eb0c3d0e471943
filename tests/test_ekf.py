"""The paper's filter: its state, process and measurements against numerical derivatives and plain formulas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from synthetic import random_covariance, random_transform, transform

from graphvio.arrays import Float
from graphvio.backend.ekf.filter import ExtendedKalmanFilter
from graphvio.backend.ekf.measurements import (
    STANDSTILL_FORCE_NAV,
    Measurement,
    VisualRates,
    accelerometer,
    gyro,
    stacked,
    vision,
)
from graphvio.backend.ekf.process import NOISES, jacobians, noise_sigmas, propagated
from graphvio.backend.ekf.state import ATTITUDE, ERRORS, GYRO_BIAS, POSITION, RATE, VELOCITY, FilterState
from graphvio.geometry import se3_exp, se3_inverse, so3_exp, so3_log
from graphvio.measurements.motion import RelativeMotion

DT = 0.05
SEEDS = pytest.mark.parametrize("seed", range(5))


def some_state(rng: np.random.Generator) -> FilterState:
    pose = random_transform(rng, 2.0, 5.0)
    velocity, rate, bias = rng.standard_normal((3, 3)) * [[1.0], [0.8], [0.02]]
    return FilterState(pose[:3, 3], pose[:3, :3], velocity, rate, bias)


def some_motion(rng: np.random.Generator) -> RelativeMotion:
    return RelativeMotion(
        0, round(DT * 1e9), random_transform(rng, 0.2, 0.1), random_covariance(rng, 6, 0.01), np.zeros((6, 6)), 100
    )


def numerical(function: Callable[[Float], Float], size: int, h: float = 1e-6) -> Float:
    """Derivative of a function of a vector at zero."""
    return np.column_stack([(function(step) - function(-step)) / (2.0 * h) for step in h * np.eye(size)])


@SEEDS
def test_state_plus_and_minus_are_inverse(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, error = some_state(rng), 0.3 * rng.standard_normal(ERRORS)
    np.testing.assert_allclose(state.plus(error).minus(state), error, atol=1e-12)
    np.testing.assert_array_equal(state.plus(np.zeros(ERRORS)).minus(state), np.zeros(ERRORS))


@SEEDS
def test_the_process_is_the_papers(seed: int) -> None:
    """Eq. (11) and (12): ``x_rel`` and ``rho_rel`` in body, here with the noise that is zero in `propagated`."""
    rng = np.random.default_rng(seed)
    state, noise = some_state(rng), 0.1 * rng.standard_normal(NOISES)
    noisy = replace(state, velocity_body=state.velocity_body + noise[:3], rate_body=state.rate_body + noise[3:6])
    x_rel, rho_rel = noisy.velocity_body * DT, noisy.rate_body * DT
    after = propagated(noisy, DT)
    np.testing.assert_allclose(after.position, state.position + state.nav_R_body @ x_rel)
    np.testing.assert_allclose(after.nav_R_body, state.nav_R_body @ so3_exp(rho_rel))
    np.testing.assert_array_equal(after.gyro_bias, state.gyro_bias)


@SEEDS
def test_the_process_jacobians_are_numerical_derivatives(seed: int) -> None:
    state = some_state(np.random.default_rng(seed))
    by_error, by_noise = jacobians(state, DT)
    after = propagated(state, DT)
    expected = numerical(lambda error: propagated(state.plus(error), DT).minus(after), ERRORS)
    np.testing.assert_allclose(by_error, expected, atol=1e-8)

    def with_noise(noise: Float) -> Float:
        error = np.zeros(ERRORS)
        error[VELOCITY], error[RATE], error[GYRO_BIAS] = noise[:3], noise[3:6], noise[6:]
        return propagated(state.plus(error), DT).minus(after)

    np.testing.assert_allclose(by_noise, numerical(with_noise, NOISES), atol=1e-8)


@SEEDS
def test_the_measurements_jacobians_are_numerical_derivatives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, rates = some_state(rng), VisualRates.of(some_motion(rng))
    rate, force = rng.standard_normal(3), rng.standard_normal(3)
    kinds: list[Callable[[FilterState], Measurement]] = [
        lambda at: vision(at, rates),
        lambda at: gyro(at, rate, 0.1),
        lambda at: accelerometer(at, force, 1.0),
    ]
    kinds.append(lambda at: stacked([each(at) for each in kinds[:3]]))
    for kind in kinds:
        innovation = numerical(partial(_innovation, kind, state), ERRORS)
        np.testing.assert_allclose(kind(state).by_error, -innovation, atol=1e-7)


def _innovation(kind: Callable[[FilterState], Measurement], state: FilterState, error: Float) -> Float:
    return kind(state.plus(error)).innovation


@SEEDS
def test_vision_measures_the_papers_velocities(seed: int) -> None:
    """The rotation vector of R, and ``-R^T T``, over the time step; P = [R; T] takes points from then to now."""
    motion = some_motion(np.random.default_rng(seed))
    now_T_then = se3_inverse(motion.reference_T_current)
    rates = VisualRates.of(motion)
    np.testing.assert_allclose(rates.values[:3], -now_T_then[:3, :3].T @ now_T_then[:3, 3] / DT, atol=1e-12)
    np.testing.assert_allclose(rates.values[3:], -so3_log(np.ascontiguousarray(now_T_then[:3, :3])) / DT, atol=1e-12)

    def by_tangent(xi: Float) -> Float:
        return VisualRates.of(replace(motion, reference_T_current=motion.reference_T_current @ se3_exp(xi))).values

    derivative = numerical(by_tangent, 6)
    np.testing.assert_allclose(rates.covariance, derivative @ motion.covariance @ derivative.T, atol=1e-6)


def test_a_steady_rig_agrees_with_what_it_measures() -> None:
    """Vision over a step says the velocities that take the state from its start to its end."""
    state = some_state(np.random.default_rng(0))
    after = propagated(state, DT)
    moved = se3_inverse(state.nav_T_body) @ after.nav_T_body
    motion = RelativeMotion(0, round(DT * 1e9), moved, np.eye(6), np.zeros((6, 6)), 100)
    np.testing.assert_allclose(vision(after, VisualRates.of(motion)).innovation, 0.0, atol=1e-10)
    is_stationary = replace(after, rate_body=np.zeros(3))
    force = is_stationary.nav_R_body.T @ STANDSTILL_FORCE_NAV
    np.testing.assert_allclose(accelerometer(is_stationary, force, 1.0).innovation, 0.0, atol=1e-12)
    np.testing.assert_allclose(gyro(is_stationary, is_stationary.gyro_bias, 0.1).innovation, 0.0, atol=1e-12)


@SEEDS
def test_an_update_adds_information(seed: int) -> None:
    rng = np.random.default_rng(seed)
    running = ExtendedKalmanFilter(some_state(rng), random_covariance(rng, ERRORS, 0.1))
    measurement = stacked(
        [gyro(running.state, rng.standard_normal(3), 0.1), vision(running.state, VisualRates.of(some_motion(rng)))]
    )
    before, prior = running.state, running.covariance
    running.update(measurement)
    weighted = np.linalg.solve(measurement.covariance, measurement.by_error).T
    information = np.linalg.inv(prior) + weighted @ measurement.by_error
    np.testing.assert_allclose(running.covariance, np.linalg.inv(information), atol=1e-10)
    step = np.linalg.solve(information, weighted @ measurement.innovation)
    np.testing.assert_allclose(running.state.minus(before), step, atol=1e-9)


def test_the_gate_has_the_measurements_degrees_of_freedom() -> None:
    """Of consistent innovations, it refuses the share that it is set to."""
    rng = np.random.default_rng(0)
    state, rates = some_state(rng), VisualRates.of(some_motion(rng))
    running = ExtendedKalmanFilter(state, random_covariance(rng, ERRORS, 0.01))
    for nominal in (vision(state, rates), gyro(state, np.zeros(3), 0.1)):
        spread = nominal.by_error @ running.covariance @ nominal.by_error.T + nominal.covariance
        root = np.linalg.cholesky(spread)
        sampled = [replace(nominal, innovation=root @ rng.standard_normal(len(root))) for _ in range(4000)]
        refused = np.mean([not running.gate(each, 0.95).accepted for each in sampled])
        assert abs(refused - 0.05) < 0.012  # 3.5 sigma of 4000 draws


def test_a_reset_forgets_only_the_position_for_itself() -> None:
    """What the position has in common with velocity, attitude and bias stays, and so does their own covariance."""
    rng = np.random.default_rng(0)
    running = ExtendedKalmanFilter(some_state(rng), random_covariance(rng, ERRORS, 0.1))
    before, state = running.covariance.copy(), running.state
    forgotten = running.reset_position(1e-3)
    after, others = running.covariance, slice(ATTITUDE.start, ERRORS)
    assert running.state is state
    np.testing.assert_array_equal(after[others, others], before[others, others])
    np.testing.assert_array_equal(after[POSITION, others], before[POSITION, others])
    np.testing.assert_allclose(after[POSITION, POSITION] + forgotten, before[POSITION, POSITION] + 1e-6 * np.eye(3))
    assert np.linalg.eigvalsh(forgotten).min() > 0.0
    assert np.linalg.eigvalsh(after).min() > 0.0


def test_what_resets_forget_adds_up_to_what_is_not_known_of_the_position() -> None:
    plain, reset = (ExtendedKalmanFilter(some_state(np.random.default_rng(1)), 1e-4 * np.eye(ERRORS)) for _ in range(2))
    no_rates = VisualRates(np.zeros(6), 1e-4 * np.eye(6))
    sigmas, forgotten = noise_sigmas(DT, 5.0, 10.0, 1e-4), np.zeros((3, 3))
    for k in range(2000):
        if k % 200 == 199:
            forgotten += reset.reset_position(1e-3) - 1e-6 * np.eye(3)
        for running in (plain, reset):
            running.predict(DT, sigmas)
            state = running.state
            level = accelerometer(state, state.nav_R_body.T @ STANDSTILL_FORCE_NAV, 1.0)
            running.update(stacked([vision(state, no_rates), level]))
    total = reset.covariance[POSITION, POSITION] + forgotten
    np.testing.assert_allclose(total, plain.covariance[POSITION, POSITION], rtol=0.02, atol=1e-6)
    assert np.trace(reset.covariance[POSITION, POSITION]) < 0.2 * np.trace(total)


def test_tangents_are_of_body() -> None:
    state = some_state(np.random.default_rng(2))
    turned = state.plus(np.concatenate([np.zeros(3), [0.1, 0.0, 0.0], np.zeros(9)]))
    np.testing.assert_allclose(turned.nav_R_body, state.nav_R_body @ transform([0.1, 0, 0], np.zeros(3))[:3, :3])
