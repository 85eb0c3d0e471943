"""Inertial errors between the keyframes of a window, and their normal equations.

Poses are ``nav_T_body``, perturbed on the right: ``R Exp(r)``, ``p + R t``. Gravity is a free vector, (0, 0, -9.81)
where nav's z is exactly up: the window finds the vertical, and a prior must hold its norm. Biases, matrices and the
time offset of the IMU are the same in the whole window, see `graphvio.self_calibration.imu_model`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.geometry import so3_log, so3_right_jacobian_inverse
from graphvio.kernels import kernel, put
from graphvio.self_calibration.imu_model import ACCEL_MATRIX, PARAMETERS, TIME_OFFSET, sensor_matrix
from graphvio.self_calibration.preintegration import Preintegrated, covering_samples, integrate_samples

POSE, VELOCITY, GRAVITY = 6, 3, 3
_VELOCITY_I, _POSE_J, _VELOCITY_J, _GRAVITY_AT, _PARAMETERS_AT = 6, 9, 15, 18, 21
_COLUMNS = _PARAMETERS_AT + PARAMETERS
_MAX_NOISE2 = 28.0  # largest squared whitened error by noise, which exceeds it once in a thousand intervals
_MAX_SPIKE = np.repeat([2.0, 20.0], 3)  # rad/s and m/s^2, of one sample against both neighbours


class InertialSamples(NamedTuple):
    """IMU samples of a window of K keyframes.

    Attributes:
        stamps_ns: (N,) increasing, of the IMU's clock; from before the first keyframe to after the last one.
        readings: (N, 6) gyro, rad/s, and accelerometer, m/s^2, frame body.
        keyframes_ns: (K,) stamps of the keyframes, of the cameras' clock.
        noise_densities: (2,) white noise of gyro, rad/s/sqrt(Hz), and of accelerometer, m/s^2/sqrt(Hz).
        max_gap_ns: largest gap between samples of one interval.
        noise_factors: (N, 2) factors on the variance of the noise of gyro and accelerometer, from each sample to the
            next.
    """

    stamps_ns: Int
    readings: Float
    keyframes_ns: Int
    noise_densities: Float
    max_gap_ns: int
    noise_factors: Float

    def without(self, intervals: Int) -> InertialSamples:
        """Return the samples without those of some intervals between keyframes, which are then not covered."""
        interval = np.searchsorted(self.keyframes_ns, self.stamps_ns, side="right") - 1
        kept = ~np.isin(interval, intervals)
        return self._replace(
            stamps_ns=self.stamps_ns[kept], readings=self.readings[kept], noise_factors=self.noise_factors[kept]
        )

    def intervals_with_spikes(self) -> Int:
        """Return the intervals between keyframes with a sample that is far from the one before and the one after."""
        middle = np.median(np.stack([self.readings[:-2], self.readings[1:-1], self.readings[2:]]), axis=0)
        is_spike = (np.abs(self.readings[1:-1] - middle) > _MAX_SPIKE).any(axis=1)
        found = np.searchsorted(self.keyframes_ns, self.stamps_ns[1:-1][is_spike], side="right") - 1
        return np.unique(found[found >= 0])


class InertialStates(NamedTuple):
    """Unknowns of a window of K keyframes.

    Attributes:
        poses: (K, 4, 4) ``nav_T_body``.
        velocities: (K, 3) m/s, frame nav.
        gravity: (3,) m/s^2, frame nav, downwards.
        parameters: (25,) of the IMU, see `graphvio.self_calibration.imu_model`.
    """

    poses: Float
    velocities: Float
    gravity: Float
    parameters: Float


class InertialEquations(NamedTuple):
    """Normal equations of a window's inertial errors; a step is ``-solve(hessian, gradient)``.

    Attributes:
        hessian: (9 K + 28, 9 K + 28) over ``[poses 6 K, velocities 3 K, gravity 3, parameters 25]``.
        gradient: (9 K + 28,).
        cost: half of the sum of ``errors2``.
        errors2: (K - 1,) squared whitened error of each interval, of 9 dimensions; NaN where the samples do not cover
            it, which leaves it out of all sums.
    """

    hessian: Float
    gradient: Float
    cost: float
    errors2: Float


@kernel
def inertial_residual(
    nav_T_i: Float, velocity_i: Float, nav_T_j: Float, velocity_j: Float, gravity: Float, preintegrated: Preintegrated
) -> tuple[Float, Float]:
    """Compute the error of two successive states against the IMU between them, and its derivatives.

    Args:
        nav_T_i: (4, 4) pose of body at the start.
        velocity_i: (3,) m/s, frame nav.
        nav_T_j: (4, 4) at the end.
        velocity_j: (3,).
        gravity: (3,) m/s^2, frame nav, downwards.
        preintegrated: the preintegrated IMU, for the parameters at which to linearise.

    Returns:
        Error (9,) ``[rotation, velocity, position]``, whose covariance is the preintegrated one, and its derivative (9,
        46) with respect to ``[pose i 6, velocity i 3, pose j 6, velocity j 3, gravity 3, parameters 25]``.
    """
    dt = preintegrated.duration_s
    i_R_nav = nav_T_i[:3, :3].T.copy()
    i_R_j = i_R_nav @ nav_T_j[:3, :3].copy()
    off = preintegrated.rotation.T.copy() @ i_R_j
    by_rotation = so3_log(off)
    by_velocity = i_R_nav @ (velocity_j - velocity_i - dt * gravity)
    by_position = i_R_nav @ (nav_T_j[:3, 3] - nav_T_i[:3, 3] - dt * velocity_i - 0.5 * dt * dt * gravity)
    inverse = so3_right_jacobian_inverse(by_rotation)
    by_first, by_imu = -inverse @ i_R_j.T.copy(), -inverse @ off.T.copy()
    error, jacobian = np.empty(9), np.zeros((9, _COLUMNS))
    for r in range(3):
        error[r] = by_rotation[r]
        error[3 + r] = by_velocity[r] - preintegrated.velocity[r]
        error[6 + r] = by_position[r] - preintegrated.position[r]
        jacobian[6 + r, 3 + r] = -1.0
        for c in range(3):
            jacobian[r, c], jacobian[r, _POSE_J + c] = by_first[r, c], inverse[r, c]
            jacobian[6 + r, _POSE_J + 3 + c] = i_R_j[r, c]
            jacobian[3 + r, _VELOCITY_I + c], jacobian[3 + r, _VELOCITY_J + c] = -i_R_nav[r, c], i_R_nav[r, c]
            jacobian[6 + r, _VELOCITY_I + c] = -dt * i_R_nav[r, c]
            jacobian[3 + r, _GRAVITY_AT + c] = -dt * i_R_nav[r, c]
            jacobian[6 + r, _GRAVITY_AT + c] = -0.5 * dt * dt * i_R_nav[r, c]
        for c in range(PARAMETERS):
            at = _PARAMETERS_AT + c
            for k in range(3):
                jacobian[r, at] += by_imu[r, k] * preintegrated.jacobian[k, c]
            jacobian[3 + r, at] = -preintegrated.jacobian[3 + r, c]
            jacobian[6 + r, at] = -preintegrated.jacobian[6 + r, c]
    _put_skew(by_velocity, jacobian[3:6, :3])
    _put_skew(by_position, jacobian[6:9, :3])
    return error, jacobian


@kernel
def _put_skew(v: Float, out: Float) -> None:
    """Fill the matrix (3, 3) of the cross product; the diagonal stays."""
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]


@kernel
def whitener_of(covariance: Float) -> Float:
    """Return the inverse (N, N) of a covariance's lower Cholesky factor: it makes errors independent, of variance 1."""
    n = len(covariance)
    lower, inverse = np.zeros((n, n)), np.zeros((n, n))
    for r in range(n):
        for c in range(r + 1):
            total = covariance[r, c]
            for k in range(c):
                total -= lower[r, k] * lower[c, k]
            lower[r, c] = np.sqrt(total) if c == r else total / lower[c, c]
    for r in range(n):
        inverse[r, r] = 1.0 / lower[r, r]
        for c in range(r):
            total = 0.0
            for k in range(c, r):
                total -= lower[r, k] * inverse[k, c]
            inverse[r, c] = total * inverse[r, r]
    return inverse


@kernel
def inertial_equations(samples: InertialSamples, states: InertialStates) -> InertialEquations:
    """Linearise the inertial errors of all intervals of a window, with the IMU integrated by the states' parameters."""
    n = len(states.poses)
    size = 9 * n + GRAVITY + PARAMETERS
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    errors2, cost = np.full(max(n - 1, 0), np.nan), 0.0
    columns, row, whitened = np.empty(_COLUMNS, dtype=np.int64), np.empty(_COLUMNS), np.empty(9)
    for i in range(n - 1):
        start_ns, end_ns = samples.keyframes_ns[i], samples.keyframes_ns[i + 1]
        first, last = covering_samples(
            samples.stamps_ns, start_ns, end_ns, states.parameters[TIME_OFFSET], samples.max_gap_ns
        )
        if last < 0:
            continue
        preintegrated = integrate_samples(
            samples.stamps_ns, samples.readings, first, last, start_ns, end_ns, states.parameters,
            samples.noise_densities, samples.noise_factors,
        )  # fmt: skip
        error, jacobian = inertial_residual(
            states.poses[i], states.velocities[i], states.poses[i + 1], states.velocities[i + 1], states.gravity,
            preintegrated,
        )  # fmt: skip
        _put_columns(n, i, columns)
        whitener, error2 = whitener_of(preintegrated.covariance), 0.0
        for r in range(9):
            whitened[r] = 0.0
            for k in range(r + 1):
                whitened[r] += whitener[r, k] * error[k]
            error2 += whitened[r] * whitened[r]
        _take_noise(preintegrated, states.parameters, whitener, whitened, error2, jacobian)
        for r in range(9):
            put(row, np.zeros(_COLUMNS))
            for k in range(r + 1):
                for c in range(_COLUMNS):
                    row[c] += whitener[r, k] * jacobian[k, c]
            for c in range(_COLUMNS):
                gradient[columns[c]] += row[c] * whitened[r]
                for d in range(c, _COLUMNS):
                    one, other = min(columns[c], columns[d]), max(columns[c], columns[d])
                    hessian[one, other] += row[c] * row[d]
        errors2[i] = error2
        cost += 0.5 * error2
    for c in range(size):
        for d in range(c):
            hessian[c, d] = hessian[d, c]
    return InertialEquations(hessian, gradient, cost, errors2)


@kernel
def _take_noise(
    preintegrated: Preintegrated, parameters: Float, whitener: Float, whitened: Float, error2: float, jacobian: Float
) -> None:
    """Remove the noise that an error shows from its derivatives with respect to the accelerometer's matrix.

    The derivatives are proportional to readings, whose noise is also in the error (errors in variables): by this, a
    scale that vision does not observe either would shrink by a percent in minutes. Without that noise, the gradient is
    that of the squared error, whose covariance grows with the matrix. W. A. Fuller, *Measurement Error Models*, Wiley
    1987, section 1.1. The gyro's noise is so small beside what it measures that its matrix needs none of this.

    Args:
        preintegrated: the preintegrated IMU.
        parameters: (25,) of the IMU.
        whitener: (9, 9) matrix that whitens the error.
        whitened: (9,) whitened error.
        error2: its square.
        jacobian: (9, 46) is changed.
    """
    weighed = np.zeros(9)
    for r in range(9):
        for k in range(r + 1):
            weighed[k] += whitener[r, k] * whitened[r]
    weighed *= _MAX_NOISE2 / max(error2, _MAX_NOISE2)
    middle, (of_velocity, of_both, of_position) = preintegrated.middle_rotation, preintegrated.force_variances
    axes = middle @ sensor_matrix(parameters, ACCEL_MATRIX)
    for c in range(3):
        by_velocity, by_position = 0.0, 0.0
        for k in range(3):
            by_velocity += axes[k, c] * (of_velocity * weighed[3 + k] + of_both * weighed[6 + k])
            by_position += axes[k, c] * (of_both * weighed[3 + k] + of_position * weighed[6 + k])
        for r in range(3):
            at = _PARAMETERS_AT + ACCEL_MATRIX + 3 * r + c
            for k in range(3):
                jacobian[3 + k, at] -= middle[k, r] * by_velocity
                jacobian[6 + k, at] -= middle[k, r] * by_position


@kernel
def _put_columns(n_keyframes: int, i: int, columns: Int) -> None:
    """Fill the indices (46,) of the columns of `inertial_residual` in the window's equations."""
    for c in range(POSE):
        columns[c], columns[_POSE_J + c] = POSE * i + c, POSE * (i + 1) + c
    for c in range(VELOCITY):
        at = POSE * n_keyframes + VELOCITY * i + c
        columns[_VELOCITY_I + c], columns[_VELOCITY_J + c] = at, at + VELOCITY
    for c in range(GRAVITY + PARAMETERS):
        columns[_GRAVITY_AT + c] = 9 * n_keyframes + c
