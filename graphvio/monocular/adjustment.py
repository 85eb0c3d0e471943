"""Nonlinear least squares of a window's states: reprojection errors, the IMU between states, and the window's prior."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.linear_algebra import cholesky, product, solve_lower, solve_rows, solve_symmetric, times
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.monocular.equations import visual_equations
from graphvio.monocular.reprojection import Cameras
from graphvio.monocular.states import (
    BIASES,
    GRAVITY,
    States,
    add_block,
    inertial_columns,
    visual_columns,
)
from graphvio.monocular.structure import PRIOR_INFORMATION, Eliminated, Structure, landmarks_after, located
from graphvio.monocular.window_prior import Prior, add_prior
from graphvio.self_calibration.evidence import Evidence, Gaussian
from graphvio.self_calibration.inertial import InertialSamples, InertialStates, inertial_equations

ROBUST_SCALE = 2.5  # scale of the Cauchy cost, in standard deviations
_CONVERGED = 1e-3  # see `adjust`: for windows that no later frameset improves
_DAMPING = 1e-8  # at first, as a share of the diagonal; with more, a step does not go all the way to the solution
_GRAVITY_NORM_SIGMA = 0.02
ZERO_VELOCITY_SIGMA = 0.01


class Measurements(NamedTuple):
    """Measurements of a window.

    Attributes:
        cameras: cameras of the rig file.
        structure: views of landmarks.
        sigma_px: noise of a corner's position.
        samples: IMU samples, whose keyframes are the states.
        stationary: (S,) indices of the states at which the rig does not move.
        depth_information: information of a landmark's prior inverse depth, m^2.
    """

    cameras: Cameras
    structure: Structure
    sigma_px: float
    samples: InertialSamples
    stationary: Int
    depth_information: float = PRIOR_INFORMATION


class Equations(NamedTuple):
    """Normal equations of all unknowns; a step is ``-solve(hessian, gradient)``."""

    hessian: Float
    gradient: Float
    cost: float
    errors2: Float
    imu_errors2: Float
    eliminated: Eliminated


class Adjusted(NamedTuple):
    """Result of an adjustment.

    Attributes:
        states: adjusted states.
        landmarks: (L, 3) adjusted landmarks.
        measured: what was adjusted, with the frames that the landmarks are in now.
        equations: normal equations at these states and landmarks.
    """

    states: States
    landmarks: Float
    measured: Measurements
    equations: Equations


def equations(
    measured: Measurements, states: States, landmarks: Float, prior: Prior | None, file: Gaussian | None = None
) -> Equations:
    """Linearise all errors of a window.

    Args:
        measured: measurements of the window.
        states: K states.
        landmarks: (L, 3).
        prior: prior of states from before the window, or None.
        file: prior of the calibration by the rig file and epochs before, where it is unknown; None where the
            calibration is taken as known.
    """
    n, n_free = len(states.poses), 0 if file is None else len(states.calibration)
    n_camera_parameters = states.n_camera_parameters
    eliminated = Eliminated.empty(measured.structure, n_camera_parameters if n_free else 0)
    visual_hessian, visual_gradient, cost, errors2 = visual_equations(
        states.poses, states.falls, states.cameras(measured.cameras), landmarks, measured.structure,
        measured.sigma_px, measured.depth_information, ROBUST_SCALE, eliminated,
    )  # fmt: skip
    inertial = inertial_equations(
        measured.samples, InertialStates(states.poses, states.velocities, states.gravity, states.parameters)
    )
    known = 9 * n + GRAVITY + BIASES
    hessian, gradient = np.zeros((known + n_free, known + n_free)), np.zeros(known + n_free)
    of_imu, of_views = inertial_columns(n, n_camera_parameters, n_free), visual_columns(n, n_camera_parameters, n_free)
    add_block(hessian, of_imu, inertial.hessian)
    gradient[of_imu] = inertial.gradient[: len(of_imu)]
    add_block(hessian, of_views, visual_hessian)
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
        cost += add_prior(prior, states, n_free, hessian, gradient)
    if file is not None:
        away = states.calibration - file.mean
        pull = times(file.information, away)
        hessian[known:, known:] += file.information
        gradient[known:] += pull
        cost += 0.5 * float((away * pull).sum())
    return Equations(hessian, gradient, cost, errors2, inertial.errors2, eliminated)


def adjust(
    measured: Measurements,
    states: States,
    landmarks: Float,
    prior: Prior | None,
    max_steps: int,
    file: Gaussian | None = None,
    converged: float = _CONVERGED,
) -> Adjusted:
    """Minimise all errors of a window by Levenberg-Marquardt.

    Args:
        measured: measurements of the window.
        states: K initial states.
        landmarks: (L, 3) initial landmarks.
        prior: prior of states from before the window, or None.
        max_steps: largest number of steps.
        file: prior of the calibration, or None, as in `equations`.
        converged: squared distance of all unknowns from the solution, in standard deviations, below which no step
            follows.

    Raises:
        numpy.linalg.LinAlgError: if the equations have no solution.
    """
    cameras, n = states.cameras(measured.cameras), len(states.poses)
    landmarks = located(
        states.poses, states.falls, cameras, landmarks, measured.structure, measured.sigma_px,
        measured.depth_information, False,
    )  # fmt: skip
    at = equations(measured, states, landmarks, prior, file)
    damping = _DAMPING
    for _ in range(max_steps):
        damped, diagonal = at.hessian.copy(), np.diag(at.hessian)
        np.fill_diagonal(damped, diagonal + damping * diagonal)
        step = -solve_symmetric(damped, at.gradient)
        if not np.isfinite(step).all():
            raise np.linalg.LinAlgError("the window's solution is not finite")
        if damping <= _DAMPING and float(-step @ at.gradient) < converged:
            break
        moved = states.moved(step)
        of_views = step[visual_columns(n, states.n_camera_parameters, len(step) - 9 * n - GRAVITY - BIASES)]
        shifted, frames = landmarks_after(
            landmarks, measured.structure, states.cameras(measured.cameras), states.poses, moved.poses, at.eliminated,
            of_views,
        )  # fmt: skip
        following = measured._replace(structure=measured.structure._replace(odom_T_landmark=frames))
        new = equations(following, moved, shifted, prior, file)
        loses_intervals = bool((np.isnan(new.imu_errors2) & ~np.isnan(at.imu_errors2)).any())
        if new.cost <= at.cost and not loses_intervals:
            states, landmarks, at, measured = moved, shifted, new, following
            damping = max(0.1 * damping, 1e-9)
        else:
            damping = max(100.0 * damping, 1e-5)
    return Adjusted(states, landmarks, measured, at)


def evidence_of(at: Equations, states: States, file: Gaussian) -> Evidence:
    """Return the evidence of a window about the calibration, from equations in which the calibration is unknown.

    Args:
        at: equations at the states.
        states: adjusted states.
        file: prior by the rig file and epochs before: it is in the equations, and not in the evidence.
    """
    hessian, n_free = at.hessian.copy(), len(file.mean)
    known = len(hessian) - n_free
    hessian[known:, known:] -= file.information
    gradient = at.gradient.copy()
    gradient[known:] -= times(file.information, states.calibration - file.mean)
    gain = solve_rows(hessian[:known, :known], hessian[known:, :known].copy())
    information = hessian[known:, known:] - product(gain, hessian[:known, known:].copy())
    information = 0.5 * (information + information.T)
    pull = gradient[known:] - times(gain, gradient[:known])
    return Evidence(information, times(information, states.calibration) - pull)


def views_only(
    cameras: Cameras, structure: Structure, sigma_px: float, states: States, landmarks: Float
) -> tuple[Float, Float]:
    """Return the reprojection errors alone as a quadratic cost of the poses, with the landmarks eliminated.

    Args:
        cameras: cameras, with the calibration that is in force.
        structure: views of the landmarks.
        sigma_px: noise of a corner's position.
        states: K states.
        landmarks: (L, 3) initial landmarks; the best ones for these poses are found first.

    Returns:
        Information (6 K, 6 K) and gradient (6 K,).
    """
    landmarks = located(states.poses, states.falls, cameras, landmarks, structure, sigma_px, PRIOR_INFORMATION, True)
    information, gradient, _, _ = visual_equations(
        states.poses,
        states.falls,
        cameras,
        landmarks,
        structure,
        sigma_px,
        PRIOR_INFORMATION,
        ROBUST_SCALE,
        Eliminated.empty(structure),
    )
    return information, gradient


def covariance_of(hessian: Float, unknowns: Int) -> Float:
    """Return the joint covariance of some unknowns, from the Hessian of all.

    Raises:
        numpy.linalg.LinAlgError: if the Hessian is not positive definite.
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
