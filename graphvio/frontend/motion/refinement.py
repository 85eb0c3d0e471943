"""Refinement of a motion on the points of all pairs, and its covariance (sections 3, 3.1 and 5).

Levenberg-Marquardt minimises the Cauchy cost of the whitened errors of `graphvio.frontend.motion.linearisation`; points
that turn out to be outliers are then left out, since the Cauchy weight of many outliers with similar errors never
vanishes. The scale of the cost is the configured one for the modelled noise, and less where the residuals are smaller.

With ``motion.residuals: per_image``, as in the profile ``paper``, the minimum is that of eq. (2) or (3) as
`graphvio.frontend.motion.paper_method` has them: of all points, each image by itself, all with the same scale. What
differs from the paper even then is the covariance: it is that of the inliers, with the uncertainty of their
triangulation, the noise that the residuals show, and ``motion.sigma_inflation``.
"""

from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.config.stages import MotionConfig
from graphvio.frontend.motion.blocks import POINTS, Blocks, in_blocks, lane_by_lane, point_by_point
from graphvio.frontend.motion.cost import camera_motions
from graphvio.frontend.motion.linearisation import (
    LinearisationPoints,
    allocate_points,
    information_through_points,
    linearise,
    relinearise_points,
)
from graphvio.frontend.motion.noise import influence, influence_slope, inlier_cutoff, noise_by_pair, noise_variance
from graphvio.frontend.motion.observations import Observations, RigArrays, image_by_image, is_depth_known
from graphvio.geometry import se3_compose, se3_exp
from graphvio.kernels import kernel
from graphvio.linear_algebra import cholesky, eigen, product, solve_lower, solve_symmetric

_MAX_ROUNDS = 3
_MAX_REPETITIONS = 5  # of these rounds with residuals per image, where outliers in the cost make convergence slow
_ROUNDS_TO_FIND_INLIERS = 5
_ROUNDS_WITH_ALL = 2
_GROSS = 4.0  # squared error over the inliers' cutoff, since one pair's noise may be larger than that of all
_STEPS_PER_ROUND = 6
_CONVERGED = 1e-6  # radians and metres
_NEAR = 1e-4  # precise enough to determine inliers
_WEAK_DIRECTION_SIGMA = 10.0
_MIN_SHARE_OF_A_PAIR = 0.25
_MIN_POINTS_OF_A_PAIR = 5
SHARED_BOUNDS = (0.02, 0.9)
"""Bounds of the part of a covariance that motions from one reference share, over the covariance."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A refined motion.

    Attributes:
        cur_T_ref: (4, 4) motion of body.
        covariance: (6, 6), tangent ``[rotation, translation]`` in the body frame at the current instant. ``cur_T_ref``
            is the inverse of `RelativeMotion.reference_T_current`: the perturbation is on the right there, on the left
            here.
        shared_covariance: (6, 6) the part of it that all motions from the same reference have in common, since they
            depend on the same triangulated points.
        inlier: (N,) the points that the motion explains.
        errors_px: (N,) each point's reprojection error in one direction, root mean square over its images, with the
            point's own uncertainty removed, so that the noise of the pixels remains. Infinite behind a camera, NaN for
            points that the motion was not tried on.
    """

    cur_T_ref: Float
    covariance: Float
    shared_covariance: Float
    inlier: Bool
    errors_px: Float

    def rms_px(self, among: Bool | None = None) -> float | None:
        """Compute the root mean square error, pixels, of all inliers or of those among some points (N,), or None."""
        errors_px = self.errors_px[self.inlier if among is None else self.inlier & among]
        return float(np.sqrt(np.mean(errors_px**2))) if len(errors_px) else None


def refine(
    rig: RigArrays, observations: Observations, cur_T_ref: Float, config: MotionConfig, known_inlier: Bool | None = None
) -> Refined:
    """Minimise the robust cost; directions that no point constrains get a large variance.

    Args:
        rig: calibration of P pairs.
        observations: N points of any subset of them.
        cur_T_ref: initial motion (4, 4).
        config: configuration of the motion stage.
        known_inlier: (N,) the inliers, where they are known already and the initial motion is near; else they are found
            first.
    """
    inlier = np.zeros(0, dtype=bool) if known_inlier is None else known_inlier
    start = np.ascontiguousarray(cur_T_ref)
    settings = config.pixel_sigma_px, config.cauchy_scale_px, config.max_error_px, config.sigma_inflation**2
    if config.residuals == "per_image":
        images_rig, images, rows = image_by_image(rig, observations)
        counted = np.ones(len(rows)) if known_inlier is None else known_inlier[rows].astype(np.float64)
        return Refined(*_refined_per_image(start, rig, observations, inlier, images_rig, images, counted, *settings))
    shows_noise = is_depth_known(rig, observations, config.pixel_sigma_px)
    refined = Refined(*_refined(start, rig, observations, inlier, shows_noise, *settings))
    in_front = np.isfinite(refined.errors_px)
    if in_front[refined.inlier].all():
        return refined
    # The last step took points whose depth is hardly known behind a camera: refine once more without them.
    refined = Refined(*_refined(start, rig, observations, refined.inlier & in_front, shows_noise, *settings))
    return replace(refined, inlier=refined.inlier & np.isfinite(refined.errors_px))


@kernel
def _refined(
    cur_T_ref: Float, rig: RigArrays, observations: Observations, known_inlier: Bool, shows_noise: Bool, sigma: float,
    scale_px: float, max_error_px: float, inflation: float,
) -> tuple[Float, Float, Float, Bool, Float]:  # fmt: skip
    """Compute the fields of `Refined`, in their order.

    Args:
        cur_T_ref: (4, 4) initial motion.
        rig: calibration of P pairs.
        observations: N points.
        known_inlier: (N,) the inliers; no elements where they are not known.
        shows_noise: (N,) points whose residuals show the noise; the depth of the others is so uncertain that it absorbs
            their error.
        sigma: modelled pixel noise.
        scale_px: scale of the Cauchy cost for the modelled noise.
        max_error_px: largest error of an inlier.
        inflation: factor on the covariances.
    """
    widest, largest2 = scale_px / sigma, (max_error_px / sigma) ** 2
    has_right, blocks = observations.has_right, in_blocks(observations)
    points_at, pose, hessian = allocate_points(blocks), cur_T_ref, np.empty((6, 6))
    sigmas_px = np.full(len(rig.focal_px), sigma)
    errors2 = _squared_errors(pose, rig, blocks, points_at, sigmas_px)
    is_known = len(known_inlier) == len(has_right)
    inlier = known_inlier if is_known else np.ones(len(has_right), dtype=np.bool_)
    scale = widest
    # One loop for the search and for the last, precise round: a kernel is compiled again wherever it is called.
    for number in range(_ROUNDS_TO_FIND_INLIERS if is_known else 0, _ROUNDS_TO_FIND_INLIERS + 1):
        is_last = number == _ROUNDS_TO_FIND_INLIERS
        if is_last and not is_known:
            # One pair's images may be blurred or dim: its points are then less certain than the others'.
            for_noise = _only(np.ones(len(inlier), dtype=np.bool_), shows_noise)
            noise = noise_by_pair(
                errors2[for_noise], has_right[for_noise], observations.pair[for_noise], len(sigmas_px), largest2
            )
            errors2 /= noise[observations.pair]
            sigmas_px *= np.sqrt(noise)
        for_noise = _only(inlier if is_known else np.ones(len(inlier), dtype=np.bool_), shows_noise)
        variance = noise_variance(errors2[for_noise], has_right[for_noise], largest2)
        if is_known or not is_last:
            scale = _scale(variance, widest)
        # Gross errors are left out as soon as they stand out: near the camera, they would bias the motion more in each
        # round. In the first rounds all points count: judged by the initial motion, other points would seem wrong.
        if not is_known and number >= _ROUNDS_WITH_ALL:
            inlier = errors2 < inlier_cutoff(variance, largest2) * (1.0 if is_last else _GROSS)
            if is_last:
                inlier &= _is_of_an_explained_pair(observations.pair, inlier, len(sigmas_px))
        pose, hessian, errors2 = _levenberg_marquardt(
            pose, rig, blocks, points_at, lane_by_lane(blocks, inlier.astype(np.float64)), sigmas_px, scale,
            _MAX_ROUNDS if is_last else 1, _CONVERGED if is_last else _NEAR,
        )  # fmt: skip
    for_noise = _only(inlier, shows_noise)
    covariance, shared = _covariances(
        pose, hessian, errors2, rig, blocks, points_at, inlier, for_noise, has_right, sigmas_px, scale
    )
    errors_px = _errors_px(errors2, has_right, sigmas_px[observations.pair])
    return pose, inflation * covariance, inflation * shared, inlier, errors_px


@kernel
def _only(points: Bool, wanted: Bool) -> Bool:
    """Select the points (N,) that are wanted, or all of them where none is."""
    both: Bool = points & wanted
    return both if both.any() else points


@kernel
def _refined_per_image(
    cur_T_ref: Float, rig: RigArrays, observations: Observations, known_inlier: Bool, images_rig: RigArrays,
    images: Observations, counted: Float, sigma: float, scale_px: float, max_error_px: float, inflation: float,
) -> tuple[Float, Float, Float, Bool, Float]:  # fmt: skip
    """Compute the fields of `Refined` at the minimum of eq. (2), over M observations in single images.

    ``counted`` (M,) is 1 for the observations that the cost is summed over, else 0.
    """
    blocks, pose = in_blocks(images), cur_T_ref
    points_at, active = allocate_points(blocks), lane_by_lane(blocks, counted)
    sigmas_px = np.full(len(images_rig.focal_px), sigma)
    for _ in range(_MAX_REPETITIONS):
        before = pose
        pose, _, _ = _levenberg_marquardt(
            before, images_rig, blocks, points_at, active, sigmas_px, scale_px / sigma, _MAX_ROUNDS, _CONVERGED
        )
        if np.max(np.abs(pose - before)) < _CONVERGED:
            break
    # Inliers and covariance as in `_refined`, with the uncertainty of the triangulated points.
    has_right, blocks, largest2 = observations.has_right, in_blocks(observations), (max_error_px / sigma) ** 2
    points_at, sigmas_px = allocate_points(blocks), np.full(len(rig.focal_px), sigma)
    errors2 = _squared_errors(pose, rig, blocks, points_at, sigmas_px)
    inlier = known_inlier
    if len(inlier) != len(has_right):
        inlier = errors2 < inlier_cutoff(noise_variance(errors2, has_right, largest2), largest2)
        inlier &= _is_of_an_explained_pair(observations.pair, inlier, len(sigmas_px))
    scale = _scale(noise_variance(errors2[inlier], has_right[inlier], largest2), scale_px / sigma)
    hessian = np.empty((6, 6))
    linearise(
        camera_motions(pose, rig), rig, blocks, points_at, lane_by_lane(blocks, inlier.astype(np.float64)), scale,
        hessian, np.empty(6), np.empty((len(blocks.pair), POINTS)),
    )  # fmt: skip
    covariance, shared = _covariances(
        pose, hessian, errors2, rig, blocks, points_at, inlier, inlier, has_right, sigmas_px, scale
    )
    errors_px = _errors_px(errors2, has_right, sigmas_px[observations.pair])
    return pose, inflation * covariance, inflation * shared, inlier, errors_px


@kernel
def _covariances(
    pose: Float, hessian: Float, errors2: Float, rig: RigArrays, blocks: Blocks, points_at: LinearisationPoints,
    inlier: Bool, for_noise: Bool, has_right: Bool, sigmas_px: Float, scale: float,
) -> tuple[Float, Float]:  # fmt: skip
    """Compute the covariance (6, 6) of a motion at the minimum of the cost, and its shared part (6, 6), see `Refined`.

    ``for_noise`` are the inliers (N,) from which the noise is estimated.
    """
    used = influence(errors2[for_noise], has_right[for_noise], scale)
    # Backward propagation of the reprojection covariance. The small prior keeps unconstrained directions finite.
    information = hessian / used.factor + np.eye(6) / _WEAK_DIRECTION_SIGMA**2
    lower = cholesky(information)
    root = solve_lower(lower, np.eye(6))
    covariance = product(root, root.T.copy())
    factors = np.zeros(len(inlier))
    for i in range(len(inlier)):
        if inlier[i]:
            factors[i] = influence_slope(errors2[i], has_right[i], scale) ** 2
    through_points = information_through_points(
        camera_motions(pose, rig), rig, blocks, points_at, sigmas_px, lane_by_lane(blocks, factors)
    )
    gain = covariance / used.factor * (used.weight / used.slope)
    shared = _bounded(product(product(used.variance * gain, through_points), gain), root, lower)
    return covariance, shared


@kernel
def _scale(variance: float, widest: float) -> float:
    """Compute the scale of the Cauchy cost, less where the noise's variance is less than modelled.

    An outlier next to a camera has the leverage of a hundred other points: its error must be compared with true noise.
    """
    return float(widest * np.sqrt(min(variance, 1.0)))


@kernel
def _is_of_an_explained_pair(pair: Int, inlier: Bool, pairs: int) -> Bool:
    """Select the points (N,) of pairs with more inliers than there would be by chance; all if there is no such pair."""
    points, fitting = np.zeros(pairs), np.zeros(pairs)
    for i in range(len(pair)):
        points[pair[i]] += 1.0
        fitting[pair[i]] += inlier[i]
    explained = fitting >= np.maximum(_MIN_SHARE_OF_A_PAIR * points, _MIN_POINTS_OF_A_PAIR)
    those: Bool = explained[pair] | (not explained.any())
    return those


@kernel
def _bounded(shared: Float, root: Float, lower: Float) -> Float:
    """Bound the shared part of a covariance ``root root^T``, so that it and the remainder are positive definite.

    ``lower`` is the inverse of ``root^T``.
    """
    shares, axes = eigen(product(product(lower.T.copy(), shared), lower))
    turned = product(root, axes)
    scaled = turned.copy()
    for c in range(6):
        share = min(max(shares[c], SHARED_BOUNDS[0]), SHARED_BOUNDS[1])
        for r in range(6):
            scaled[r, c] *= share
    return product(scaled, turned.T.copy())


@kernel
def _levenberg_marquardt(
    cur_T_ref: Float, rig: RigArrays, blocks: Blocks, points_at: LinearisationPoints, active: Float,
    sigmas_px: Float, scale: float, rounds: int, tolerance: float,
) -> tuple[Float, Float, Float]:  # fmt: skip
    """Minimise the cost in rounds, each of which begins with a relinearisation of the points.

    Returns:
        Pose, normal matrix (6, 6) and squared whitened errors (N,) at the minimum. The last two are those before the
        last step, which is smaller than the tolerance; ``points_at`` are those of the beginning of the last round.
    """
    pose = cur_T_ref.copy()
    hessian, gradient, errors2 = np.zeros((6, 6)), np.zeros(6), np.empty((len(blocks.pair), POINTS))
    new_hessian, new_gradient, new_errors2 = np.zeros((6, 6)), np.zeros(6), np.empty((len(blocks.pair), POINTS))
    for _ in range(rounds):
        relinearise_points(camera_motions(pose, rig), rig, blocks, sigmas_px, points_at)
        candidate, cost, damping, moved, length = pose, np.inf, 1e-5, 0.0, 0.0
        for _ in range(1 + _STEPS_PER_ROUND):
            new_cost = linearise(
                camera_motions(candidate, rig), rig, blocks, points_at, active, scale, new_hessian, new_gradient,
                new_errors2,
            )  # fmt: skip
            if new_cost <= cost:
                pose, cost = candidate, new_cost
                hessian, new_hessian = new_hessian, hessian
                gradient, new_gradient = new_gradient, gradient
                errors2, new_errors2 = new_errors2, errors2
                damping *= 0.1
                moved = max(moved, length)
            else:
                damping = max(damping * 10.0, 1e-4)
            damped = hessian.copy()
            for k in range(6):
                damped[k, k] += damping * hessian[k, k] + 1e-9
            step = solve_symmetric(damped, gradient)
            length = np.max(np.abs(step))
            candidate = se3_compose(se3_exp(step), pose)
            if length < tolerance:
                pose = candidate
                break
        if moved < _NEAR:
            break  # relinearising the points would change nothing any more
    return pose, hessian, point_by_point(blocks, errors2)


def explained(rig: RigArrays, observations: Observations, cur_T_ref: Float, config: MotionConfig) -> tuple[Bool, Float]:
    """Determine which points (N,) are inliers of a motion (4, 4), and the errors (N,) of all, see `Refined`."""
    sigma, has_right = config.pixel_sigma_px, observations.has_right
    sigmas_px = np.full(len(rig.focal_px), sigma)
    blocks = in_blocks(observations)
    errors2 = _squared_errors(cur_T_ref, rig, blocks, allocate_points(blocks), sigmas_px)
    largest2 = (config.max_error_px / sigma) ** 2
    inlier = errors2 < inlier_cutoff(noise_variance(errors2, has_right, largest2), largest2)
    return np.asarray(inlier), _errors_px(errors2, has_right, sigmas_px[observations.pair])


@kernel
def _errors_px(errors2: Float, has_right: Bool, sigmas_px: Float) -> Float:
    """Convert squared whitened errors (N,) of points with pixel noise (N,) to errors in one direction, pixels."""
    errors_px = np.empty(len(errors2))
    for i in range(len(errors2)):
        errors_px[i] = sigmas_px[i] * np.sqrt(errors2[i] / (4.0 if has_right[i] else 2.0))
    return errors_px


@kernel
def _squared_errors(
    cur_T_ref: Float, rig: RigArrays, blocks: Blocks, points_at: LinearisationPoints, sigmas_px: Float
) -> Float:
    """Compute squared whitened errors (N,), and relinearise ``points_at`` there."""
    motions = camera_motions(cur_T_ref, rig)
    relinearise_points(motions, rig, blocks, sigmas_px, points_at)
    errors2 = np.empty((len(blocks.pair), POINTS))
    linearise(motions, rig, blocks, points_at, np.zeros_like(errors2), 1.0, np.empty((6, 6)), np.empty(6), errors2)
    return point_by_point(blocks, errors2)
