"""The inertial part of the self-calibration, on walks of the simulator with exact truth; no images."""

from functools import cache
from typing import NamedTuple

import gtsam
import numpy as np
import pytest
from monte_carlo import band

from graphvio.arrays import Float, Int
from graphvio.errors import MeasurementError
from graphvio.geometry import so3_exp, so3_log, so3_right_jacobian
from graphvio.rig import Imu
from graphvio.self_calibration.imu_model import (
    ACCEL_BIAS,
    ACCEL_MATRIX,
    GYRO_BIAS,
    GYRO_MATRIX,
    PARAMETERS,
    TIME_OFFSET,
)
from graphvio.self_calibration.inertial import (
    InertialEquations,
    InertialSamples,
    InertialStates,
    inertial_equations,
    inertial_residual,
    whitener_of,
)
from graphvio.self_calibration.preintegration import Preintegrated, preintegrate
from graphvio.simulation import build_scene
from graphvio.simulation.imu import GRAVITY_MPS2, ideal_readings
from graphvio.simulation.motion import Motion

START_NS = 1_700_000_000_000_000_000  # of today's size: float64 cannot hold it
GAP_NS = 50_000_000
IMU = Imu()
DENSITIES = np.array([IMU.gyro_noise_density, IMU.accel_noise_density])
DOWN = np.array([0.0, 0.0, -GRAVITY_MPS2])
PERFECT = np.zeros(PARAMETERS)
SIGMAS = np.repeat([0.01, 0.05, 5e-3, 5e-3, 2e-3], [3, 3, 9, 9, 1])  # what is known of an IMU beforehand
POSE_SIGMAS = np.repeat([np.deg2rad(0.02), 5e-4], 3)
GRAVITY_SIGMA = 1e-3
WINDOW_S, KEYFRAME_S = (4.0, 14.0), 0.5
_STEP = 1e-6


@cache
def walk(scene: str) -> Motion:
    return build_scene(scene).motion


def ns(times_s: Float) -> Int:
    return START_NS + np.round(1e9 * times_s).astype(np.int64)


def measured(scene: str, times_s: Float, parameters: Float) -> Float:
    """Noise-free readings (N, 6) of an IMU, stamped at these times (N,) of its own clock."""
    rate, force = ideal_readings(walk(scene).at(times_s - parameters[TIME_OFFSET]))
    readings = []
    for values, bias, matrix in ((rate, GYRO_BIAS, GYRO_MATRIX), (force, ACCEL_BIAS, ACCEL_MATRIX)):
        errors = parameters[matrix : matrix + 9].reshape(3, 3)
        readings.append(np.linalg.solve(np.eye(3) + errors, values.T).T + parameters[bias : bias + 3])
    return np.hstack(readings)


def true_states(scene: str, times_s: Float, parameters: Float) -> InertialStates:
    states = walk(scene).at(times_s)
    return InertialStates(states.world_T_body, states.velocity, DOWN, parameters)


def moved_by(states: InertialStates, step: Float) -> InertialStates:
    """The states after a step (9 K + 28,) ``[poses, velocities, gravity, parameters]``."""
    n = len(states.poses)
    poses = states.poses.copy()
    for pose, of_pose in zip(poses, step[: 6 * n].reshape(n, 6), strict=True):
        pose[:3, 3] += pose[:3, :3] @ of_pose[3:]
        pose[:3, :3] = pose[:3, :3] @ so3_exp(of_pose[:3].copy())
    velocities, gravity, parameters = np.split(step[6 * n :], [3 * n, 3 * n + 3])
    return InertialStates(
        poses, states.velocities + velocities.reshape(n, 3), states.gravity + gravity, states.parameters + parameters
    )


def residual_of(states: InertialStates, preintegrated: Preintegrated) -> tuple[Float, Float]:
    """Error and derivatives between the first two of some states."""
    (i, j), (v_i, v_j) = states.poses[:2], states.velocities[:2]
    return inertial_residual(i, v_i, j, v_j, states.gravity, preintegrated)


def random_parameters(seed: int) -> Float:
    return SIGMAS * np.random.default_rng(seed).standard_normal(PARAMETERS)


# ------------------------------------------------------------------ one interval


@pytest.mark.parametrize("scene", ["room", "stairs", "calibration"])
@pytest.mark.parametrize("duration_s", [0.05, 0.25, 1.0])
def test_preintegrate_exact_readings_give_the_true_motion(scene: str, duration_s: float) -> None:
    """With a distorted IMU, ends between samples, and errors below a thousandth of what noise makes."""
    parameters = random_parameters(1)
    times = np.arange(2.0, 12.0, 1.0 / IMU.rate_hz)
    stamps, readings = ns(times), measured(scene, times, parameters)
    for start_s in np.arange(2.1012, 10.5, 0.19):
        ends = np.array([start_s, start_s + duration_s])
        start_ns, end_ns = ns(ends).tolist()
        preintegrated = preintegrate(stamps, readings, start_ns, end_ns, parameters, DENSITIES)
        error, _ = residual_of(true_states(scene, ends, parameters), preintegrated)
        assert np.abs(error / np.sqrt(np.diag(preintegrated.covariance))).max() < 1e-3


def test_preintegrate_jittered_and_lost_samples_are_almost_as_exact() -> None:
    rng = np.random.default_rng(2)
    times = np.arange(2.0, 6.0, 1.0 / IMU.rate_hz)
    times = (times + rng.uniform(-1e-3, 1e-3, len(times)))[rng.random(len(times)) > 0.05]
    readings, ends = measured("room", times, PERFECT), np.array([3.0, 3.5])
    start_ns, end_ns = ns(ends).tolist()
    preintegrated = preintegrate(ns(times), readings, start_ns, end_ns, PERFECT, DENSITIES)
    error, _ = residual_of(true_states("room", ends, PERFECT), preintegrated)
    assert np.abs(error / np.sqrt(np.diag(preintegrated.covariance))).max() < 0.05


def test_preintegrate_jacobian_is_that_of_finite_differences() -> None:
    parameters = random_parameters(3)
    times = np.arange(2.0, 6.0, 1.0 / IMU.rate_hz)
    stamps, readings = ns(times), measured("room", times, random_parameters(4))
    start_ns, end_ns = ns(np.array([3.0012, 3.4034])).tolist()
    centre = preintegrate(stamps, readings, start_ns, end_ns, parameters, DENSITIES)
    for index in range(PARAMETERS):
        step = _STEP * np.eye(PARAMETERS)[index]
        low, high = (
            preintegrate(stamps, readings, start_ns, end_ns, at, DENSITIES)
            for at in (parameters - step, parameters + step)
        )
        numeric = np.concatenate(
            [so3_log(low.rotation.T @ high.rotation), high.velocity - low.velocity, high.position - low.position]
        ) / (2.0 * _STEP)
        column = centre.jacobian[:, index]
        for part in (slice(0, 3), slice(3, 6), slice(6, 9)):
            assert np.linalg.norm(column[part] - numeric[part]) < 2e-4 * np.linalg.norm(numeric[part]) + 1e-6, index


def gtsam_preintegrated(steps_s: float, rates: Float, forces: Float) -> gtsam.PreintegratedImuMeasurements:
    params = gtsam.PreintegrationParams.MakeSharedU(GRAVITY_MPS2)
    params.setGyroscopeCovariance(DENSITIES[0] ** 2 * np.eye(3))
    params.setAccelerometerCovariance(DENSITIES[1] ** 2 * np.eye(3))
    params.setIntegrationCovariance(np.zeros((3, 3)))
    oracle = gtsam.PreintegratedImuMeasurements(params, gtsam.imuBias.ConstantBias())
    for rate, force in zip(rates, forces, strict=True):
        oracle.integrateMeasurement(force, rate, steps_s)
    return oracle


def test_preintegrate_perfect_imu_is_as_by_gtsam() -> None:
    """Of readings that change linearly, which gtsam gets in very short steps."""
    times = np.arange(0.0, 0.6, 1.0 / IMU.rate_hz)
    at_zero, slope = np.array([0.4, -0.6, 0.5, 1.0, 0.5, 9.0]), np.array([-2.0, 1.0, 3.0, 4.0, -8.0, 5.0])
    start_ns, end_ns = ns(np.array([0.05, 0.55])).tolist()
    ours = preintegrate(ns(times), at_zero + times[:, None] * slope, start_ns, end_ns, PERFECT, DENSITIES)
    step_s = 0.5e-4
    fine = at_zero + (0.05 + (np.arange(10_000) + 0.5) * step_s)[:, None] * slope
    oracle = gtsam_preintegrated(step_s, fine[:, :3], fine[:, 3:])
    rotation = np.eye(3)
    for rate in fine[:, :3]:
        rotation = rotation @ so3_exp(step_s * rate)
    np.testing.assert_allclose(ours.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(ours.rotation, oracle.deltaRij().matrix(), atol=1e-6)  # gtsam's rule is Euler's
    np.testing.assert_allclose(ours.velocity, oracle.deltaVij(), atol=2e-4)
    np.testing.assert_allclose(ours.position, oracle.deltaPij(), atol=2e-4)
    # gtsam's tangent is the rotation vector, ours is at the rotation, and its order is rotation, position, velocity.
    change = np.zeros((9, 9))
    change[:3, :3] = so3_right_jacobian(so3_log(ours.rotation))
    change[3:6, 6:], change[6:, 3:6] = np.eye(3), np.eye(3)
    expected = change @ oracle.preintMeasCov() @ change.T
    scale = np.outer(*2 * [np.sqrt(np.diag(expected))])
    np.testing.assert_allclose(ours.covariance / scale, expected / scale, atol=2e-3)
    for index in range(6):
        bias = 1e-4 * np.eye(6)[index]
        low, high = (
            oracle.predict(gtsam.NavState(), gtsam.imuBias.ConstantBias(sign * bias[3:], sign * bias[:3]))
            for sign in (-1.0, 1.0)
        )
        turned = so3_log(low.attitude().matrix().T @ high.attitude().matrix())
        numeric = np.concatenate([turned, high.velocity() - low.velocity(), high.position() - low.position()]) / 2e-4
        np.testing.assert_allclose(ours.jacobian[:, index], numeric, atol=1e-3 * np.abs(numeric).max())


def test_preintegrate_noise_factors_enlarge_the_variance_of_their_steps() -> None:
    times = np.arange(2.0, 3.0, 1.0 / IMU.rate_hz)
    stamps, readings = ns(times), measured("room", times, PERFECT)
    start_ns, middle_ns, end_ns = ns(np.array([2.25, 2.5, 2.75])).tolist()

    def covariance(until_ns: int, densities: Float, factors: Float) -> Float:
        return preintegrate(stamps, readings, start_ns, until_ns, PERFECT, densities, GAP_NS, factors).covariance

    ones, larger = np.ones((len(times), 2)), np.tile([9.0, 4.0], (len(times), 1))
    by_densities = covariance(end_ns, np.array([3.0, 2.0]) * DENSITIES, ones)
    np.testing.assert_allclose(covariance(end_ns, DENSITIES, larger), by_densities, rtol=1e-9, atol=1e-30)
    later = np.where(stamps[:, None] >= middle_ns, larger, 1.0)
    np.testing.assert_array_equal(covariance(middle_ns, DENSITIES, later), covariance(middle_ns, DENSITIES, ones))
    sigmas2 = [np.diag(covariance(end_ns, DENSITIES, factors)) for factors in (ones, later, larger)]
    assert (sigmas2[0] < sigmas2[1]).all()
    assert (sigmas2[1] < sigmas2[2]).all()
    np.testing.assert_allclose(sigmas2[1][:3], 5.0 * sigmas2[0][:3])  # half of the time by 1, half by 9


def test_preintegrate_samples_that_do_not_cover_the_interval_are_refused() -> None:
    times = np.arange(2.0, 3.0, 1.0 / IMU.rate_hz)
    kept = (times < 2.5) | (times > 2.56)
    stamps, readings = ns(times[kept]), measured("room", times[kept], PERFECT)
    early, late = PERFECT.copy(), PERFECT.copy()
    early[TIME_OFFSET], late[TIME_OFFSET] = -0.01, 0.02
    for start_s, end_s, parameters in (
        (1.99, 2.1, PERFECT),
        (2.9, 3.0, PERFECT),
        (2.48, 2.6, PERFECT),
        (2.1, 2.1, PERFECT),
        (2.2, 2.1, PERFECT),
        (2.005, 2.1, early),
        (2.9, 2.98, late),
    ):
        start_ns, end_ns = ns(np.array([start_s, end_s])).tolist()
        with pytest.raises(MeasurementError, match="do not cover"):
            preintegrate(stamps, readings, start_ns, end_ns, parameters, DENSITIES)
    for start_s, end_s, parameters in ((2.0, 2.1, PERFECT), (2.02, 2.1, early), (2.9, 2.97, late)):
        start_ns, end_ns = ns(np.array([start_s, end_s])).tolist()
        preintegrate(stamps, readings, start_ns, end_ns, parameters, DENSITIES)


# ------------------------------------------------------------------ errors between states


def test_inertial_residual_jacobian_is_that_of_finite_differences() -> None:
    rng = np.random.default_rng(5)
    times, ends = np.arange(2.0, 6.0, 1.0 / IMU.rate_hz), np.array([3.0012, 3.4034])
    stamps, readings = ns(times), measured("room", times, random_parameters(6))
    start_ns, end_ns = ns(ends).tolist()
    states = true_states("room", ends, random_parameters(7))
    states = moved_by(states, np.concatenate([0.1 * rng.standard_normal(9 * 2 + 3), np.zeros(PARAMETERS)]))

    def error_after(step: Float) -> tuple[Float, Float]:
        moved = moved_by(states, step)
        return residual_of(moved, preintegrate(stamps, readings, start_ns, end_ns, moved.parameters, DENSITIES))

    size = 9 * 2 + 3 + PARAMETERS
    numeric = np.array(
        [(error_after(_STEP * e)[0] - error_after(-_STEP * e)[0]) / (2.0 * _STEP) for e in np.eye(size)]
    ).T
    order = [*range(6), 12, 13, 14, *range(6, 12), 15, 16, 17, *range(18, size)]  # of the residual's columns
    jacobian = error_after(np.zeros(size))[1]
    np.testing.assert_allclose(jacobian, numeric[:, order], atol=5e-4 * np.abs(numeric).max(), rtol=5e-4)


def test_whitener_makes_the_covariance_the_identity() -> None:
    root = np.random.default_rng(8).standard_normal((9, 9)) * np.logspace(0, -4, 9)[:, None]
    whitener = whitener_of(root @ root.T)
    np.testing.assert_allclose(whitener @ root @ root.T @ whitener.T, np.eye(9), atol=1e-6)
    assert (np.triu(whitener, 1) == 0.0).all()


# ------------------------------------------------------------------ windows


def residuals(samples: InertialSamples, states: InertialStates) -> list[tuple[Float, Float]]:
    """Error of each interval, and its covariance, by `preintegrate` and `inertial_residual`."""
    found = []
    for i in range(len(states.poses) - 1):
        start_ns, end_ns = samples.keyframes_ns[i : i + 2].tolist()
        pair = InertialStates(states.poses[i : i + 2], states.velocities[i : i + 2], states.gravity, states.parameters)
        preintegrated = preintegrate(
            samples.stamps_ns, samples.readings, start_ns, end_ns, states.parameters, samples.noise_densities
        )
        found.append((residual_of(pair, preintegrated)[0], preintegrated.covariance))
    return found


def cost_of(samples: InertialSamples, states: InertialStates) -> float:
    errors2 = [error @ np.linalg.solve(covariance, error) for error, covariance in residuals(samples, states)]
    return 0.5 * float(sum(errors2))


def small_window(noise_factor: float = 1.0) -> tuple[InertialSamples, InertialStates]:
    times, keyframes = np.arange(2.0, 4.0, 1.0 / IMU.rate_hz), np.array([2.5, 2.75, 3.05, 3.3])
    noise = noise_factor * np.repeat(DENSITIES, 3) * np.sqrt(IMU.rate_hz)
    readings = measured("room", times, random_parameters(9))
    readings = readings + noise * np.random.default_rng(0).standard_normal(readings.shape)
    samples = InertialSamples(ns(times), readings, ns(keyframes), DENSITIES, GAP_NS, np.ones((len(times), 2)))
    return samples, true_states("room", keyframes, random_parameters(9))


@pytest.mark.parametrize("noise_factor", [0.0, 1.0])
def test_inertial_equations_are_those_of_all_whitened_errors(noise_factor: float) -> None:
    samples, states = small_window(noise_factor)
    equations = inertial_equations(samples, states)
    assert equations.errors2.max() < 20.0
    whiteners = [whitener_of(covariance) for _, covariance in residuals(samples, states)]

    def errors_at(step: Float) -> Float:
        moved = moved_by(states, step)
        return np.concatenate([w @ error for w, (error, _) in zip(whiteners, residuals(samples, moved), strict=True)])

    size = len(equations.gradient)
    errors, steps = errors_at(np.zeros(size)), _STEP * np.eye(size)
    jacobian = np.array([(errors_at(step) - errors_at(-step)) / (2.0 * _STEP) for step in steps]).T
    by_cost = [(cost_of(samples, moved_by(states, step)) - cost_of(samples, moved_by(states, -step))) for step in steps]
    scale = np.sqrt((jacobian**2).sum(axis=0))
    has_noise = np.zeros(size, dtype=bool)  # whose derivatives are not those of the errors as they are
    has_noise[size - PARAMETERS + ACCEL_MATRIX : size - 1] = noise_factor > 0.0
    both, by_both = np.ix_(~has_noise, ~has_noise), np.outer(scale, scale)
    np.testing.assert_allclose((equations.hessian / by_both)[both], (jacobian.T @ jacobian / by_both)[both], atol=2e-3)
    numeric, atol = np.array(by_cost) / (2.0 * _STEP), 5e-4 * (1.0 + float(np.linalg.norm(errors)))
    np.testing.assert_allclose(equations.gradient / scale, numeric / scale, atol=atol)
    assert equations.cost == pytest.approx(0.5 * errors @ errors)
    np.testing.assert_allclose(equations.errors2, (errors.reshape(-1, 9) ** 2).sum(axis=1))
    assert not np.isnan(equations.errors2).any()


def test_inertial_equations_intervals_without_samples_are_left_out() -> None:
    samples, states = small_window()
    whole = inertial_equations(samples, states)
    at = np.searchsorted(samples.stamps_ns, ns(np.array([2.8, 2.9])))
    kept = np.r_[: at[0], at[1] : len(samples.stamps_ns)]
    cut = samples._replace(stamps_ns=samples.stamps_ns[kept], readings=samples.readings[kept])
    equations = inertial_equations(cut, states)
    assert np.isnan(equations.errors2).tolist() == [False, True, False]
    assert equations.cost == pytest.approx(whole.cost - 0.5 * whole.errors2[1])
    assert not equations.hessian[6:12, 12:18].any()  # between the poses at its ends
    assert equations.hessian[12:18, 18:24].any()


# ------------------------------------------------------------------ calibration of a walk


class Recovered(NamedTuple):
    """Errors of the parameters, their covariance, and the cost of all measurements and priors at the solution."""

    error: Float
    covariance: Float
    cost: float


def noisy_walk(seed: int, sigmas: Float, keyframe_s: float) -> tuple[Float, InertialSamples, InertialStates]:
    """Parameters of an IMU, its samples of ten seconds of a walk, and true states with keyframes of some distance."""
    rng = np.random.default_rng(seed)
    truth = sigmas * rng.standard_normal(PARAMETERS)
    times = np.arange(WINDOW_S[0] - 0.1, WINDOW_S[1] + 0.1, 1.0 / IMU.rate_hz)
    noise = np.repeat(DENSITIES, 3) * np.sqrt(IMU.rate_hz) * rng.standard_normal((len(times), 6))
    keyframes = np.arange(WINDOW_S[0], WINDOW_S[1] + 1e-6, keyframe_s)
    readings = measured("room", times, truth) + noise
    samples = InertialSamples(ns(times), readings, ns(keyframes), DENSITIES, GAP_NS, np.ones((len(times), 2)))
    return truth, samples, true_states("room", keyframes, truth)


def measured_poses(seed: int, states: InertialStates, sigmas: Float) -> Float:
    n = len(states.poses)
    off = np.zeros(9 * n + 3 + PARAMETERS)
    off[: 6 * n] = np.tile(sigmas, n) * np.random.default_rng([seed, 1]).standard_normal(6 * n)
    return moved_by(states, off).poses


def recover(seed: int) -> Recovered:
    """Calibrate an IMU by ten seconds of a walk with measured poses; everything is sampled as the priors say."""
    truth, samples, exact = noisy_walk(seed, SIGMAS, KEYFRAME_S)
    poses = measured_poses(seed, exact, POSE_SIGMAS)
    velocities = np.gradient(poses[:, :3, 3], np.arange(len(poses)) * KEYFRAME_S, axis=0)
    tilted = so3_exp(np.array([0.01, -0.02, 0.0])) @ DOWN
    states = InertialStates(poses, velocities, tilted, np.zeros(PARAMETERS))
    for _ in range(4):
        equations = inertial_equations(samples, states)
        cost = equations.cost + add_priors(equations, states, poses)
        states = moved_by(states, np.asarray(-np.linalg.solve(equations.hessian, equations.gradient)))
    covariance = np.asarray(np.linalg.inv(equations.hessian)[-PARAMETERS:, -PARAMETERS:])
    return Recovered(states.parameters - truth, covariance, cost)


def recover_scale(seed: int) -> float:
    """Error of the scale of a walk whose positions are measured up to it, in standard deviations.

    It is as well known as the accelerometer's: gravity has any norm.
    """
    sigmas, pose_sigmas = SIGMAS.copy(), 0.2 * POSE_SIGMAS
    sigmas[ACCEL_MATRIX:TIME_OFFSET] = 0.03
    _, samples, states = noisy_walk(seed, sigmas, 0.5 * KEYFRAME_S)
    poses, scale, n = measured_poses(seed, states, pose_sigmas), 0.0, len(states.poses)
    states = states._replace(parameters=np.zeros(PARAMETERS))
    origin = poses[0, :3, 3].copy()
    for _ in range(5):
        scaled = poses.copy()
        scaled[:, :3, 3] = origin + np.exp(scale) * (poses[:, :3, 3] - origin)
        at, in_scaled = inertial_equations(samples, states), np.repeat([1.0, np.exp(scale)], 3)
        add_priors(at, states, scaled, sigmas, pose_sigmas * in_scaled, gravity_sigma=10.0)
        arms, offs = (
            np.einsum("kji,kj->ki", poses[:, :3, :3], states.poses[:, :3, 3] - since) * np.exp(-scale)
            for since in (origin, scaled[:, :3, 3])
        )
        by_scale, information = np.zeros((len(at.gradient), 1)), pose_sigmas[3:] ** -2.0
        of_positions = 6 * np.arange(n)[:, None] + np.arange(3, 6)
        by_scale[of_positions, 0] = -arms * information * np.exp(-scale)
        hessian = np.block([[at.hessian, by_scale], [by_scale.T, (arms**2 * information).sum()]])
        step = -np.linalg.solve(hessian, np.append(at.gradient, -(arms * offs * information).sum()))
        states, scale = moved_by(states, step[:-1]), scale + float(step[-1])
    return scale / float(np.sqrt(np.linalg.inv(hessian)[-1, -1]))


def add_priors(
    equations: InertialEquations,
    states: InertialStates,
    poses: Float,
    sigmas: Float = SIGMAS,
    pose_sigmas: Float = POSE_SIGMAS,
    gravity_sigma: float = GRAVITY_SIGMA,
) -> float:
    """Add measured poses, the norm of gravity, and what is known of the IMU beforehand to a window's equations.

    Returns their cost.
    """
    hessian, gradient, n = equations.hessian, equations.gradient, len(poses)
    information = np.concatenate([np.tile(pose_sigmas**-2.0, n), np.zeros(3 * n + 3), sigmas**-2.0])
    off = np.concatenate(
        [
            np.concatenate([so3_log(m[:3, :3].T @ p[:3, :3]), m[:3, :3].T @ (p[:3, 3] - m[:3, 3])])
            for m, p in zip(poses, states.poses, strict=True)
        ]
        + [np.zeros(3 * n + 3), states.parameters]
    )
    hessian[np.diag_indices_from(hessian)] += information
    gradient += information * off
    norm, at = float(np.linalg.norm(states.gravity)), slice(9 * n, 9 * n + 3)
    by_gravity, norm_off = states.gravity / norm / gravity_sigma, (norm - GRAVITY_MPS2) / gravity_sigma
    hessian[at, at] += np.outer(by_gravity, by_gravity)
    gradient[at] += by_gravity * norm_off
    return 0.5 * float(information @ off**2) + 0.5 * norm_off**2


def test_a_walks_imu_is_recovered_as_well_as_the_covariance_says() -> None:
    runs = [recover(seed) for seed in range(30)]
    nees = [r.error @ np.linalg.solve(r.covariance, r.error) for r in runs]
    low, high = band(len(runs), PARAMETERS, 0.99)
    assert low < np.mean(nees) < high
    normalised = np.array([r.error / np.sqrt(np.diag(r.covariance)) for r in runs])
    low, high = band(len(runs), 1, 0.9999)
    assert ((normalised**2).mean(axis=0) > low).all()
    assert ((normalised**2).mean(axis=0) < high).all()
    assert (np.abs(normalised) < 3.0).mean() > 0.99
    keyframes = round((WINDOW_S[1] - WINDOW_S[0]) / KEYFRAME_S) + 1
    redundancy = (9 * (keyframes - 1) + 6 * keyframes + 1 + PARAMETERS) - (9 * keyframes + 3 + PARAMETERS)
    low, high = band(len(runs), redundancy, 0.99)
    assert low < np.mean([2.0 * r.cost for r in runs]) < high
    gained = np.sqrt(np.diag(runs[0].covariance)) / SIGMAS
    assert gained[TIME_OFFSET] < 0.1
    assert gained[GYRO_MATRIX + 8] < 0.1  # the scale about the vertical
    assert gained[:3].max() < 0.05


def test_scale_that_only_the_accelerometer_knows_is_not_biased() -> None:
    errors = np.array([recover_scale(seed) for seed in range(40)])
    assert abs(errors.mean()) < 3.0 / np.sqrt(len(errors))
    low, high = band(len(errors), 1, 0.99)
    assert low < (errors**2).mean() < high
