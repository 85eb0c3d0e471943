"""The smoother's factors other than the visual ones, and the keys of its variables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.noise import gaussian, isotropic
from graphvio.backend.states import InitialUncertainty, RigState
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.rig import Imu

_ACCEL_BIAS_SIGMA = 0.2
_GRAVITY_SIGMA_M_S2 = 0.02  # variation of the length of gravity on Earth
_MIN_GRAVITY_SIGMA_M_S2 = 1e-3
_MIN_INERTIAL_SIGMA = 1e-4  # m/s, m/s^2, rad/s: added to the covariance of `_inertial_prior`
_X, _V, _B, _R, _G, _SUM = (int(gtsam.symbol(letter, 0)) for letter in "xvbrgs")  # faster than a call for each key
_ZERO_VELOCITY_SIGMA_M_S = 0.005  # standard deviation of the velocity while the images stand still


def x(k: int) -> int:
    """Return the key of the pose of state k, ``nav_T_body``."""
    return _X + k


def v(k: int) -> int:
    """Return the key of the velocity of state k, in nav."""
    return _V + k


def b(k: int) -> int:
    """Return the key of the biases of state k: accelerometer, gyro."""
    return _B + k


def r(k: int) -> int:
    """Return the key of the pose of state k as vision sees it, see `ReferenceViews`."""
    return _R + k


def g() -> int:
    """Return the key of gravity in nav."""
    return _G


def first_state(
    k: int, state: RigState, uncertainty: InitialUncertainty, with_imu: bool
) -> Iterator[gtsam.NonlinearFactor]:
    """Yield the priors on the first state; with a joint inertial covariance, they include gravity's direction."""
    yield gtsam.PriorFactorPose3(x(k), gtsam.Pose3(state.nav_T_body), gaussian(uncertainty.pose))
    if with_imu and uncertainty.inertial is not None:
        yield _inertial_prior(k, state, uncertainty.inertial)
    elif with_imu:
        yield gtsam.PriorFactorVector(v(k), state.velocity_nav, isotropic(3, uncertainty.velocity_m_s))
        sigmas = np.repeat([_ACCEL_BIAS_SIGMA, uncertainty.gyro_bias_rad_s], 3)
        bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
        yield gtsam.PriorFactorConstantBias(b(k), bias, gtsam.noiseModel.Diagonal.Sigmas(sigmas))


def gravity(gravity_nav: Float, uncertainty: InitialUncertainty) -> Iterator[gtsam.NonlinearFactor]:
    """Yield the priors on gravity in nav: on its direction, unless `first_state` yields it, and on its length.

    Args:
        gravity_nav: (3,) gravity in nav, m/s^2.
        uncertainty: the uncertainty of the first state.
    """
    if uncertainty.inertial is None:
        along = np.outer(gravity_nav, gravity_nav)  # leaves the length almost free
        floor = _MIN_GRAVITY_SIGMA_M_S2**2 * np.eye(3)
        yield gtsam.PriorFactorVector(g(), gravity_nav, gaussian(uncertainty.gravity + along + floor))
    yield gtsam.CustomFactor(isotropic(1, _GRAVITY_SIGMA_M_S2), [g()], _length_error)


def _inertial_prior(k: int, state: RigState, covariance: Float) -> gtsam.NonlinearFactor:
    """Return the joint prior on velocity, biases and gravity with their covariance (12, 12)."""
    whitener = np.linalg.inv(np.linalg.cholesky(covariance + _MIN_INERTIAL_SIGMA**2 * np.eye(12)))
    linear = gtsam.JacobianFactor(
        v(k),
        whitener[:, :3],
        b(k),
        whitener[:, 3:9],
        g(),
        whitener[:, 9:],
        np.zeros(12),
        gtsam.noiseModel.Unit.Create(12),
    )
    values = gtsam.Values()
    values.insert(v(k), state.velocity_nav)
    values.insert(b(k), gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias))
    values.insert(g(), state.gravity_nav)
    return gtsam.LinearContainerFactor(linear, values)


def _length_error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
    vector = values.atVector(factor.keys()[0])
    length = float(np.linalg.norm(vector))
    if jacobians is not None:
        jacobians[0] = vector[None] / length
    return np.array([length - GRAVITY_M_S2])


def constant_velocity(
    i: int, j: int, motion: Float, dt: float, after_s: float, rate_sigmas: Float, accel_sigmas: Float
) -> gtsam.NonlinearFactor:
    """Return a factor of constant velocity and angular rate between two states (eq. 11 and 12).

    The motion comes from `graphvio.backend.smoother.Smoother.extend`, which repeats the previous one. The paper's noise
    is that of one step; this one models unknown accelerations that have been constant since the motion was last
    measured.

    Args:
        i: index of a state.
        j: index of the next state.
        motion: (4, 4) motion from state i to state j.
        dt: time between the states, s.
        after_s: time from the last measurement of velocity and rate to state j, s.
        rate_sigmas: (2,) standard deviations of rate and velocity when they were measured, rad/s and m/s.
        accel_sigmas: (2,) standard deviations of angular and linear acceleration, rad/s^2 and m/s^2.
    """
    # An unknown constant acceleration a leads to an error a t^2 / 2: each step adds the growth of a^2 t^4 / 4.
    growth = 0.5 * np.sqrt(after_s**4 - (after_s - dt) ** 4)
    sigmas = np.repeat(np.hypot(accel_sigmas * growth, rate_sigmas * dt), 3)
    return gtsam.BetweenFactorPose3(x(i), x(j), gtsam.Pose3(motion), gtsam.noiseModel.Diagonal.Sigmas(sigmas))


def imu_without_samples(
    i: int, j: int, dt: float, accel_sigma_m_s2: float, imu: Imu, noise_scale: float
) -> Iterator[gtsam.NonlinearFactor]:
    """Yield the factors of a step without IMU samples: constant velocity, and random walk of the biases.

    The noise of the velocity is that of an unknown acceleration which is constant within the step.
    """
    yield gtsam.BetweenFactorVector(v(i), v(j), np.zeros(3), isotropic(3, accel_sigma_m_s2 * dt))
    walk = noise_scale * np.sqrt(dt)
    sigmas = np.repeat([walk * imu.accel_random_walk, walk * imu.gyro_random_walk], 3)
    yield gtsam.BetweenFactorConstantBias(
        b(i), b(j), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    )


def zero_velocity(k: int) -> gtsam.NonlinearFactor:
    """Return a zero-velocity update of state k."""
    return gtsam.PriorFactorVector(v(k), np.zeros(3), zero_velocity_noise())


def zero_velocity_noise() -> gtsam.noiseModel.Isotropic:
    """Return the noise of a zero-velocity update."""
    return isotropic(3, _ZERO_VELOCITY_SIGMA_M_S)


def position_reset(
    keys: list[int], covariance: Float, sigma_m: float, values: gtsam.Values
) -> tuple[Float, gtsam.NonlinearFactor]:
    """Return a factor that resets a position's own uncertainty, but not its correlation with others (section 5).

    Given the other variables, the position is normally distributed about a linear function of them. The factor narrows
    that conditional distribution about its mean, so that the marginal of the other variables does not change.

    Args:
        keys: the key of the pose, then those of the other variables.
        covariance: (6 + M, 6 + M) joint covariance of these variables at their present values.
        sigma_m: conditional standard deviation of the position after the reset.
        values: present values of the variables.

    Returns:
        The part of the position's covariance (3, 3), in body, that the factor removes, and the factor.
    """
    order = np.concatenate([np.arange(3, 6), np.arange(3), np.arange(6, len(covariance))])
    ordered = covariance[np.ix_(order, order)]
    gain = np.linalg.solve(ordered[3:, 3:], ordered[3:, :3]).T
    own = ordered[:3, :3] - gain @ ordered[3:, :3]
    variances, axes = np.linalg.eigh(0.5 * (own + own.T))
    variances = np.maximum(variances, sigma_m**2)
    rows = np.sqrt(1.0 / sigma_m**2 - 1.0 / variances)[:, None] * axes.T
    jacobian = np.empty((3, len(covariance)))
    jacobian[:, order] = rows @ np.hstack([np.eye(3), -gain])
    dims = values.dims()
    columns = np.split(jacobian, np.cumsum([dims[key] for key in keys])[:-1], axis=1)
    linear = _linear(list(zip(keys, columns, strict=True)))
    forgotten = (axes * (variances - sigma_m**2)) @ axes.T
    return forgotten, gtsam.LinearContainerFactor(linear, values)


def _linear(terms: list[tuple[int, Float]]) -> gtsam.GaussianFactor:
    """Return the factor of unit noise whose error (3,) is a sum of matrices (3, D) times variables.

    gtsam's constructors take at most three variables from Python. For four, two factors that share an auxiliary
    variable, each with half of the variance, are joined by eliminating that variable.
    """
    unit = gtsam.noiseModel.Unit.Create(3)
    if len(terms) == 1:
        return gtsam.JacobianFactor(*terms[0], np.zeros(3), unit)
    graph, half = gtsam.GaussianFactorGraph(), isotropic(3, np.sqrt(0.5))
    for sign, part in ((-1.0, terms[:2]), (1.0, terms[2:])):
        blocks: list[Any] = [_SUM, sign * np.eye(3)]
        for term in part:
            blocks += term
        graph.add(gtsam.JacobianFactor(*blocks, np.zeros(3), half))  # type: ignore[call-overload]
    _, remaining = graph.eliminatePartialMultifrontal(gtsam.Ordering([_SUM]), gtsam.EliminateQR)
    return remaining.at(0)
