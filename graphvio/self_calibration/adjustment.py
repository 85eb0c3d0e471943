"""Adjustment of one window of keyframes: poses and calibration from the tracks and IMU samples that are no outliers."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.self_calibration.evidence import Gaussian
from graphvio.self_calibration.inertial import InertialSamples
from graphvio.self_calibration.parameters import RigCalibration
from graphvio.self_calibration.pixel_noise import noise_of_views
from graphvio.self_calibration.solver import Solution, States, Window, solve
from graphvio.self_calibration.window import Keyframe, choose_tracks, stationary

_MAX_TRACKS = 150  # of each pair or single camera
_MAX_SELECTIONS = 2  # how often landmarks that move are left out
_MIN_STATIONARY, _ALL_STATIONARY = 0.5, 0.98  # share that stands still: in between, the others are left out
_MAX_IMU_ERROR2 = 100.0  # squared whitened error of an interval, of 9 dimensions


def adjusted(
    keyframes: tuple[Keyframe, ...],
    samples: InertialSamples | None,
    nominal: RigCalibration,
    difference: Float,
    prior: Gaussian,
    sigma_px: float,
) -> Solution:
    """Adjust a window, beginning at the odometry's poses and at a difference from the nominal calibration.

    Args:
        keyframes: keyframes of the window, in time order.
        samples: IMU samples over the window, or None.
        nominal: calibration of the rig file.
        difference: (C,) initial difference of the calibration from the nominal one.
        prior: prior of that difference.
        sigma_px: noise of a corner's position.

    Returns:
        States, calibration and their covariance, without landmarks that move and outliers among the samples.
    """
    poses = np.array([keyframe.odom_T_body for keyframe in keyframes])
    stamps_s = np.array([(keyframe.stamp_ns - keyframes[0].stamp_ns) * 1e-9 for keyframe in keyframes])
    calibration = nominal.moved(difference[: len(nominal.columns)])
    tracks, landmarks = choose_tracks(keyframes, poses, calibration, _MAX_TRACKS, sigma_px)
    positions = poses[:, :3, 3]
    velocities = np.gradient(positions, stamps_s, axis=0) if len(poses) > 1 else np.zeros_like(positions)
    states = States(poses, velocities, np.array([0.0, 0.0, -GRAVITY_M_S2]), landmarks)
    if samples is not None:
        samples = samples.without(samples.intervals_with_spikes())
    solution = solve(Window(tracks, samples), states, nominal, difference, prior)
    for _ in range(_MAX_SELECTIONS):
        stands = stationary(tracks, solution.errors2)
        if not _MIN_STATIONARY < np.mean(stands) < _ALL_STATIONARY:
            break
        # From the first poses again: moving landmarks, as of a crowd, have biased those that were found.
        tracks, states = tracks.of(stands), states._replace(landmarks=states.landmarks[stands])
        solution = solve(Window(tracks, samples), states, nominal, difference, prior)
    # Without convergence, errors are not noise, but those of a rig that is wrong beyond what is estimated.
    noise_px = noise_of_views(tracks, solution.errors2) if solution.has_converged else tracks.sigma_px
    outliers = np.flatnonzero(solution.imu_errors2 > _MAX_IMU_ERROR2)  # single samples, or an axis that sticks
    if samples is not None and len(outliers):
        samples = samples.without(outliers)
    if len(outliers):  # from the first states again, which they have not biased
        solution = solve(Window(tracks._replace(sigma_px=noise_px), samples), states, nominal, difference, prior)
    elif not np.array_equal(noise_px, tracks.sigma_px):
        window = Window(solution.window.tracks._replace(sigma_px=noise_px), samples)
        solution = solve(window, solution.states, nominal, solution.calibration.mean, prior)
    return solution
