"""Correction of a predicted motion by few points: too few to measure a motion, but enough to improve the prediction.

Before a blank wall, only a handful of points may be in view. They constrain the motion in some directions only, or with
so little redundancy that wrong points do not stand out. But an IMU predicts the motion since the last frameset to a
fraction of a pixel. Against this prediction wrong points do stand out, and the errors of the others are linear in its
error: their normal equations are information about the motion, which the state estimator weighs against the IMU's. It
is the information that these points would contribute as landmarks of a tightly coupled estimator.

The linearisation is that of `graphvio.frontend.motion.linearisation`, in plain numpy, for the few framesets that need
it: a kernel is compiled again for each caller, which would delay the first such frameset, or every start.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.frontend.motion.cost import MIN_DEPTH_RATIO, camera_motions
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.frontend.motion.refinement import SHARED_BOUNDS
from graphvio.geometry import se3_exp

_PREDICTION_SIGMAS = np.repeat([0.05, 0.2], 3)  # rad, m: far larger than errors of a prediction by an IMU
_NEXT_TO_NOTHING = 1e-4  # of the prior's information, which keeps the covariance finite
_ROUNDS = 4
_MIN_POINTS = 3  # fewer could not contradict each other
_CUTOFF2 = 25.0  # squared whitened error of a point, which one right point in 20,000 exceeds
_PRIOR_RESIDUALS = 3.0  # weight of the expected noise, where so few residuals show the actual one


class FewPoints(NamedTuple):
    """A predicted motion, corrected in the directions that few points constrain.

    Attributes:
        cur_T_ref: (4, 4) motion of body.
        covariance: (6, 6), tangent ``[rotation, translation]`` in the body frame at the current instant: by the points
            alone, without the prediction, so that it is very large in directions that they do not constrain.
        shared_covariance: (6, 6) the part of it that all motions from the same reference have in common, since they
            depend on the same triangulated points.
        inlier: (N,) the points that agree with it.
    """

    cur_T_ref: Float
    covariance: Float
    shared_covariance: Float
    inlier: Bool


def fit_few_points(
    rig: RigArrays, observations: Observations, predicted: Float, sigma_px: float, max_error_px: float
) -> FewPoints | None:
    """Correct a predicted motion by least squares on few points, leaving out those that do not fit.

    Args:
        rig: calibration of P pairs.
        observations: N points of any subset of them.
        predicted: predicted ``cur_T_ref`` (4, 4), accurate to about ``max_error_px`` in the images.
        sigma_px: expected noise of a pixel; residuals may show that there is more.
        max_error_px: largest error of a point under the predicted motion.

    Returns:
        The motion, or None where fewer than three points fit.
    """
    errors, by_motion, through_points, in_front = _whitened(rig, observations, predicted, sigma_px)
    prior, correction = np.diag(_PREDICTION_SIGMAS**-2.0), np.zeros(6)
    cutoff2 = (max_error_px / sigma_px) ** 2
    for _ in range(_ROUNDS):
        inlier = in_front & (_squared(errors - by_motion @ correction) < cutoff2)
        used = by_motion[inlier]
        information = np.einsum("nka,nkb->ab", used, used)
        correction = np.linalg.solve(information + prior, np.einsum("nka,nk->a", used, errors[inlier]))
        cutoff2 = min(cutoff2, _CUTOFF2)
    if inlier.sum() < _MIN_POINTS:
        return None
    errors_left = _squared(errors - by_motion @ correction)[inlier].sum()
    redundancy = max(np.where(observations.has_right[inlier], 4.0, 2.0).sum() - 6.0, 0.0)
    variance = max((errors_left + _PRIOR_RESIDUALS) / (redundancy + _PRIOR_RESIDUALS), 1.0)
    # The prior only bounds the correction: its information is the IMU's, and must not be counted twice.
    covariance = np.linalg.inv(information / variance + _NEXT_TO_NOTHING * prior)
    of_score = through_points[inlier].sum(axis=0) / variance
    shared = _bounded(covariance @ of_score @ covariance, covariance)
    return FewPoints(se3_exp(correction) @ predicted, covariance, shared, inlier)


def _bounded(shared: Float, covariance: Float) -> Float:
    """Bound the shared part of a covariance (6, 6), as `graphvio.frontend.motion.refinement` does."""
    root = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(root)
    shares, axes = np.linalg.eigh(inverse @ shared @ inverse.T)
    scaled = root @ axes * np.sqrt(np.clip(shares, *SHARED_BOUNDS))
    return np.asarray(scaled @ scaled.T)


def _squared(errors: Float) -> Float:
    return np.asarray(np.sum(errors**2, axis=1))


def _whitened(
    rig: RigArrays, observations: Observations, cur_T_ref: Float, sigma_px: float
) -> tuple[Float, Float, Float, Bool]:
    """Compute the whitened errors of points, and their derivatives.

    Errors are divided by their standard deviation ``S^1/2``, as in `graphvio.frontend.motion.linearisation`; those in
    an image that does not see the point are zero.

    Returns:
        Errors (N, 4) in both images; derivatives (N, 4, 6) with respect to d in ``exp(d) cur_T_ref``; the variance
        (N, 6, 6) of the score that is due to the error of the point itself, ``J^T S^-1 J - sigma^2 J^T S^-2 J``; and
        which points (N,) are in front of the cameras.
    """
    pair, (x, y, w), n = observations.pair, observations.points.T, len(observations.pair)
    at_reference = np.column_stack([x, y, np.ones(n), w])  # homogeneous, divided by the depth there
    in_body = np.einsum("nij,nj->ni", cur_T_ref @ rig.body_T_left[pair], at_reference)
    to_camera = camera_motions(np.ascontiguousarray(cur_T_ref), rig)[pair]
    errors, by_motion, by_point = np.zeros((n, 4)), np.zeros((n, 4, 6)), np.zeros((n, 4, 3))
    in_front = np.ones(n, dtype=bool)
    for side, seen in enumerate((observations.left, observations.right)):
        is_seen = observations.has_right if side else np.ones(n, dtype=bool)
        in_camera = np.einsum("nij,nj->ni", to_camera[:, side], at_reference)[:, :3]
        is_near_plane = in_camera[:, 2] < MIN_DEPTH_RATIO
        in_front &= ~(is_seen & is_near_plane)
        scale = np.where(is_seen & ~is_near_plane, rig.focal_px[pair, side], 0.0)
        depth = np.where(is_near_plane, 1.0, in_camera[:, 2])
        projected = in_camera[:, :2] / depth[:, None]
        by_place = np.zeros((n, 2, 3))  # in the camera
        by_place[:, [0, 1], [0, 1]] = (scale / depth)[:, None]
        by_place[:, :, 2] = -(scale / depth)[:, None] * projected
        rows = slice(2 * side, 2 * side + 2)
        errors[:, rows] = np.where(is_seen[:, None], scale[:, None] * (seen - projected), 0.0)
        turned = by_place @ rig.cam_T_body[pair, side, :3, :3]
        by_motion[:, rows, :3] = np.cross(in_body[:, None, :3], turned)
        by_motion[:, rows, 3:] = w[:, None, None] * turned
        by_point[:, rows] = by_place @ to_camera[:, side][:, :3, [0, 1, 3]]
    covariances = sigma_px**2 * (np.eye(4) + by_point @ observations.covariances @ by_point.transpose(0, 2, 1))
    whitener = np.linalg.inv(np.linalg.cholesky(covariances))
    whitened = whitener @ by_motion
    twice = sigma_px * whitener.transpose(0, 2, 1) @ whitened
    through_points = whitened.transpose(0, 2, 1) @ whitened - twice.transpose(0, 2, 1) @ twice
    return np.einsum("nij,nj->ni", whitener, errors), whitened, through_points, in_front
