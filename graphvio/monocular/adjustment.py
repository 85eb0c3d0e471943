"""Adjustment of the states of a window: reprojection errors, the IMU between states, and what left the window before.

Unknowns are ``[poses 6 K, velocities 3 K, gravity 3, gyro and accelerometer bias 6, calibration F]`` of K states; the
landmarks are eliminated. Biases and calibration are the same in the whole window; they walk when a state leaves it. The
calibration is ``[cameras C * SINGLE, IMU without its biases 19]``, see `graphvio.self_calibration.parameters`: the
difference from the rig file, which is unknown, or taken for zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.geometry import so3_exp, so3_log
from graphvio.linear_algebra import cholesky, product, solve_lower, solve_rows, solve_symmetric
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.measurements.window_views import FirstWindow
from graphvio.monocular.structure import (
    Cameras,
    Eliminated,
    Structure,
    landmarks_after,
    located,
    visual_equations,
)
from graphvio.self_calibration.evidence import Evidence
from graphvio.self_calibration.imu_model import PARAMETERS
from graphvio.self_calibration.inertial import InertialSamples, InertialStates, inertial_equations

BIASES, GRAVITY = 6, 3
_OTHER_IMU = PARAMETERS - BIASES
_ROBUST_SCALE = 2.5  # of the Cauchy cost, in standard deviations
_CONVERGED = 1e-4  # radians, metres, m/s
_MIN_GAIN = 1e-2  # of the cost, by a step where the calibration is unknown, whose parameters have other units
_GRAVITY_NORM_SIGMA = 0.02
ZERO_VELOCITY_SIGMA = 0.01


@dataclass(frozen=True, eq=False)
class States:
    """K states of a window, in time order.

    Attributes:
        stamps_ns: (K,).
        poses: (K, 4, 4) ``odom_T_body``.
        velocities: (K, 3) m/s, frame odom.
        gravity: (3,) m/s^2, frame odom, downwards.
        biases: (6,) of gyro, rad/s, and accelerometer, m/s^2.
        calibration: (F,) difference from the rig file; empty where it is not estimated.
    """

    stamps_ns: Int
    poses: Float
    velocities: Float
    gravity: Float
    biases: Float
    calibration: Float = field(default_factory=lambda: np.zeros(0))

    @property
    def parameters(self) -> Float:
        """Parameters (25,) of the IMU, see `graphvio.self_calibration.imu_model`."""
        other = self.calibration[-_OTHER_IMU:] if len(self.calibration) else np.zeros(_OTHER_IMU)
        return np.concatenate([self.biases, other])

    @property
    def n_cameras(self) -> int:
        """Number of the cameras' parameters."""
        return max(len(self.calibration) - _OTHER_IMU, 0)

    def cameras(self, of_file: Cameras) -> Cameras:
        """Return the cameras, from those of the rig file."""
        return of_file.moved(self.calibration[: self.n_cameras]) if self.calibration.any() else of_file

    def of(self, kept: Int) -> States:
        """Return some of the states, by their indices."""
        return replace(self, stamps_ns=self.stamps_ns[kept], poses=self.poses[kept], velocities=self.velocities[kept])

    def moved(self, step: Float) -> States:
        """Return the states after a step of all unknowns, or of all but the calibration."""
        n = len(self.poses)
        poses = self.poses.copy()
        for pose, of_pose in zip(poses, step[: 6 * n].reshape(n, 6), strict=True):
            pose[:3, 3] += pose[:3, :3] @ of_pose[3:]
            pose[:3, :3] = pose[:3, :3] @ so3_exp(of_pose[:3].copy())
        velocities = step[6 * n : 9 * n].reshape(n, 3)
        gravity, biases, calibration = np.split(step[9 * n :], [GRAVITY, GRAVITY + BIASES])
        return replace(
            self,
            poses=poses,
            velocities=self.velocities + velocities,
            gravity=self.gravity + gravity,
            biases=self.biases + biases,
            calibration=self.calibration + calibration if len(calibration) else self.calibration,
        )

    def since(self, other: States) -> Float:
        """Return the difference of all unknowns from other values of the same states."""
        n = len(self.poses)
        difference = np.empty(9 * n + GRAVITY + BIASES + len(self.calibration))
        for k in range(n):
            then_R_odom = other.poses[k, :3, :3].T
            difference[6 * k : 6 * k + 3] = so3_log(np.ascontiguousarray(then_R_odom @ self.poses[k, :3, :3]))
            difference[6 * k + 3 : 6 * k + 6] = then_R_odom @ (self.poses[k, :3, 3] - other.poses[k, :3, 3])
        difference[6 * n : 9 * n] = (self.velocities - other.velocities).ravel()
        common = (self.gravity - other.gravity, self.biases - other.biases, self.calibration - other.calibration)
        difference[9 * n :] = np.concatenate(common)
        return difference


class Prior(NamedTuple):
    """What is known of the first states of a window, of gravity, of the biases, and by them of the calibration.

    Attributes:
        at: the m states at which it was linearised.
        information: (9 m + 9 + F, 9 m + 9 + F).
        gradient: (9 m + 9 + F,) of the cost at these.
    """

    at: States
    information: Float
    gradient: Float


class Measurements(NamedTuple):
    """Measurements of a window.

    Attributes:
        cameras: of the rig file.
        structure: views of landmarks.
        sigma_px: noise of a corner's position.
        samples: of the IMU, whose keyframes are the states.
        stationary: (K,) of states, which do not move.
    """

    cameras: Cameras
    structure: Structure
    sigma_px: float
    samples: InertialSamples
    stationary: Int


class Equations(NamedTuple):
    """Normal equations of all unknowns; a step is ``-solve(hessian, gradient)``."""

    hessian: Float
    gradient: Float
    cost: float
    errors2: Float
    imu_errors2: Float
    eliminated: Eliminated


class Adjusted(NamedTuple):
    """The outcome of an adjustment.

    Attributes:
        states: adjusted.
        landmarks: (L, 3).
        equations: at these.
    """

    states: States
    landmarks: Float
    equations: Equations


def equations(
    measured: Measurements, states: States, landmarks: Float, prior: Prior | None, file: Float | None = None
) -> Equations:
    """Linearise all errors of a window.

    Args:
        measured: in the window.
        states: K of them.
        landmarks: (L, 3).
        prior: from before the window.
        file: (F, F) information of the rig file on the calibration, which is unknown then; None where the calibration
            is taken for known.
    """
    n, n_cameras, n_free = len(states.poses), states.n_cameras, 0 if file is None else len(states.calibration)
    eliminated = Eliminated.empty(measured.structure, n_cameras if n_free else 0)
    visual_hessian, visual_gradient, cost, errors2 = visual_equations(
        states.poses, states.cameras(measured.cameras), landmarks, measured.structure, measured.sigma_px,
        _ROBUST_SCALE, eliminated,
    )  # fmt: skip
    inertial = inertial_equations(
        measured.samples, InertialStates(states.poses, states.velocities, states.gravity, states.parameters)
    )
    known = 9 * n + GRAVITY + BIASES
    hessian, gradient = np.zeros((known + n_free, known + n_free)), np.zeros(known + n_free)
    of_imu, of_views = _inertial_columns(n, n_cameras, n_free), _visual_columns(n, n_cameras, n_free)
    hessian[np.ix_(of_imu, of_imu)] = inertial.hessian[: len(of_imu), : len(of_imu)]
    gradient[of_imu] = inertial.gradient[: len(of_imu)]
    hessian[np.ix_(of_views, of_views)] += visual_hessian
    gradient[of_views] += visual_gradient
    cost += inertial.cost
    for k in measured.stationary:
        at = 6 * n + 3 * int(k) + np.arange(3)
        hessian[at, at] += 1.0 / ZERO_VELOCITY_SIGMA**2
        gradient[at] += states.velocities[k] / ZERO_VELOCITY_SIGMA**2
        cost += 0.5 * float(states.velocities[k] @ states.velocities[k]) / ZERO_VELOCITY_SIGMA**2
    norm = float(np.linalg.norm(states.gravity))
    along, excess = states.gravity / norm, norm - GRAVITY_M_S2
    of_gravity = slice(9 * n, 9 * n + GRAVITY)
    hessian[of_gravity, of_gravity] += np.outer(along, along) / _GRAVITY_NORM_SIGMA**2
    gradient[of_gravity] += along * excess / _GRAVITY_NORM_SIGMA**2
    cost += 0.5 * (excess / _GRAVITY_NORM_SIGMA) ** 2
    if prior is not None:
        m = len(prior.at.poses)
        off = states.of(np.arange(m)).since(prior.at)
        columns = _columns(n, np.arange(m), n_free)
        pull = _times(prior.information, off)
        size = len(columns)
        hessian[np.ix_(columns, columns)] += prior.information[:size, :size]
        gradient[columns] += (prior.gradient + pull)[:size]
        cost += float((prior.gradient * off + 0.5 * off * pull).sum())
    if file is not None:
        pull = _times(file, states.calibration)
        hessian[known:, known:] += file
        gradient[known:] += pull
        cost += 0.5 * float((states.calibration * pull).sum())
    return Equations(hessian, gradient, cost, errors2, inertial.errors2, eliminated)


def adjust(
    measured: Measurements,
    states: States,
    landmarks: Float,
    prior: Prior | None,
    max_steps: int,
    file: Float | None = None,
) -> Adjusted:
    """Minimise all errors of a window by Levenberg and Marquardt; arguments are those of `equations`.

    Raises:
        numpy.linalg.LinAlgError: if the equations have no solution.
    """
    cameras, n = states.cameras(measured.cameras), len(states.poses)
    landmarks = located(states.poses, cameras, landmarks, measured.structure, measured.sigma_px, False)
    at = equations(measured, states, landmarks, prior, file)
    damping = 1e-8
    for _ in range(max_steps):
        diagonal = np.diag(np.diag(at.hessian))
        step = -solve_symmetric(at.hessian + damping * diagonal, at.gradient)
        if not np.isfinite(step).all():
            raise np.linalg.LinAlgError("the window's solution is not finite")
        moved = states.moved(step)
        of_views = step[_visual_columns(n, states.n_cameras, len(step) - 9 * n - GRAVITY - BIASES)]
        shifted = landmarks_after(landmarks, measured.structure, at.eliminated, of_views, n)
        new = equations(measured, moved, shifted, prior, file)
        loses_intervals = bool((np.isnan(new.imu_errors2) & ~np.isnan(at.imu_errors2)).any())
        if new.cost <= at.cost and not loses_intervals:
            gained = at.cost - new.cost
            states, landmarks, at = moved, shifted, new
            damping = max(0.1 * damping, 1e-9)
            if np.abs(step).max() < _CONVERGED or (file is not None and gained < _MIN_GAIN):
                break
        else:
            damping = max(100.0 * damping, 1e-5)
    return Adjusted(states, landmarks, at)


def evidence_of(at: Equations, states: States, file: Float) -> Evidence:
    """Return what a window says of the calibration, from equations for which that is unknown.

    Args:
        at: equations at the states.
        states: adjusted.
        file: (F, F) information of the rig file that is in the equations, and not in the evidence.
    """
    hessian, n_free = at.hessian.copy(), len(file)
    known = len(hessian) - n_free
    hessian[known:, known:] -= file
    gradient = at.gradient.copy()
    gradient[known:] -= _times(file, states.calibration)
    gain = solve_rows(hessian[:known, :known], hessian[known:, :known].copy())
    information = hessian[known:, known:] - product(gain, hessian[:known, known:].copy())
    information = 0.5 * (information + information.T)
    pull = gradient[known:] - _times(gain, gradient[:known])
    return Evidence(information, _times(information, states.calibration) - pull)


def views_only(
    cameras: Cameras, structure: Structure, sigma_px: float, states: States, landmarks: Float
) -> tuple[Float, Float]:
    """Linearise what views alone say of the poses, for any places of the landmarks.

    Args:
        cameras: with the calibration that is in force.
        structure: of the views.
        sigma_px: noise of a corner's position.
        states: K of them.
        landmarks: (L, 3), from which their best places for these poses are found.

    Returns:
        Information (6 K, 6 K) and gradient (6 K,).
    """
    landmarks = located(states.poses, cameras, landmarks, structure, sigma_px, True)
    information, gradient, _, _ = visual_equations(
        states.poses, cameras, landmarks, structure, sigma_px, _ROBUST_SCALE, Eliminated.empty(structure)
    )
    return information, gradient


def without_first(measured: Measurements, states: States, landmarks: Float, prior: Prior | None, walk: Float) -> Prior:
    """Eliminate the first state of a window, with the landmarks that it sees.

    Args:
        measured: with the landmarks that the first state sees, and no others.
        states: all K of the window.
        landmarks: (L, 3).
        prior: until now.
        walk: (6 + F, 6 + F) lower Cholesky factor of the covariance of what biases and calibration change until the
            second state.

    Returns:
        What is known of the other states.

    Raises:
        numpy.linalg.LinAlgError: if nothing determines the first state.
    """
    n, n_cameras, n_free = len(states.poses), states.n_cameras, len(states.calibration)
    eliminated = Eliminated.empty(measured.structure, n_cameras)
    visual_hessian, visual_gradient, _, _ = visual_equations(
        states.poses, states.cameras(measured.cameras), landmarks, measured.structure, measured.sigma_px,
        _ROBUST_SCALE, eliminated,
    )  # fmt: skip
    size = 9 * n + GRAVITY + BIASES + n_free
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    of_views = _visual_columns(n, n_cameras, n_free)
    hessian[np.ix_(of_views, of_views)] += visual_hessian
    gradient[of_views] += visual_gradient
    if n > 1:
        two = states.of(np.arange(2))
        first = measured.samples._replace(keyframes_ns=measured.samples.keyframes_ns[:2])
        inertial = inertial_equations(first, InertialStates(two.poses, two.velocities, two.gravity, two.parameters))
        of_two = _columns(n, np.arange(2), n_free)
        columns = of_two[_inertial_columns(2, n_cameras, n_free)]
        known = len(columns)
        hessian[np.ix_(columns, columns)] += inertial.hessian[:known, :known]
        gradient[columns] += inertial.gradient[:known]
    if 0 in measured.stationary:
        at = 6 * n + np.arange(3)
        hessian[at, at] += 1.0 / ZERO_VELOCITY_SIGMA**2
        gradient[at] += states.velocities[0] / ZERO_VELOCITY_SIGMA**2
    if prior is not None:
        m = len(prior.at.poses)
        off = states.of(np.arange(m)).since(prior.at)
        columns = _columns(n, np.arange(m), n_free)
        hessian[np.ix_(columns, columns)] += prior.information
        gradient[columns] += prior.gradient + _times(prior.information, off)
    leaving, kept = _columns(n, np.arange(1))[:9], _columns(n, np.arange(1, n), n_free)
    gain = solve_rows(hessian[np.ix_(leaving, leaving)], hessian[np.ix_(kept, leaving)])
    if not np.isfinite(gain).all():
        raise np.linalg.LinAlgError("the window's first state is not determined")
    information = hessian[np.ix_(kept, kept)] - product(gain, hessian[np.ix_(leaving, kept)])
    pulled = gradient[kept] - _times(gain, gradient[leaving])
    information, pulled = _walked(information, pulled, walk)
    return Prior(states.of(np.arange(1, n)), 0.5 * (information + information.T), pulled)


def first_window(prior: Prior) -> FirstWindow:
    """Return what a prior says of poses, gravity, biases and the first velocity: of others it says nothing."""
    n = len(prior.at.poses)
    chosen = np.concatenate([np.arange(6 * n + 3), np.arange(9 * n, 9 * n + GRAVITY + BIASES)])
    return FirstWindow(
        prior.at.stamps_ns, prior.at.poses, prior.at.velocities[0], prior.at.gravity, prior.at.biases,
        prior.information[np.ix_(chosen, chosen)], prior.gradient[chosen],
    )  # fmt: skip


def _walked(information: Float, gradient: Float, walk: Float) -> tuple[Float, Float]:
    """Let the last unknowns, biases and calibration, walk: by a lower Cholesky factor of their covariance.

    The change is an unknown of its own, which is eliminated; it has zero mean and, in these units, unit covariance.
    """
    size = len(walk)
    by_change = product(np.ascontiguousarray(information[:, -size:]), walk)
    of_change = product(np.ascontiguousarray(walk.T), np.ascontiguousarray(by_change[-size:])) + np.eye(size)
    gain = solve_rows(of_change, by_change)
    pull = _times(walk.T, gradient[-size:])
    return information - product(gain, np.ascontiguousarray(by_change.T)), gradient - _times(gain, pull)


def first_prior(states: States, bias_sigmas: Float, biases: Float, pose_sigmas: Float) -> Prior:
    """Return what is known of a window's first state: its pose defines the frame; and of the biases."""
    first, calibration = replace(states.of(np.arange(1)), biases=biases), np.zeros(len(states.calibration))
    information = np.diag(np.concatenate([1.0 / pose_sigmas**2, np.zeros(6), 1.0 / bias_sigmas**2, calibration]))
    return Prior(first, information, np.zeros(len(information)))


def covariance_of(hessian: Float, unknowns: Int) -> Float:
    """Return the joint covariance of some unknowns, from the Hessian of all.

    Raises:
        numpy.linalg.LinAlgError: if it is not positive definite.
    """
    chosen = np.zeros((len(unknowns), len(hessian)))
    chosen[np.arange(len(unknowns)), unknowns] = 1.0
    whitened = solve_lower(cholesky(hessian), chosen)
    if not np.isfinite(whitened).all():
        raise np.linalg.LinAlgError("the window's equations determine no covariance")
    return product(whitened, whitened.T.copy())


def scale_sigma(states: States, hessian: Float) -> float:
    """Return the standard deviation of the scale of the positions, as a share, from the Hessian of all unknowns."""
    n = len(states.poses)
    centred = states.poses[:, :3, 3] - states.poses[:, :3, 3].mean(axis=0)
    along = np.zeros(6 * n)
    for k in range(n):  # the perturbation is in body's axes
        along[6 * k + 3 : 6 * k + 6] = states.poses[k, :3, :3].T @ centred[k]
    size2 = float((centred**2).sum())
    covariance = covariance_of(hessian, np.arange(6 * n))
    return float(np.sqrt(along @ covariance @ along)) / max(size2, 1e-12)


def _times(matrix: Float, vector: Float) -> Float:
    """Multiply in a fixed order: a library's last digits depend on where arrays lie in memory."""
    return product(np.ascontiguousarray(matrix), vector.reshape(-1, 1))[:, 0]


def _columns(n: int, states: Int, n_free: int = 0) -> Int:
    """Return where ``[poses, velocities, gravity, biases, calibration]`` of some of n states are among all unknowns."""
    poses = (6 * states[:, None] + np.arange(6)).ravel()
    velocities = (6 * n + 3 * states[:, None] + np.arange(3)).ravel()
    return np.concatenate([poses, velocities, 9 * n + np.arange(GRAVITY + BIASES + n_free)])


def _inertial_columns(n: int, n_cameras: int, n_free: int) -> Int:
    """Return where the unknowns of `inertial_equations` are; where the calibration is known, of all but its last."""
    known = 9 * n + GRAVITY + BIASES
    return np.concatenate([np.arange(known), np.arange(known + n_cameras, known + n_free)])


def _visual_columns(n: int, n_cameras: int, n_free: int) -> Int:
    """Return where the unknowns of `visual_equations` are: poses, and cameras unless the calibration is known."""
    known = 9 * n + GRAVITY + BIASES
    return np.concatenate([np.arange(6 * n), known + np.arange(n_cameras if n_free else 0)])
