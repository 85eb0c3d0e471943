"""First guess of velocity, gravity and depths in any motion, in metres, from a few keyframes and the IMU between them.

With the rotations of the gyro, each ray to a landmark is one linear equation of the velocity and gravity at the first
keyframe and of the landmark's distance: A. Martinelli, *Closed-form solution of visual-inertial structure from motion*,
IJCV 106(2), 2014. The gyro's bias is the one for which the equations fit best: J. Kaiser et al., *Simultaneous state
initialization and gyroscope bias calibration in visual inertial aided navigation*, RA-L 2(1), 2017.

In metres the equations have an attractive wrong solution: with small distances and no motion all errors are small. A
vehicle that accelerates evenly was taken for one that stands and is tilted. The unit of length is therefore the size
of the motion, the rms of the keyframes' positions, and the length of a metre in this unit is one of the unknowns.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.linear_algebra import cholesky, eigen, product, solve_lower, solve_symmetric
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.monocular.reprojection import Cameras
from graphvio.monocular.structure import Structure
from graphvio.self_calibration.imu_model import PARAMETERS
from graphvio.self_calibration.inertial import InertialSamples
from graphvio.self_calibration.preintegration import preintegrate

_ROUNDS = 8
_BIAS_STEP = 1e-4  # rad/s, step of the numerical derivatives
_MAX_BIAS_STEP = 0.05
_CONVERGED = 5e-3  # rad/s: the adjustment that follows is exact
_ROBUST_SCALE = 3.0  # scale of the Cauchy weights, in medians of the errors
_LENGTH_ROUNDS = 4
_MIN_LANDMARKS = 8
_MIN_DISTANCE = 1e-2  # of a landmark, in units of the motion's size
_BIAS_SIGMA = 0.1  # rad/s, prior of the gyro's bias
_ANGLE_SIGMA = 2e-3  # rad, of a ray: weighs the rays against that prior


class FirstGuess(NamedTuple):
    """Guessed motion of K keyframes, in the body frame of the first of them.

    Attributes:
        poses: (K, 4, 4) poses of body.
        velocities: (K, 3) m/s.
        gravity: (3,) m/s^2, downwards.
        gyro_bias: (3,) rad/s.
    """

    poses: Float
    velocities: Float
    gravity: Float
    gyro_bias: Float


class _Chain(NamedTuple):
    """The IMU integrated since the first keyframe, without gravity and initial velocity.

    These are times (K,) in seconds, rotations (K, 3, 3), velocities (K, 3) m/s and positions (K, 3) m.
    """

    times: Float
    rotations: Float
    velocities: Float
    positions: Float


class _Views(NamedTuple):
    """N views of L landmarks, sorted by landmark; a point that several cameras see is one landmark for each camera.

    Matches between cameras would give the scale, but with a wrong rig file they give a wrong one.
    """

    state: Int  # (N,)
    landmark: Int  # (N,)
    firsts: Int  # (L,) first view of each
    rays: Float  # (N, 3) of unit length, in body
    levers: Float  # (N, 3) m, of the cameras in body
    delays: Float  # (N,) s, from the stamp until a rolling shutter's line is exposed
    weights: Float  # (N,)

    @staticmethod
    def of(structure: Structure, cameras: Cameras) -> _Views:
        """Collect the views of landmarks that a camera sees at least twice."""
        n_cameras = len(cameras.body_T_cam)
        point = np.repeat(np.arange(len(structure.odom_T_landmark)), np.diff(structure.rows))
        _, landmark, counts = np.unique(point * n_cameras + structure.camera, return_inverse=True, return_counts=True)
        rows = np.argsort(landmark, kind="stable")
        rows = rows[counts[landmark[rows]] > 1]
        _, firsts, landmark = np.unique(landmark[rows], return_index=True, return_inverse=True)
        rays = np.column_stack([structure.rays[rows], np.ones(len(rows))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        body_T_cam = cameras.body_T_cam[structure.camera[rows]]
        in_body = np.einsum("nij,nj->ni", body_T_cam[:, :3, :3], rays)
        levers = body_T_cam[:, :3, 3] + structure.readout[rows, 1:]
        delays = structure.readout[rows, 0]
        return _Views(structure.state[rows], landmark, firsts, in_body, levers, delays, np.ones(len(rows)))


class _Equations(NamedTuple):
    """Linear equations of the motion ``[velocity, gravity, length of a metre]`` (7,) and of the distances (L,)."""

    by_motion: Float  # (N, 3, 7)
    by_distance: Float  # (N, 3)
    gain: Float  # (L, 7): the best distances are ``-gain @ motion``
    normal: Float  # (7, 7) of the motion, with the best distances
    length: Float  # (7, 7): ``motion @ length @ motion`` is the mean square of the keyframes' positions


def first_guess(samples: InertialSamples, structure: Structure, cameras: Cameras, gyro_bias: Float) -> FirstGuess:
    """Solve for the motion of the keyframes of ``samples``, which are the states of ``structure``.

    Args:
        samples: IMU samples, and the stamps of the K keyframes.
        structure: landmarks with at least two views.
        cameras: cameras that see them.
        gyro_bias: (3,) rad/s from which the search begins.

    Raises:
        MeasurementError: if the samples do not cover the keyframes.
        numpy.linalg.LinAlgError: if the motion determines nothing.
    """
    views, bias = _Views.of(structure, cameras), gyro_bias.copy()
    if len(views.firsts) < _MIN_LANDMARKS:
        raise np.linalg.LinAlgError("the images show too little motion")
    for k in range(_ROUNDS):
        views = _reweighted(views, _equations(_chain(samples, bias), views))
        step = _bias_step(samples, views, bias, gyro_bias)
        bias = bias + step * min(1.0, _MAX_BIAS_STEP / max(float(np.linalg.norm(step)), 1e-12))
        if k > 0 and np.linalg.norm(step) < _CONVERGED:
            break
    chain = _chain(samples, bias)
    velocity, gravity = _metric_motion(chain, views)
    times = chain.times[:, None]
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = chain.rotations
    poses[:, :3, 3] = times * velocity + 0.5 * times**2 * gravity + chain.positions
    return FirstGuess(poses, velocity + times * gravity + chain.velocities, gravity, bias)


def _reweighted(views: _Views, at: _Equations) -> _Views:
    """Return the views with weights that make errors angles, and let those of mismatches count little."""
    motion = _shortest(at.normal, at.length)
    distances = _distances(at, motion)[views.landmark]
    angles = np.linalg.norm(_errors(at, views, motion), axis=1) / views.weights / distances
    scale = _ROBUST_SCALE * max(float(np.median(angles)), 1e-5)
    return views._replace(weights=1.0 / (distances * (1.0 + (angles / scale) ** 2) ** 0.5))


def _bias_step(samples: InertialSamples, views: _Views, bias: Float, known_bias: Float) -> Float:
    """Return the Gauss-Newton step (3,) rad/s from a gyro bias to the one for which the equations fit best.

    Errors are compared at the same distances: a bias by which all points are nearer would make all errors smaller.
    """

    def fit(bias: Float) -> tuple[Float, Float]:
        at = _equations(_chain(samples, bias), views)
        motion = _shortest(at.normal, at.length)
        return _errors(at, views, motion).ravel(), np.log(_distances(at, motion))

    errors, log_distances = fit(bias)
    jacobian = np.zeros((len(errors), 3))
    for axis in range(3):
        changed, now = fit(bias + _BIAS_STEP * np.eye(3)[axis])
        jacobian[:, axis] = (changed * np.exp(np.median(log_distances - now)) - errors) / _BIAS_STEP
    held = (_ANGLE_SIGMA / _BIAS_SIGMA) ** 2
    normal = product(jacobian.T.copy(), np.column_stack([jacobian, errors]))
    step = solve_symmetric(normal[:, :3] + held * np.eye(3), normal[:, 3] + held * (bias - known_bias))
    if not np.isfinite(step).all():
        raise np.linalg.LinAlgError("the images show too little motion")
    return -step


def _metric_motion(chain: _Chain, views: _Views) -> tuple[Float, Float]:
    """Return velocity (3,) m/s and gravity (3,) m/s^2 with its known norm, in body at the first keyframe."""
    at = _equations(chain, views)

    def motion(gravity: Float, across: Float) -> Float:
        """Return the best motion (7,) whose gravity is the given one, in metres, plus any sum of ``across`` (3, A)."""
        basis = np.zeros((7, 4 + across.shape[1]))
        basis[:3, :3], basis[3:6, 3:-1], basis[3:6, -1], basis[6, -1] = np.eye(3), across, gravity, 1.0
        normal, length = (product(product(basis.T.copy(), each), basis) for each in (at.normal, at.length))
        return np.asarray(np.einsum("jm,m->j", basis, _shortest(normal, length)))

    gravity, found = _shortest(at.normal, at.length)[3:6], []
    for _ in range(_LENGTH_ROUNDS):
        gravity = gravity * (GRAVITY_M_S2 / np.linalg.norm(gravity))
        found.append(motion(gravity, np.zeros((3, 0))))
        gravity = motion(gravity, np.linalg.svd(gravity[None])[2][1:].T)[3:6]
    best = min(found, key=lambda each: float(np.einsum("j,jk,k->", each, at.normal, each)))
    if best[6] == 0.0:
        raise np.linalg.LinAlgError("the images show too little motion")
    return best[:3] / best[6], best[3:6] / best[6]


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


def _equations(chain: _Chain, views: _Views) -> _Equations:
    """Collect the weighted equations of all views, for the rotations of the integrated IMU."""
    k, first, weights = views.state, views.firsts[views.landmark], views.weights[:, None, None]
    rays = np.einsum("nij,nj->ni", chain.rotations[k], views.rays)
    delays, times = views.delays, chain.times[k] + views.delays
    places = chain.positions[k] + delays[:, None] * chain.velocities[k]
    places += np.einsum("nij,nj->ni", chain.rotations[k], views.levers)
    dt, dt2 = times[first] - times, 0.5 * (times[first] ** 2 - times**2)
    across = weights * (np.eye(3) - rays[:, :, None] * rays[:, None, :])
    metre = np.einsum("nij,nj->ni", across, places[first] - places)[:, :, None]
    by_motion = np.concatenate([across * dt[:, None, None], across * dt2[:, None, None], metre], axis=2)
    by_distance = np.einsum("nij,nj->ni", across, rays[first])

    def of_landmarks(values: Float) -> Float:
        return np.asarray(np.add.reduceat(values, views.firsts, axis=0))

    gain = of_landmarks(np.einsum("nij,ni->nj", by_motion, by_distance))
    own = of_landmarks((by_distance**2).sum(axis=1))[:, None] + 1e-12
    normal = np.einsum("nij,nik->jk", by_motion, by_motion) - product((gain / own).T.copy(), gain)
    times = chain.times[:, None, None] * np.eye(3)
    positions = np.concatenate([times, 0.5 * chain.times[:, None, None] * times, chain.positions[:, :, None]], axis=2)
    length = np.einsum("kij,kim->jm", positions, positions) / len(positions)
    return _Equations(by_motion, by_distance, gain / own, normal, length)


def _distances(at: _Equations, motion: Float) -> Float:
    """Return the absolute distances (L,) of the landmarks that fit a motion (7,) best, at least `_MIN_DISTANCE`."""
    return np.asarray(np.maximum(np.abs(np.einsum("lj,j->l", at.gain, motion)), _MIN_DISTANCE))


def _errors(at: _Equations, views: _Views, motion: Float) -> Float:
    """Return the weighted errors (N, 3) of a motion (7,)."""
    distances = -np.einsum("lj,j->l", at.gain, motion)[views.landmark]
    return np.asarray(np.einsum("nij,j->ni", at.by_motion, motion) + at.by_distance * distances[:, None])


def _shortest(matrix: Float, norm: Float) -> Float:
    """Return the vector x (M,), its last element not negative, with least ``x matrix x`` where ``x norm x = 1``.

    Raises:
        numpy.linalg.LinAlgError: if there is none.
    """
    lower = cholesky(matrix + 1e-12 * np.trace(matrix) * np.eye(len(matrix)))
    whitened = solve_lower(lower, solve_lower(lower, norm).T.copy())
    if not np.isfinite(whitened).all():
        raise np.linalg.LinAlgError("the images show too little motion")
    values, vectors = eigen(0.5 * (whitened + whitened.T))
    largest = int(np.argmax(values))
    if not values[largest] > 0.0:
        raise np.linalg.LinAlgError("the images show too little motion")
    upper_inverse = solve_lower(lower, np.eye(len(matrix)))
    shortest = product(upper_inverse, vectors[:, largest : largest + 1].copy())[:, 0] / np.sqrt(values[largest])
    return np.asarray(shortest * np.copysign(1.0, shortest[-1]))
