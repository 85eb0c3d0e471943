"""First guess of velocity, gravity and depths in any motion, in metres, from a few keyframes and the IMU between them.

With the rotations of the gyro, each ray to a landmark is one linear equation of the velocity and gravity at the first
keyframe and of the landmark's distance: A. Martinelli, *Closed-form solution of visual-inertial structure from motion*,
IJCV 106(2), 2014. The gyro's bias is the one for which the equations fit best: J. Kaiser et al., *Simultaneous state
initialization and gyroscope bias calibration in visual inertial aided navigation*, RA-L 2(1), 2017.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.linear_algebra import product, solve_symmetric
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.monocular.reprojection import Cameras
from graphvio.monocular.structure import Structure
from graphvio.self_calibration.imu_model import PARAMETERS
from graphvio.self_calibration.inertial import InertialSamples
from graphvio.self_calibration.preintegration import preintegrate

_ROUNDS = 8
_BIAS_STEP = 1e-4  # rad/s, of the numerical derivatives
_MAX_BIAS_STEP = 0.05
_CONVERGED = 1e-5
_ROBUST_SCALE = 3.0  # of the Cauchy weights, in medians of the errors
_LENGTH_ROUNDS = 4
_BIAS_SIGMA = 0.1  # rad/s, known beforehand
_ANGLE_SIGMA = 2e-3  # of a ray, rad, against that


class FirstGuess(NamedTuple):
    """Motion of K keyframes, frame body at the first of them.

    Attributes:
        poses: (K, 4, 4) of body.
        velocities: (K, 3) m/s.
        gravity: (3,) m/s^2, downwards.
        gyro_bias: (3,) rad/s.
    """

    poses: Float
    velocities: Float
    gravity: Float
    gyro_bias: Float


class _Chain(NamedTuple):
    """The IMU since the first keyframe: times (K,), rotations (K, 3, 3), velocities and positions without gravity."""

    times: Float
    rotations: Float
    velocities: Float
    positions: Float


class _Fit(NamedTuple):
    motion: Float  # (6,) velocity and gravity
    distances: Float  # (L,)
    errors: Float  # (N, 3) weighted


def first_guess(samples: InertialSamples, structure: Structure, cameras: Cameras, gyro_bias: Float) -> FirstGuess:
    """Solve for the motion of the keyframes of ``samples``, which are the states of ``structure``.

    Args:
        samples: of the IMU, and the stamps of the K keyframes.
        structure: landmarks with two views at least.
        cameras: that see them.
        gyro_bias: (3,) rad/s from which the search begins.

    Raises:
        MeasurementError: if the samples do not cover the keyframes.
        numpy.linalg.LinAlgError: if the motion determines nothing.
    """
    n_views = len(structure.state)
    rays = np.column_stack([structure.rays, np.ones(n_views)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    landmark = np.repeat(np.arange(len(structure.odom_T_landmark)), np.diff(structure.rows))
    in_body = np.einsum("nij,nj->ni", cameras.body_T_cam[structure.camera, :3, :3], rays)
    levers = cameras.body_T_cam[structure.camera, :3, 3]
    weights, bias = np.ones(n_views), gyro_bias.copy()

    def fit(bias: Float) -> _Fit:
        return _fit(_chain(samples, bias), structure, landmark, in_body, levers, weights)

    for _ in range(_ROUNDS):
        at = fit(bias)
        distances = np.maximum(np.abs(at.distances), 1e-2)[landmark]
        angles = np.linalg.norm(at.errors, axis=1) / weights / distances
        scale = _ROBUST_SCALE * max(float(np.median(angles)), 1e-5)
        weights = 1.0 / (distances * (1.0 + (angles / scale) ** 2) ** 0.5)
        at = fit(bias)
        columns = [(fit(bias + _BIAS_STEP * axis).errors - at.errors).ravel() / _BIAS_STEP for axis in np.eye(3)]
        jacobian = np.column_stack(columns)
        held = (_ANGLE_SIGMA / _BIAS_SIGMA) ** 2
        normal = product(jacobian.T.copy(), np.column_stack([jacobian, at.errors.ravel()]))
        step = -_solved(normal[:, :3] + held * np.eye(3), normal[:, 3] + held * (bias - gyro_bias))
        bias = bias + step * min(1.0, _MAX_BIAS_STEP / max(float(np.linalg.norm(step)), 1e-12))
        if np.linalg.norm(step) < _CONVERGED:
            break
    chain = _chain(samples, bias)
    motion = _fit(chain, structure, landmark, in_body, levers, weights).motion
    gravity = motion[3:]
    for _ in range(_LENGTH_ROUNDS):
        gravity = gravity * (GRAVITY_M_S2 / np.linalg.norm(gravity))
        across = np.linalg.svd(gravity[None])[2][1:].T  # (3, 2)
        motion = _fit(chain, structure, landmark, in_body, levers, weights, (gravity, across)).motion
        gravity = motion[3:]
    times = chain.times[:, None]
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = chain.rotations
    poses[:, :3, 3] = times * motion[:3] + 0.5 * times**2 * gravity + chain.positions
    return FirstGuess(poses, motion[:3] + times * gravity + chain.velocities, gravity, bias)


def _chain(samples: InertialSamples, gyro_bias: Float) -> _Chain:
    """Integrate the IMU from the first keyframe on."""
    parameters = np.zeros(PARAMETERS)
    parameters[:3] = gyro_bias
    stamps = samples.keyframes_ns
    rotation, velocity, position = np.eye(3), np.zeros(3), np.zeros(3)
    rotations, velocities, positions = [rotation], [velocity], [position]
    for start_ns, end_ns in pairwise(stamps):
        step = preintegrate(
            samples.stamps_ns, samples.readings, int(start_ns), int(end_ns), parameters, samples.noise_densities,
            samples.max_gap_ns,
        )  # fmt: skip
        position = position + step.duration_s * velocity + rotation @ step.position
        velocity = velocity + rotation @ step.velocity
        rotation = rotation @ step.rotation
        rotations.append(rotation)
        velocities.append(velocity)
        positions.append(position)
    return _Chain((stamps - stamps[0]) * 1e-9, np.array(rotations), np.array(velocities), np.array(positions))


def _fit(
    chain: _Chain,
    structure: Structure,
    landmark: Int,
    in_body: Float,
    levers: Float,
    weights: Float,
    gravity: tuple[Float, Float] | None = None,
) -> _Fit:
    """Solve the linear equations by least squares; with gravity (3,) and two directions across it, only for these."""
    k, first = structure.state, structure.rows[:-1]
    rays = np.einsum("nij,nj->ni", chain.rotations[k], in_body)
    at = chain.positions[k] + np.einsum("nij,nj->ni", chain.rotations[k], levers)
    k_first, d_first = k[first][landmark], rays[first][landmark]
    apart = at[first][landmark] - at
    dt = chain.times[k_first] - chain.times[k]
    dt2 = 0.5 * (chain.times[k_first] ** 2 - chain.times[k] ** 2)
    across = weights[:, None, None] * (np.eye(3) - rays[:, :, None] * rays[:, None, :])
    by_motion = np.concatenate([across * dt[:, None, None], across * dt2[:, None, None]], axis=2)
    constant = np.einsum("nij,nj->ni", across, apart)
    if gravity is not None:
        by_gravity = by_motion[:, :, 3:]
        constant = constant + np.einsum("nij,j->ni", by_gravity, gravity[0])
        by_motion = np.concatenate([by_motion[:, :, :3], np.einsum("nij,jk->nik", by_gravity, gravity[1])], axis=2)
    by_distance = np.einsum("nij,nj->ni", across, d_first)
    n = len(structure.odom_T_landmark)
    size = by_motion.shape[2]

    def of_landmarks(values: Float) -> Float:
        return np.asarray(np.add.reduceat(values, first, axis=0))

    s = of_landmarks((by_distance**2).sum(axis=1)) + 1e-12
    r = of_landmarks(np.einsum("nij,ni->nj", by_motion, by_distance))
    h = of_landmarks((by_distance * constant).sum(axis=1))
    of_depths = product((r / s[:, None]).T.copy(), np.column_stack([r, h]))
    normal = np.einsum("nij,nik->jk", by_motion, by_motion) - of_depths[:, :-1]
    right = np.einsum("nij,ni->j", by_motion, constant) - of_depths[:, -1]
    solution = -_solved(normal + 1e-12 * np.trace(normal) * np.eye(size), right)
    distances = -(h + np.einsum("lj,j->l", r, solution)) / s
    errors = np.einsum("nij,j->ni", by_motion, solution) + by_distance * distances[landmark][:, None] + constant
    if gravity is not None:
        solution = np.concatenate([solution[:3], gravity[0] + gravity[1] @ solution[3:]])
    assert len(distances) == n
    return _Fit(solution, distances, errors)


def _solved(matrix: Float, right: Float) -> Float:
    """Solve positive definite equations.

    Raises:
        numpy.linalg.LinAlgError: if the matrix is singular.
    """
    solution = solve_symmetric(matrix, right)
    if not np.isfinite(solution).all():
        raise np.linalg.LinAlgError("the images show too little motion")
    return solution
