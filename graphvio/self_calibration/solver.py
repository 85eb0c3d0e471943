"""Levenberg-Marquardt over poses, landmarks and calibration of a window, and what it says of the calibration."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import so3_exp
from graphvio.self_calibration.bundle import Eliminated, Tracks, eliminate_landmarks, landmarks_after, total_cost
from graphvio.self_calibration.evidence import Gaussian
from graphvio.self_calibration.parameters import RigCalibration

_ROBUST_SCALE = 2.5  # of the Cauchy cost, in standard deviations
_MAX_STEPS = 8
_CONVERGED = 0.01  # standard deviations of the prior
_LOOSE_POSE_SIGMAS = np.repeat([np.deg2rad(5.0), 0.3], 3)  # keeps poses that no track constrains
_FIXED = 1e-9


class Solution(NamedTuple):
    """A bundle adjustment's result.

    Attributes:
        poses: (K, 4, 4) ``odom_T_body``.
        landmarks: (L, 3).
        calibration: posterior of the difference from the nominal calibration.
        errors2: (N, 2) squared whitened errors, NaN where there is no right image.
    """

    poses: Float
    landmarks: Float
    calibration: Gaussian
    errors2: Float


def solve(
    poses: Float,
    landmarks: Float,
    tracks: Tracks,
    nominal: RigCalibration,
    difference: Float,
    prior: Gaussian,
    sigma_px: float,
    max_steps: int = _MAX_STEPS,
) -> Solution:
    """Adjust a window.

    Args:
        poses: (K, 4, 4) ``odom_T_body``, initial; the first one stays.
        landmarks: (L, 3) initial.
        tracks: of these.
        nominal: calibration of the rig file.
        difference: (C,) initial difference from it.
        prior: of that difference.
        sigma_px: noise of a corner's position.
        max_steps: of the minimisation.
    """
    n_poses, first_poses = 6 * len(poses), poses
    pose_information = np.tile(1.0 / _LOOSE_POSE_SIGMAS**2, len(poses))
    pose_information[:6] = 1.0 / _FIXED**2
    pose_offsets = np.zeros(n_poses)
    eliminated = Eliminated.empty(tracks)
    prior_sigmas = np.sqrt(np.diag(prior.covariance))

    def cost_of(poses: Float, landmarks: Float, difference: Float, offsets: Float) -> tuple[float, Float]:
        data, errors2 = total_cost(poses, nominal.moved(difference), landmarks, tracks, sigma_px, _ROBUST_SCALE)
        return data + prior.cost(difference) + 0.5 * float(pose_information @ offsets**2), errors2

    cost, errors2 = cost_of(poses, landmarks, difference, pose_offsets)
    damping = 1e-6
    for _ in range(max_steps):
        hessian, gradient = _normal_equations(
            poses, landmarks, tracks, nominal, difference, prior, sigma_px, pose_information, pose_offsets, damping,
            eliminated,
        )  # fmt: skip
        damped = hessian + damping * np.diag(np.diag(hessian))
        step = -np.linalg.solve(damped, gradient)
        new_poses, new_offsets = _moved(poses, step), pose_offsets + step[:n_poses]
        new_landmarks = landmarks_after(landmarks, tracks, eliminated, step, len(poses))
        new_difference = difference + step[n_poses:]
        new_cost, new_errors2 = cost_of(new_poses, new_landmarks, new_difference, new_offsets)
        if new_cost <= cost:
            gained = cost - new_cost
            poses, landmarks, difference, pose_offsets = new_poses, new_landmarks, new_difference, new_offsets
            cost, errors2 = new_cost, new_errors2
            damping = max(damping * 0.1, 1e-9)
            if np.abs(step[n_poses:] / prior_sigmas).max() < _CONVERGED and gained < 0.5:
                break
        else:
            damping = max(10.0 * damping, 1e-4)
    hessian, _ = _normal_equations(
        poses, landmarks, tracks, nominal, difference, prior, sigma_px, pose_information, pose_offsets, 0.0, eliminated
    )
    pp, pc, cc = hessian[:n_poses, :n_poses], hessian[:n_poses, n_poses:], hessian[n_poses:, n_poses:]
    information = cc - pc.T @ np.linalg.solve(pp, pc)
    return Solution(poses, landmarks, Gaussian(difference, 0.5 * (information + information.T)), errors2)


def _normal_equations(
    poses: Float,
    landmarks: Float,
    tracks: Tracks,
    nominal: RigCalibration,
    difference: Float,
    prior: Gaussian,
    sigma_px: float,
    pose_information: Float,
    pose_offsets: Float,
    damping: float,
    eliminated: Eliminated,
) -> tuple[Float, Float]:
    n_poses = 6 * len(poses)
    size = n_poses + len(difference)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    eliminate_landmarks(
        poses, nominal.moved(difference), landmarks, tracks, sigma_px, _ROBUST_SCALE, damping, hessian, gradient,
        eliminated,
    )  # fmt: skip
    hessian[n_poses:, n_poses:] += prior.information
    gradient[n_poses:] += prior.information @ (difference - prior.mean)
    hessian[np.arange(n_poses), np.arange(n_poses)] += pose_information
    gradient[:n_poses] += pose_information * pose_offsets
    return hessian, gradient


def _moved(poses: Float, step: Float) -> Float:
    moved = poses.copy()
    for k, of_pose in enumerate(step[: 6 * len(poses)].reshape(-1, 6)):
        moved[k, :3, 3] += poses[k, :3, :3] @ of_pose[3:]
        moved[k, :3, :3] = poses[k, :3, :3] @ so3_exp(of_pose[:3].copy())
    return moved
