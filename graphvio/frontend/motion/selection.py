"""Estimation of one motion from all pairs: the best pair's (section 3, eq. 3 and 4), or jointly (section 3.1)."""

from dataclasses import replace

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.config.stages import MotionConfig
from graphvio.frontend.motion.cost import camera_motions, robust_cost
from graphvio.frontend.motion.depth_scale import with_unknown_scales
from graphvio.frontend.motion.observations import Observations, RigArrays, is_depth_known
from graphvio.frontend.motion.ransac import search
from graphvio.frontend.motion.refinement import Refined, explained, refine

_MIN_SIGMAS = 3.0  # of a translation, beyond which its flow shows depths


def searched_and_refined(
    rig: RigArrays, observations: Observations, predicted: Float, config: MotionConfig, rng: np.random.Generator
) -> Refined:
    """Estimate one motion from some pairs, or from one, with depths as they are given (section 3.1).

    Hypotheses are scored on every pair, and the best one is refined.

    Args:
        rig: calibration of P pairs.
        observations: points of any subset of them.
        predicted: predicted ``cur_T_ref`` (4, 4), used as one more hypothesis.
        config: configuration of the motion stage.
        rng: source of the random triples.
    """
    has_known_depth = is_depth_known(rig, observations, config.pixel_sigma_px)
    searched = observations
    if has_known_depth.any() and not has_known_depth.all():
        searched = observations.of_rows(has_known_depth)
    return refine(rig, observations, search(rig, searched, predicted, config, rng), config)


def joint_motion(
    rig: RigArrays, observations: Observations, predicted: Float, config: MotionConfig, rng: np.random.Generator
) -> tuple[Refined, Observations]:
    """Estimate a motion as `searched_and_refined` does, while single cameras' points may hardly have a depth yet.

    The flow of a point of unknown depth may be any that some depth explains for the given translation. If the
    translation is about zero, its error determines these flows, and the minimum would be where the noise of such points
    is explained best. So the motion is first estimated from the other points, and the uncertainty of its translation is
    added to the rays of points of unknown depth as noise. The common scale of a single camera's depths is unknown in
    any case (`graphvio.frontend.motion.depth_scale`).

    Returns:
        The motion on all points, and the observations with that noise.
    """
    has_known_depth = is_depth_known(rig, observations, config.pixel_sigma_px)
    if has_known_depth.all() or has_known_depth.sum() < config.min_inliers:
        refined = searched_and_refined(rig, observations, predicted, config, rng)
        return with_unknown_scales(rig, observations, refined, config), observations
    first = searched_and_refined(rig, observations.of_rows(has_known_depth), predicted, config, rng)
    covariances, is_vague = observations.covariances.copy(), ~has_known_depth
    covariances[is_vague] = _with_noise_of_motion(
        covariances[is_vague], observations.pair[is_vague], rig, first, config.pixel_sigma_px
    )
    observations = observations._replace(covariances=covariances)
    refined = refine(rig, observations, first.cur_T_ref, config)
    return with_unknown_scales(rig, observations, refined, config), observations


def _with_noise_of_motion(covariances: Float, pair: Int, rig: RigArrays, first: Refined, sigma_px: float) -> Float:
    """Return covariances (V, 3, 3) of points of vague depth, enlarged by the uncertainty of a motion's translation.

    Args:
        covariances: (V, 3, 3) of the points, for a pixel noise of 1 px.
        pair: (V,) indices of their cameras.
        rig: calibration of P pairs and single cameras.
        first: the motion, estimated from other points.
        sigma_px: modelled pixel noise. If the actual noise is smaller, the depths are scaled to stay as vague as with
            the modelled one.
    """
    scale = np.array([1.0, 1.0, max(sigma_px / (first.rms_px() or sigma_px), 1.0)])
    vague = covariances * np.outer(scale, scale)
    translation = camera_motions(first.cur_T_ref, rig)[:, 0, :3, 3]
    variance = np.linalg.eigvalsh(first.covariance[3:, 3:])[-1]
    stands_out = np.maximum((translation**2).sum(axis=1) - _MIN_SIGMAS**2 * variance, 0.0)
    flow = (rig.focal_px[:, 0] ** 2 * stands_out)[pair]  # its information about inverse depths
    vague[:, :2, :2] += (variance / (1.0 / vague[:, 2, 2] + flow))[:, None, None] * np.eye(2)
    return np.asarray(vague)


def best_pair_motion(
    rig: RigArrays, observations: Observations, predicted: Float, config: MotionConfig, rng: np.random.Generator
) -> Refined:
    """Estimate a motion from each pair alone, and choose the one of least global cost, eq. (4).

    For arguments see `searched_and_refined`; for the plain equation `graphvio.frontend.motion.paper_method.best_pair`.
    """
    candidates = [
        searched_and_refined(rig, observations.of_pair(pair), predicted, config, rng) for pair in observations.pairs
    ]
    costs = [global_cost(rig, observations, candidate.cur_T_ref, config.cauchy_scale_px) for candidate in candidates]
    winner = candidates[int(np.argmin(costs))]
    inlier, errors_px = explained(rig, observations, winner.cur_T_ref, config)
    return replace(winner, inlier=inlier, errors_px=errors_px)


def global_cost(rig: RigArrays, observations: Observations, cur_T_ref: Float, cauchy_scale_px: float) -> float:
    """Compute the cost of a motion (4, 4) on the points of all pairs, eq. (3)."""
    rows = np.arange(len(observations.pair))
    return robust_cost(cur_T_ref, rig, observations, rows, cauchy_scale_px)
