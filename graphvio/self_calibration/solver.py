"""Levenberg-Marquardt over the states of a window and the calibration, and the calibration's posterior."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.geometry import so3_exp
from graphvio.linear_algebra import eliminated, solve_rows, solve_symmetric
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.self_calibration.bundle import Eliminated, Tracks, eliminate_landmarks, landmarks_after
from graphvio.self_calibration.evidence import Gaussian
from graphvio.self_calibration.imu_model import PARAMETERS
from graphvio.self_calibration.inertial import InertialSamples, InertialStates, inertial_equations
from graphvio.self_calibration.parameters import PAIR, RigCalibration

_ROBUST_SCALE = 2.5  # scale of the Cauchy cost, in standard deviations
_MAX_STEPS = 25  # far points, by the rig file, may be anywhere at first
_CONVERGED = 0.05  # change of the calibration, in standard deviations of the prior
_LOOSE_ROTATION_SIGMA, _LOOSE_POSITION_SIGMA = np.deg2rad(5.0), 0.3  # priors that hold poses without tracks
_LOOSE_VELOCITY_SIGMA, _LOOSE_GRAVITY_SIGMA = 5.0, 3.0
_LOOSE_SCALE_SIGMA = 5.0  # of distances and velocities: where all points are far, wrong cameras see a wrong scale
_FIXED = 1e-9
_FIRST_DAMPING, _MIN_DAMPING = 1e-6, 1e-9  # shares of the diagonal, of landmarks and of the other unknowns
_MAX_LAST_DAMPING = 1e-5  # with more damping, a small step does not show that this is the minimum
_MAX_DAMPING = 1e2  # beyond it steps change nothing
_LESS_DAMPING, _MORE_DAMPING = 0.1, 100.0  # after a step that lowers the cost, and after one that does not
_MIN_DAMPING_AFTER_A_FAILURE = 1e-4
_ROUNDING = 1e-9  # of the cost, relative
_GRAVITY_NORM_SIGMA = 5e-3


class States(NamedTuple):
    """Unknowns of a window beside the calibration: K keyframes and L landmarks.

    Attributes:
        poses: (K, 4, 4) ``odom_T_body``; the first one is fixed.
        velocities: (K, 3) m/s, frame odom.
        gravity: (3,) m/s^2, frame odom.
        landmarks: (L, 3), in frames that move along with poses, see `landmarks_after`.
    """

    poses: Float
    velocities: Float
    gravity: Float
    landmarks: Float


class Window(NamedTuple):
    """Measurements of a window.

    Attributes:
        tracks: tracks of all pairs and single cameras.
        samples: IMU samples, or None.
    """

    tracks: Tracks
    samples: InertialSamples | None


class Solution(NamedTuple):
    """Result of a window's adjustment.

    Attributes:
        states: adjusted states.
        calibration: posterior of the difference from the nominal calibration.
        window: what was adjusted, with the frames of the adjusted landmarks.
        errors2: (N, 2) squared whitened errors of the tracks, NaN where there is no right image.
        imu_errors2: (K - 1,) squared whitened errors of the IMU, of 9 dimensions, NaN where there is none.
        hessian: Hessian of the cost, over ``[poses 6 K, calibration C, velocities 3 K, gravity 3]``.
        has_converged: whether the last step, with next to no damping, hardly changed the calibration; otherwise the
            solution is no minimum, and is no evidence.
    """

    states: States
    calibration: Gaussian
    window: Window
    errors2: Float
    imu_errors2: Float
    hessian: Float
    has_converged: bool

    def poses_by_cameras(self, n_camera_parameters: int) -> Float:
        """Return the derivatives of the poses with respect to the cameras' parameters, the first ones of all.

        Returns:
            (K, 6, n_camera_parameters) derivatives of the poses' errors in their own frames, while the other unknowns
            follow so that the cost stays minimal.
        """
        n = 6 * len(self.states.poses)
        cameras = np.arange(n, n + n_camera_parameters)
        others = np.r_[6:n, n + n_camera_parameters : len(self.hessian)]
        by_cameras = -solve_rows(self.hessian[np.ix_(others, others)], self.hessian[np.ix_(cameras, others)])
        poses = np.concatenate([np.zeros((n_camera_parameters, 6)), by_cameras[:, : n - 6]], axis=1)
        return np.ascontiguousarray(poses.T).reshape(-1, 6, n_camera_parameters)


class _Linearised(NamedTuple):
    hessian: Float
    gradient: Float
    cost: float
    errors2: Float
    imu_errors2: Float


def solve(window: Window, states: States, nominal: RigCalibration, difference: Float, prior: Gaussian) -> Solution:
    """Adjust a window.

    Args:
        window: measurements.
        states: initial states.
        nominal: calibration of the rig file.
        difference: (C,) initial difference from it: of the cameras, and with an IMU also of its parameters.
        prior: prior of that difference.
    """
    first = states
    found = Eliminated.empty(window.tracks)
    sigmas = np.sqrt(np.diag(prior.covariance))
    damping = _FIRST_DAMPING
    at, damping_at = _linearise(window, states, first, nominal, difference, prior, damping, found), damping
    calibration = slice(6 * len(states.poses), 6 * len(states.poses) + len(difference))
    has_converged = False
    for _ in range(_MAX_STEPS):
        damped = at.hessian + damping * np.diag(np.diag(at.hessian))
        step = -solve_symmetric(damped, at.gradient)
        is_small = damping <= _MAX_LAST_DAMPING and np.abs(step[calibration] / sigmas).max() < _CONVERGED
        following, moved = _moved(window, states, nominal, difference, found, step)
        changed = difference + step[calibration]
        kept = found
        found = Eliminated.empty(window.tracks)
        damping = max(_LESS_DAMPING * damping, _MIN_DAMPING)
        new = _linearise(following, moved, first, nominal, changed, prior, damping, found)
        # Another time offset may take an end of an interval out of the samples: it has no error then, and the cost is
        # less for the wrong reason. Such steps are not taken, and an interval that is gained is not counted.
        loses_intervals = bool((np.isnan(new.imu_errors2) & ~np.isnan(at.imu_errors2)).any())
        cost = new.cost - 0.5 * float(np.nansum(new.imu_errors2[np.isnan(at.imu_errors2)]))
        has_converged = bool(is_small and cost <= (1.0 + _ROUNDING) * at.cost and not loses_intervals)
        if cost <= at.cost and not loses_intervals:
            window, states, difference, at, damping_at = following, moved, changed, new, damping
        else:
            found, damping = kept, max(_MORE_DAMPING * damping, _MIN_DAMPING_AFTER_A_FAILURE)
        if has_converged or damping > _MAX_DAMPING:
            break
    if damping_at > _MIN_DAMPING:  # damped landmarks hold the cameras, as if their attitude in body were known
        found = Eliminated.empty(window.tracks)
        at = _linearise(window, states, first, nominal, difference, prior, _MIN_DAMPING, found)
    posterior = Gaussian(difference, _marginal(at.hessian, calibration))
    return Solution(states, posterior, window, at.errors2, at.imu_errors2, at.hessian, has_converged)


def _linearise(
    window: Window,
    states: States,
    first: States,
    nominal: RigCalibration,
    difference: Float,
    prior: Gaussian,
    damping: float,
    found: Eliminated,
) -> _Linearised:
    """Linearise over ``[poses 6 K, calibration C, velocities 3 K, gravity 3]``, with the landmarks eliminated."""
    n, c, n_camera_parameters = len(states.poses), len(difference), len(nominal.columns)
    size = 6 * n + c + (3 * n + 3 if window.samples is not None else 0)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    cameras, columns = slice(0, 6 * n + n_camera_parameters), _visual_columns(n, nominal)
    visual_size = 6 * n + PAIR * len(nominal.models)
    visual_hessian, visual_gradient = np.zeros((visual_size, visual_size)), np.zeros(visual_size)
    moved = nominal.moved(difference[:n_camera_parameters])
    cost, errors2 = eliminate_landmarks(
        states.poses, moved, states.landmarks, window.tracks, _ROBUST_SCALE, damping,
        visual_hessian, visual_gradient, found,
    )  # fmt: skip
    hessian[cameras, cameras], gradient[cameras] = visual_hessian[np.ix_(columns, columns)], visual_gradient[columns]
    calibration = slice(6 * n, 6 * n + c)
    hessian[calibration, calibration] += prior.information
    gradient[calibration] += prior.information @ (difference - prior.mean)
    cost += prior.cost(difference)
    weights = 1.0 / _loose_pose_sigmas(first.poses) ** 2
    weights[:6] = 1.0 / _FIXED**2
    offsets = np.zeros((n, 6))
    offsets[:, 3:] = np.einsum("kji,kj->ki", states.poses[:, :3, :3], states.poses[:, :3, 3] - first.poses[:, :3, 3])
    poses = np.arange(6 * n)
    hessian[poses, poses] += weights
    gradient[poses[6:]] += (weights * offsets.ravel())[6:]
    cost += 0.5 * float(weights[6:] @ offsets.ravel()[6:] ** 2)
    imu_errors2 = np.zeros(0)
    if window.samples is not None:
        inertial = inertial_equations(
            window.samples,
            InertialStates(states.poses, states.velocities, states.gravity, difference[n_camera_parameters:]),
        )
        at = _inertial_columns(n, c, n_camera_parameters)
        hessian[np.ix_(at, at)] += inertial.hessian
        gradient[at] += inertial.gradient
        cost += inertial.cost + _add_loose(states, first, hessian, gradient, 6 * n + c)
        imu_errors2 = inertial.errors2
    return _Linearised(hessian, gradient, cost, errors2, imu_errors2)


def _visual_columns(n: int, nominal: RigCalibration) -> Int:
    """Return the indices of ``[poses, cameras]`` of K keyframes among the unknowns of `eliminate_landmarks`."""
    return np.concatenate([np.arange(6 * n), 6 * n + nominal.columns])


def _inertial_columns(n: int, c: int, n_camera_parameters: int) -> Int:
    """Return the indices of ``[poses, velocities, gravity, parameters]`` of K keyframes among a window's unknowns."""
    after = 6 * n + c
    return np.concatenate(
        [np.arange(6 * n), np.arange(after, after + 3 * n + 3), 6 * n + n_camera_parameters + np.arange(PARAMETERS)]
    )


def _loose_pose_sigmas(poses: Float) -> Float:
    """Return the standard deviations (6 K,) of a prior of poses (K, 4, 4), weak for them and for their distances."""
    distances = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    positions = _LOOSE_POSITION_SIGMA + _LOOSE_SCALE_SIGMA * distances
    return np.repeat(np.column_stack([np.full(len(poses), _LOOSE_ROTATION_SIGMA), positions]), 3)


def _add_loose(states: States, first: States, hessian: Float, gradient: Float, at: int) -> float:
    """Add a weak prior of velocities and gravity, and a strong one of gravity's norm; return the cost."""
    velocities = np.arange(at, at + states.velocities.size)
    off = (states.velocities - first.velocities).ravel()
    speeds = np.linalg.norm(first.velocities, axis=1)
    weights = 1.0 / np.repeat(_LOOSE_VELOCITY_SIGMA + _LOOSE_SCALE_SIGMA * speeds, 3) ** 2
    hessian[velocities, velocities] += weights
    gradient[velocities] += weights * off
    gravity = np.arange(velocities[-1] + 1, velocities[-1] + 4)
    turned = states.gravity - first.gravity
    norm = float(np.linalg.norm(states.gravity))
    along, excess = states.gravity / norm, norm - GRAVITY_M_S2
    hessian[gravity, gravity] += 1.0 / _LOOSE_GRAVITY_SIGMA**2
    hessian[np.ix_(gravity, gravity)] += np.outer(along, along) / _GRAVITY_NORM_SIGMA**2
    gradient[gravity] += turned / _LOOSE_GRAVITY_SIGMA**2 + along * excess / _GRAVITY_NORM_SIGMA**2
    return float(
        0.5 * weights @ off**2
        + 0.5 * turned @ turned / _LOOSE_GRAVITY_SIGMA**2
        + 0.5 * (excess / _GRAVITY_NORM_SIGMA) ** 2
    )


def _moved(
    window: Window, states: States, nominal: RigCalibration, difference: Float, eliminated: Eliminated, step: Float
) -> tuple[Window, States]:
    """Return the window after a step, with the landmarks' new frames, and the states with the landmarks that follow."""
    n, n_camera_parameters = len(states.poses), len(nominal.columns)
    poses = states.poses.copy()
    for k, of_pose in enumerate(step[: 6 * n].reshape(n, 6)):
        poses[k, :3, 3] += states.poses[k, :3, :3] @ of_pose[3:]
        poses[k, :3, :3] = states.poses[k, :3, :3] @ so3_exp(of_pose[:3].copy())
    of_cameras, columns = np.zeros(6 * n + PAIR * len(nominal.models)), _visual_columns(n, nominal)
    of_cameras[columns] = step[: len(columns)]
    calibration = nominal.moved(difference[:n_camera_parameters])
    landmarks, frames = landmarks_after(
        states.landmarks, window.tracks, calibration, states.poses, poses, eliminated, of_cameras
    )
    following = window._replace(tracks=window.tracks._replace(odom_T_landmark=frames))
    inertial = step[6 * n + len(difference) :]
    if not len(inertial):
        return following, states._replace(poses=poses, landmarks=landmarks)
    velocities, gravity = states.velocities + inertial[: 3 * n].reshape(n, 3), states.gravity + inertial[3 * n :]
    return following, States(poses, velocities, gravity, landmarks)


def _marginal(hessian: Float, kept: slice) -> Float:
    """Return the information of some unknowns, the others eliminated."""
    unknowns = np.arange(len(hessian))
    order = np.concatenate([unknowns[: kept.start], unknowns[kept.stop :], unknowns[kept]])
    return eliminated(hessian[np.ix_(order, order)], kept.stop - kept.start)
