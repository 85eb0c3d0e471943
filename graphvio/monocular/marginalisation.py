"""Marginalisation of a window's first state, with the landmarks that it sees, into a prior of the other states."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.linear_algebra import product, solve_rows, times
from graphvio.measurements.window_views import FirstWindow
from graphvio.monocular.adjustment import ROBUST_SCALE, ZERO_VELOCITY_SIGMA, Measurements
from graphvio.monocular.equations import visual_equations
from graphvio.monocular.states import (
    BIASES,
    GRAVITY,
    States,
    add_block,
    columns_of,
    inertial_columns,
    visual_columns,
)
from graphvio.monocular.structure import Eliminated
from graphvio.monocular.window_prior import Prior, add_prior
from graphvio.self_calibration.inertial import InertialStates, inertial_equations


def without_first(measured: Measurements, states: States, landmarks: Float, prior: Prior | None, walk: Float) -> Prior:
    """Eliminate the first state of a window, with the landmarks that it sees.

    Args:
        measured: measurements with the landmarks that the first state sees, and no others.
        states: all K states of the window.
        landmarks: (L, 3).
        prior: prior of the window until now, or None.
        walk: (6 + F, 6 + F) lower Cholesky factor of the covariance by which biases and calibration change until the
            second state.

    Returns:
        The prior of the other states.

    Raises:
        numpy.linalg.LinAlgError: if nothing determines the first state.
    """
    n, n_camera_parameters, n_free = len(states.poses), states.n_camera_parameters, len(states.calibration)
    hessian, gradient, _ = _linearised(measured, states, landmarks, prior, n_free)
    if n > 1:
        two = states.of(np.arange(2))
        first = measured.samples._replace(keyframes_ns=measured.samples.keyframes_ns[:2])
        inertial = inertial_equations(first, InertialStates(two.poses, two.velocities, two.gravity, two.parameters))
        of_two = columns_of(n, np.arange(2), n_free)
        columns = of_two[inertial_columns(2, n_camera_parameters, n_free)]
        add_block(hessian, columns, inertial.hessian)
        gradient[columns] += inertial.gradient[: len(columns)]
    if 0 in measured.stationary:
        at = 6 * n + np.arange(3)
        hessian[at, at] += 1.0 / ZERO_VELOCITY_SIGMA**2
        gradient[at] += states.velocities[0] / ZERO_VELOCITY_SIGMA**2
    leaving, kept = columns_of(n, np.arange(1))[:9], columns_of(n, np.arange(1, n), n_free)
    gain = solve_rows(hessian[np.ix_(leaving, leaving)], hessian[np.ix_(kept, leaving)])
    if not np.isfinite(gain).all():
        raise np.linalg.LinAlgError("the window's first state is not determined")
    information = hessian[np.ix_(kept, kept)] - product(gain, hessian[np.ix_(leaving, kept)])
    pulled = gradient[kept] - times(gain, gradient[leaving])
    information, pulled = _walked(information, pulled, walk)
    return Prior(states.of(np.arange(1, n)), 0.5 * (information + information.T), pulled)


def with_landmarks(
    measured: Measurements, states: States, landmarks: Float, prior: Prior | None, calibrates: bool
) -> tuple[Prior, Eliminated]:
    """Add the views of some landmarks to the prior of a window's states, linearised at these states.

    Args:
        measured: measurements with these landmarks, and no others.
        states: all states of the window.
        landmarks: (L, 3).
        prior: prior from before the window, or None.
        calibrates: whether the calibration is unknown.

    Returns:
        The prior with these views, and the terms of the elimination that move these landmarks along with the states.
    """
    n_free = len(states.calibration) if calibrates else 0
    hessian, gradient, eliminated = _linearised(measured, states, landmarks, prior, n_free)
    return Prior(states, hessian, gradient), eliminated


def first_window(prior: Prior) -> FirstWindow:
    """Return a prior's information on poses, gravity, biases and the first velocity, with the calibration as known.

    A prior has no information on other velocities.
    """
    n = len(prior.at.poses)
    chosen = np.concatenate([np.arange(6 * n + 3), np.arange(9 * n, 9 * n + GRAVITY + BIASES)])
    return FirstWindow(
        prior.at.stamps_ns, prior.at.poses, prior.at.velocities[0], prior.at.gravity, prior.at.biases,
        prior.information[np.ix_(chosen, chosen)], prior.gradient[chosen],
    )  # fmt: skip


def _linearised(
    measured: Measurements, states: States, landmarks: Float, prior: Prior | None, n_free: int
) -> tuple[Float, Float, Eliminated]:
    """Linearise the views and the prior, with ``n_free`` parameters of the calibration as unknowns: F, or none."""
    n, n_camera_parameters = len(states.poses), states.n_camera_parameters
    eliminated = Eliminated.empty(measured.structure, n_camera_parameters if n_free else 0)
    visual_hessian, visual_gradient, _, _ = visual_equations(
        states.poses, states.falls, states.cameras(measured.cameras), landmarks, measured.structure,
        measured.sigma_px, measured.depth_information, ROBUST_SCALE, eliminated,
    )  # fmt: skip
    size = 9 * n + GRAVITY + BIASES + len(states.calibration)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    of_views = visual_columns(n, n_camera_parameters, n_free)
    add_block(hessian, of_views, visual_hessian)
    gradient[of_views] += visual_gradient
    if prior is not None:
        add_prior(prior, states, n_free, hessian, gradient)
    return hessian, gradient, eliminated


def _walked(information: Float, gradient: Float, walk: Float) -> tuple[Float, Float]:
    """Add a random walk of the last unknowns, biases and calibration, by a lower Cholesky factor of its covariance.

    The change is an unknown of its own, which is eliminated; it has zero mean and, in units of the factor, unit
    covariance.
    """
    size = len(walk)
    walk = np.ascontiguousarray(walk[:, walk.any(axis=0)])  # the calibration of an exact file does not walk
    by_change = product(np.ascontiguousarray(information[:, -size:]), walk)
    of_change = product(np.ascontiguousarray(walk.T), np.ascontiguousarray(by_change[-size:])) + np.eye(walk.shape[1])
    gain = solve_rows(of_change, by_change)
    pull = times(walk.T, gradient[-size:])
    return information - product(gain, np.ascontiguousarray(by_change.T)), gradient - times(gain, pull)
