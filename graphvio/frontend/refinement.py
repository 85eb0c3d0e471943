"""Refinement of a motion on the points of all pairs, and its covariance (sections 3, 3.1 and 5).

Levenberg-Marquardt minimises the Cauchy cost of the whitened errors of `graphvio.frontend.linearisation`; points that
turn out to be no inliers are then left out, since the Cauchy weight of many that err alike never vanishes. The scale of
the cost is that of the configuration for the modelled noise, and less where the residuals are smaller.

With ``motion.residuals: per_image``, as in the profile ``paper``, the minimum is that of eq. (2) or (3) as
`graphvio.frontend.paper_method` has them: of all points, each image by itself, all with the same scale. What differs
from the paper even then is the covariance: it is that of the inliers, with the uncertainty of their triangulation,
the noise that the residuals show, and ``motion.sigma_inflation``.
"""

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.config.stages import MotionConfig
from graphvio.frontend.blocks import POINTS, Blocks, in_blocks, lane_by_lane, point_by_point
from graphvio.frontend.cost import left_motions
from graphvio.frontend.linearisation import Expansion, expand, information_through_points, linearise, unexpanded
from graphvio.frontend.noise import influence, influence_slopes, inlier_cutoff, noise_by_pair, noise_variance
from graphvio.frontend.observations import Observations, RigArrays, image_by_image
from graphvio.geometry import se3_compose, se3_exp
from graphvio.kernels import kernel

_MAX_ROUNDS = 3
_MAX_REPETITIONS = 5  # of these rounds, where outliers stay in the cost and make convergence slow
_ROUNDS_TO_FIND_INLIERS = 5
_ROUNDS_WITH_ALL = 2
_GROSS = 4.0  # over the cutoff of inliers, as one pair's noise may be larger than that of all
_STEPS_PER_ROUND = 6
_CONVERGED = 1e-6  # radians and metres
_NEAR = 1e-4  # precise enough to determine inliers
_WEAK_DIRECTION_SIGMA = 10.0
_MIN_SHARE_OF_A_PAIR = 0.25
_MIN_POINTS_OF_A_PAIR = 5
_SHARED_BOUNDS = (0.02, 0.9)


@dataclass(frozen=True, eq=False)
class Refined:
    """A refined motion.

    Attributes:
        cur_T_ref: (4, 4) of body.
        covariance: (6, 6), tangent ``[rotation, translation]`` in the body frame at the current instant.
        shared_covariance: (6, 6) the part of it that all motions from the same reference have in common, since they
            depend on the same triangulated points.
        inlier: (N,) the points that it explains.
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
        """Compute the root mean square error of the inliers, all or among some points (N,); None without any."""
        errors_px = self.errors_px[self.inlier if among is None else self.inlier & among]
        return float(np.sqrt(np.mean(errors_px**2))) if len(errors_px) else None


def refine(
    rig: RigArrays, observations: Observations, cur_T_ref: Float, config: MotionConfig, known: Bool | None = None
) -> Refined:
    """Minimise the robust cost; directions that no point constrains get a large variance.

    Args:
        rig: of P pairs.
        observations: N points of any subset of them.
        cur_T_ref: initial motion (4, 4).
        config: of this stage.
        known: (N,) the inliers, where they are known already and the initial motion is near; else they are found first.
    """
    inlier = np.zeros(0, dtype=bool) if known is None else known
    start = np.ascontiguousarray(cur_T_ref)
    settings = config.pixel_sigma_px, config.cauchy_scale_px, config.max_error_px, config.sigma_inflation**2
    if config.residuals == "per_image":
        images_rig, images, rows = image_by_image(rig, observations)
        counted = np.ones(len(rows)) if known is None else known[rows].astype(np.float64)
        return Refined(*_refined_per_image(start, rig, observations, inlier, images_rig, images, counted, *settings))
    return Refined(*_refined(start, rig, observations, inlier, *settings))


@kernel
def _refined(
    cur_T_ref: Float, rig: RigArrays, observations: Observations, known: Bool, sigma: float, scale_px: float,
    max_error_px: float, inflation: float,
) -> tuple[Float, Float, Float, Bool, Float]:  # fmt: skip
    """Compute the fields of `Refined`, in their order; ``known`` has no elements where inliers are not known."""
    widest, largest2 = scale_px / sigma, (max_error_px / sigma) ** 2
    has_right, blocks = observations.has_right, in_blocks(observations)
    at = unexpanded(blocks)
    pose, inlier = cur_T_ref, known
    sigmas_px = np.full(len(rig.focal_px), sigma)
    errors2 = _squared_errors(pose, rig, blocks, at, sigmas_px)
    if len(inlier) == len(has_right):
        scale = _scale(errors2[inlier], has_right[inlier], widest, largest2)
    else:
        # Until the result does not depend on the initial motion. Gross errors are left out as soon as they stand out:
        # near the camera, they would bias the motion more in each round.
        candidates = np.ones(len(has_right))
        for number in range(_ROUNDS_TO_FIND_INLIERS):
            scale = _scale(errors2, has_right, widest, largest2)
            if number >= _ROUNDS_WITH_ALL:
                candidates = (errors2 < _GROSS * inlier_cutoff(errors2, has_right, largest2)).astype(np.float64)
            active = lane_by_lane(blocks, candidates)
            pose, _, errors2 = _levenberg_marquardt(pose, rig, blocks, at, active, sigmas_px, scale, 1, _NEAR)
        # One pair's images may be blurred or dim: its points are then less certain than the others'.
        noise = noise_by_pair(errors2, has_right, observations.pair, len(sigmas_px), largest2)
        errors2 /= noise[observations.pair]
        sigmas_px *= np.sqrt(noise)
        inlier = errors2 < inlier_cutoff(errors2, has_right, largest2)
        inlier &= _is_of_an_explained_pair(observations.pair, inlier)
    active = lane_by_lane(blocks, inlier.astype(np.float64))
    pose, hessian, errors2 = _levenberg_marquardt(
        pose, rig, blocks, at, active, sigmas_px, scale, _MAX_ROUNDS, _CONVERGED
    )
    covariance, shared = _covariances(pose, hessian, errors2, rig, blocks, at, inlier, has_right, sigmas_px, scale)
    errors_px = _errors_px(errors2, has_right, sigmas_px[observations.pair])
    return pose, inflation * covariance, inflation * shared, inlier, errors_px


@kernel
def _refined_per_image(
    cur_T_ref: Float, rig: RigArrays, observations: Observations, known: Bool, images_rig: RigArrays,
    images: Observations, counted: Float, sigma: float, scale_px: float, max_error_px: float, inflation: float,
) -> tuple[Float, Float, Float, Bool, Float]:  # fmt: skip
    """As `_refined`, but at the minimum of eq. (2), of observations image by image (M,) of which some are counted."""
    blocks, pose = in_blocks(images), cur_T_ref
    at, active = unexpanded(blocks), lane_by_lane(blocks, counted)
    sigmas_px = np.full(len(images_rig.focal_px), sigma)
    for _ in range(_MAX_REPETITIONS):
        before = pose
        pose, _, _ = _levenberg_marquardt(
            before, images_rig, blocks, at, active, sigmas_px, scale_px / sigma, _MAX_ROUNDS, _CONVERGED
        )
        if np.max(np.abs(pose - before)) < _CONVERGED:
            break
    # Inliers and covariance as in `_refined`, with the uncertainty of the triangulated points.
    has_right, blocks, largest2 = observations.has_right, in_blocks(observations), (max_error_px / sigma) ** 2
    at, sigmas_px = unexpanded(blocks), np.full(len(rig.focal_px), sigma)
    errors2 = _squared_errors(pose, rig, blocks, at, sigmas_px)
    inlier = known
    if len(inlier) != len(has_right):
        inlier = errors2 < inlier_cutoff(errors2, has_right, largest2)
        inlier &= _is_of_an_explained_pair(observations.pair, inlier)
    scale = _scale(errors2[inlier], has_right[inlier], scale_px / sigma, largest2)
    hessian = np.empty((6, 6))
    linearise(
        left_motions(pose, rig), rig, blocks, at, lane_by_lane(blocks, inlier.astype(np.float64)), scale,
        hessian, np.empty(6), np.empty((len(blocks.pair), POINTS)),
    )  # fmt: skip
    covariance, shared = _covariances(pose, hessian, errors2, rig, blocks, at, inlier, has_right, sigmas_px, scale)
    errors_px = _errors_px(errors2, has_right, sigmas_px[observations.pair])
    return pose, inflation * covariance, inflation * shared, inlier, errors_px


@kernel
def _covariances(
    pose: Float, hessian: Float, errors2: Float, rig: RigArrays, blocks: Blocks, at: Expansion, inlier: Bool,
    has_right: Bool, sigmas_px: Float, scale: float,
) -> tuple[Float, Float]:  # fmt: skip
    """Covariance (6, 6) of a motion at the minimum of the cost, and its shared part (6, 6), see `Refined`."""
    used = influence(errors2[inlier], has_right[inlier], scale)
    # Backward propagation of the reprojection covariance. The small prior keeps unconstrained directions finite.
    information = hessian / used.factor + np.eye(6) / _WEAK_DIRECTION_SIGMA**2
    root = np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(information)).T)
    covariance = root @ root.T
    factors = lane_by_lane(blocks, np.where(inlier, influence_slopes(errors2, has_right, scale) ** 2, 0.0))
    through_points = information_through_points(left_motions(pose, rig), rig, blocks, at, sigmas_px, factors)
    gain = covariance / used.factor * (used.weight / used.slope)
    shared = _bounded(used.variance * gain @ through_points @ gain, root)
    return covariance, shared


@kernel
def _scale(errors2: Float, has_right: Bool, widest: float, largest2: float) -> float:
    """Compute the scale of the Cauchy cost, less where the noise is less than modelled.

    A wrong point next to a camera has the leverage of a hundred others, and must look as wrong as it is.
    """
    return float(widest * np.sqrt(min(noise_variance(errors2, has_right, largest2), 1.0)))


@kernel
def _is_of_an_explained_pair(pair: Int, inlier: Bool) -> Bool:
    """Select the points (N,) of pairs of which more fit than would by chance; all points, if there is no such pair."""
    fitting = np.bincount(pair, weights=inlier.astype(np.float64))
    explained = fitting >= np.maximum(_MIN_SHARE_OF_A_PAIR * np.bincount(pair), _MIN_POINTS_OF_A_PAIR)
    those: Bool = explained[pair] | (not explained.any())
    return those


@kernel
def _bounded(shared: Float, root: Float) -> Float:
    """Bound the shared part of a covariance ``root root^T``, so that it and the remainder are positive definite."""
    inverse = np.linalg.inv(root)
    shares, axes = np.linalg.eigh(inverse @ shared @ inverse.T)
    turned = root @ axes
    bounded: Float = (turned * np.minimum(np.maximum(shares, _SHARED_BOUNDS[0]), _SHARED_BOUNDS[1])) @ turned.T
    return bounded


@kernel
def _levenberg_marquardt(
    cur_T_ref: Float, rig: RigArrays, blocks: Blocks, at: Expansion, active: Float, sigmas_px: Float, scale: float,
    rounds: int, tolerance: float,
) -> tuple[Float, Float, Float]:  # fmt: skip
    """Minimise the cost; in each round the places at which the points are linearised are found again.

    Returns:
        Pose, normal matrix (6, 6) and squared whitened errors (N,) at the minimum, except for the last step, which is
        smaller than the tolerance; ``at`` is expanded where the last round began.
    """
    pose = cur_T_ref.copy()
    hessian, gradient, errors2 = np.zeros((6, 6)), np.zeros(6), np.empty((len(blocks.pair), POINTS))
    new_hessian, new_gradient, new_errors2 = np.zeros((6, 6)), np.zeros(6), np.empty((len(blocks.pair), POINTS))
    for _ in range(rounds):
        motions = left_motions(pose, rig)
        expand(motions, rig, blocks, sigmas_px, at)
        moved = 0.0
        cost = linearise(motions, rig, blocks, at, active, scale, hessian, gradient, errors2)
        damping = 1e-6
        for _ in range(_STEPS_PER_ROUND):
            damped = hessian.copy()
            for k in range(6):
                damped[k, k] += damping * hessian[k, k] + 1e-9
            step = np.linalg.solve(damped, gradient)
            candidate = se3_compose(se3_exp(step), pose)  # type: ignore[arg-type]
            if np.max(np.abs(step)) < tolerance:
                pose = candidate
                break
            new_cost = linearise(
                left_motions(candidate, rig), rig, blocks, at, active, scale, new_hessian, new_gradient, new_errors2
            )
            if new_cost <= cost:
                pose, cost = candidate, new_cost
                hessian, new_hessian = new_hessian, hessian
                gradient, new_gradient = new_gradient, gradient
                errors2, new_errors2 = new_errors2, errors2
                damping *= 0.1
                moved = max(moved, np.max(np.abs(step)))
            else:
                damping = max(damping * 10.0, 1e-4)
        if moved < _NEAR:
            break  # the points' places and weights would not change any more
    return pose, hessian, point_by_point(blocks, errors2)


def explained(rig: RigArrays, observations: Observations, cur_T_ref: Float, config: MotionConfig) -> tuple[Bool, Float]:
    """Determine which points (N,) are inliers of a motion (4, 4), and the errors (N,) of all, see `Refined`."""
    sigma, has_right = config.pixel_sigma_px, observations.has_right
    sigmas_px = np.full(len(rig.focal_px), sigma)
    blocks = in_blocks(observations)
    errors2 = _squared_errors(cur_T_ref, rig, blocks, unexpanded(blocks), sigmas_px)
    inlier = errors2 < inlier_cutoff(errors2, has_right, (config.max_error_px / sigma) ** 2)
    return np.asarray(inlier), _errors_px(errors2, has_right, sigmas_px[observations.pair])


@kernel
def _errors_px(errors2: Float, has_right: Bool, sigmas_px: Float) -> Float:
    """Convert squared whitened errors (N,) of points with a noise (N,) to pixels in one direction."""
    return sigmas_px * np.sqrt(errors2 / np.where(has_right, 4.0, 2.0))


@kernel
def _squared_errors(cur_T_ref: Float, rig: RigArrays, blocks: Blocks, at: Expansion, sigmas_px: Float) -> Float:
    """Compute squared whitened errors (N,), and expand ``at`` there."""
    motions = left_motions(cur_T_ref, rig)
    expand(motions, rig, blocks, sigmas_px, at)
    errors2 = np.empty((len(blocks.pair), POINTS))
    linearise(motions, rig, blocks, at, np.zeros_like(errors2), 1.0, np.empty((6, 6)), np.empty(6), errors2)
    return point_by_point(blocks, errors2)
