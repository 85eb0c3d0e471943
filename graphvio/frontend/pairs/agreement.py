"""Agreement of the pairs: each pair's own motion is compared with the others', by their covariances.

Pairs that see a rigid scene all measure the same motion. If their motions differ, something that moves, such as a door
or a crowd, fills a view, or images are late, or the transfer between the pairs, eq. (1), is wrong. A motion refined on
all points would then be right for no pair. Instead, the motion of each consensus set is kept as a hypothesis, and the
better-supported one comes first, as in eq. (4).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.config.stages import MotionConfig
from graphvio.frontend.motion.depth_scale import with_scale_of_depths, with_unknown_scales
from graphvio.frontend.motion.observations import Observations, RigArrays, is_depth_known
from graphvio.frontend.motion.ransac import search
from graphvio.frontend.motion.refinement import Refined, refine
from graphvio.frontend.pairs.extrinsic_monitor import combined, placed
from graphvio.frontend.thresholds import THRESHOLDS
from graphvio.geometry import se3_compose, se3_inverse, se3_log
from graphvio.linear_algebra import squared_length

_T = THRESHOLDS.agreement
_NONE: Mapping[int, Float] = {}
_NOT_SHARED: Float = np.zeros((6, 1))

SharedErrors = Callable[[int, Bool, Float], Float]
"""Function of a pair's index, and of inliers (M,) and ``cur_T_ref`` (4, 4) of its own motion.

It returns the derivatives (6, K) of that motion, tangent ``[rotation, translation]``, with respect to K errors of unit
variance that all pairs have in common.
"""


@dataclass(frozen=True, eq=False)
class MotionHypothesis:
    """The motion of a consensus set of pairs.

    Attributes:
        pairs: Indices of the pairs, increasing.
        refined: The motion refined on their points; ``inlier`` (N,) covers the points of all pairs, and is False for
            points of other consensus sets.
    """

    pairs: tuple[int, ...]
    refined: Refined

    @property
    def support(self) -> int:
        """Number of points that the motion explains."""
        return int(self.refined.inlier.sum())


@dataclass(frozen=True, eq=False)
class Agreement:
    """The motions of all pairs, compared with each other.

    Attributes:
        hypotheses: One if all pairs with enough inliers agree; else one for each consensus set, the best supported
            first. Among sets of comparable support, the one with the lowest pair index comes first, since extrinsics
            are relative to pair 0. If many points fit none of them, a second rigid motion is one more hypothesis.
        own: Pair index -> its own motion, for pairs with enough inliers, as if the extrinsics were exact. Its
            covariance includes that of errors that the pairs have in common.
        max_distance: Largest squared Mahalanobis distance between two pairs of a consensus set, 0 for a single pair.
        contradicts: Whether the motions of two pairs differ by more than 5 sigma.
    """

    hypotheses: tuple[MotionHypothesis, ...]
    own: dict[int, Refined]
    max_distance: float = 0.0
    contradicts: bool = False


def agree(
    rig: RigArrays,
    observations: Observations,
    joint: Refined,
    config: MotionConfig,
    rng: np.random.Generator,
    uncertain: Mapping[int, Float] = _NONE,
    in_doubt: bool = False,
    shared_errors: SharedErrors | None = None,
) -> Agreement:
    """Compare the pairs' own motions, and return the motion of each consensus set.

    Args:
        rig: Calibration of P pairs.
        observations: Points of any subset of them.
        joint: Motion on all these points, from `graphvio.frontend.motion.selection.joint_motion`.
        config: Configuration of the motion stage.
        rng: Source of random triples.
        uncertain: Pair index -> covariance (6, 6) of the error d of its extrinsics, which are ``exp(d) body_T_left``,
            for pairs whose extrinsics have been corrected or are not known exactly.
        in_doubt: Whether the pairs contradicted each other a moment ago; the largest distance of motions that agree is
            then smaller.
        shared_errors: Errors that all pairs have in common, or None if there are none.
    """
    everyone = observations.pairs
    own: dict[int, Refined] = {}
    if len(everyone) > 1:
        motions = {j: _own_motion(rig, observations, j, joint, config, rng) for j in everyone}
        own = {j: motion for j, motion in motions.items() if is_supported(motion.inlier, config)}
    elif everyone:
        joint = placed(joint, uncertain.get(everyone[0]))
    placed_motions = {j: placed(motion, uncertain.get(j)) for j, motion in own.items()}
    shared = {
        j: _NOT_SHARED if shared_errors is None else shared_errors(j, motion.inlier, motion.cur_T_ref)
        for j, motion in own.items()
    }
    apart = {
        (i, j): disagreement(placed_motions[i], placed_motions[j], shared[i] - shared[j])
        for i, j in combinations(sorted(placed_motions), 2)
    }
    sets = _consensus_sets(sorted(own, key=lambda j: -int(own[j].inlier.sum())), apart, in_doubt)
    max_distance = max((apart[pair] for pairs in sets for pair in combinations(sorted(pairs), 2)), default=0.0)
    if len(sets) > 1:
        hypotheses = _in_order(
            [_hypothesis(rig, observations, sorted(pairs), own, placed_motions, uncertain, config) for pairs in sets],
            frozenset(j for j in own if rig.is_single[j] and j in uncertain),
        )
    else:
        if sets and not uncertain.keys().isdisjoint(sets[0]):
            joint = combined(joint, [placed_motions[j] for j in sorted(sets[0])])
        hypotheses = [MotionHypothesis(everyone, joint)]
    second = _second_motion(rig, observations, hypotheses, config, rng)
    if second is not None:
        best = max(hypothesis.support for hypothesis in hypotheses)
        hypotheses = [second, *hypotheses] if second.support > best else [*hypotheses, second]
    own = {j: replace(each, covariance=each.covariance + shared[j] @ shared[j].T) for j, each in own.items()}
    return Agreement(tuple(hypotheses), own, max_distance, max(apart.values(), default=0.0) >= _T.max_distance)


def _consensus_sets(pairs: Sequence[int], apart: Mapping[tuple[int, int], float], in_doubt: bool) -> list[list[int]]:
    """Group pairs, given with the best supported first, into sets in which each pair agrees with every other."""
    limit = _T.max_distance_in_doubt if in_doubt else _T.max_distance
    sets: list[list[int]] = []
    for j in pairs:
        for members in sets:
            if all(apart[min(i, j), max(i, j)] < limit for i in members):
                members.append(j)
                break
        else:
            sets.append([j])
    return sets


def _in_order(hypotheses: list[MotionHypothesis], unknown: frozenset[int] = frozenset()) -> list[MotionHypothesis]:
    """Sort hypotheses by support, or by their lowest pair if their support is comparable.

    With wrong extrinsics, each of several pairs measures its own motion correctly, and alternating between them would
    accumulate the error. Hypotheses of only ``unknown`` groups, single cameras of unknown extrinsics, come last.
    """
    last = [hypothesis for hypothesis in hypotheses if unknown.issuperset(hypothesis.pairs)]
    hypotheses = [hypothesis for hypothesis in hypotheses if not unknown.issuperset(hypothesis.pairs)] or last
    enough = _T.min_comparable_support * max(hypothesis.support for hypothesis in hypotheses)
    comparable = [hypothesis for hypothesis in hypotheses if hypothesis.support >= enough]
    others = [hypothesis for hypothesis in hypotheses if hypothesis.support < enough]
    ordered = sorted(comparable, key=lambda each: each.pairs[0]) + sorted(others, key=lambda each: -each.support)
    return ordered if hypotheses is last else ordered + last


def disagreement(one: Refined, other: Refined, by_shared: Float = _NOT_SHARED) -> float:
    """Return the squared Mahalanobis distance between two measurements of one motion of body.

    Args:
        one: a measurement.
        other: another one, independent of it but for ``by_shared``.
        by_shared: (6, K) derivatives of their difference with respect to K errors of unit variance that both have in
            common.
    """
    apart = se3_log(se3_compose(one.cur_T_ref, se3_inverse(other.cur_T_ref)))
    return squared_length(apart, one.covariance + other.covariance + by_shared @ by_shared.T)


def is_supported(inlier: Bool, config: MotionConfig) -> bool:
    """Return whether a motion explains enough of the points (N,) that it was estimated from."""
    return bool(inlier.sum() >= max(config.min_inliers, config.min_inlier_share * len(inlier)))


def _own_motion(
    rig: RigArrays,
    observations: Observations,
    pair: int,
    joint: Refined,
    config: MotionConfig,
    rng: np.random.Generator,
) -> Refined:
    seen, inlier = observations.of_pair(pair), joint.inlier[observations.pair == pair]
    if rig.is_single[pair]:
        return _own_motion_of_single(rig, seen, joint, config)
    share = float(inlier.mean())
    if share >= _T.min_joint_share:
        return refine(rig, seen, joint.cur_T_ref, config, known_inlier=inlier)
    start = joint.cur_T_ref
    if share < _T.max_searched_share:
        start = search(rig, seen, start, config, rng)
    return refine(rig, seen, start, config)


def _own_motion_of_single(rig: RigArrays, seen: Observations, joint: Refined, config: MotionConfig) -> Refined:
    """Refine the joint motion on the points of a single camera whose depth is known; others are not tested."""
    known = seen.has_known_depth(config.pixel_sigma_px)
    if not known.any():
        return replace(joint, inlier=np.zeros(len(known), dtype=bool), errors_px=np.full(len(known), np.nan))
    refined = refine(rig, seen.of_rows(known), joint.cur_T_ref, config)
    return _spread_over(known, with_scale_of_depths(rig, int(seen.pair[0]), refined))


def _hypothesis(
    rig: RigArrays,
    observations: Observations,
    pairs: list[int],
    own: Mapping[int, Refined],
    placed_motions: Mapping[int, Refined],
    uncertain: Mapping[int, Float],
    config: MotionConfig,
) -> MotionHypothesis:
    """Return the motion of a consensus set."""
    rows = np.isin(observations.pair, pairs)
    refined = placed_motions[pairs[0]]
    if len(pairs) > 1:
        first = own[max(pairs, key=lambda j: int(own[j].inlier.sum()))]
        seen = observations.of_rows(rows)
        refined = with_unknown_scales(rig, seen, refine(rig, seen, first.cur_T_ref, config), config)
        if not uncertain.keys().isdisjoint(pairs):
            refined = combined(refined, [placed_motions[j] for j in pairs])
    return MotionHypothesis(tuple(pairs), _spread_over(rows, refined))


def _second_motion(
    rig: RigArrays,
    observations: Observations,
    hypotheses: list[MotionHypothesis],
    config: MotionConfig,
    rng: np.random.Generator,
) -> MotionHypothesis | None:
    """Find one more rigid motion that most of the unexplained points follow, or return None.

    It may be the motion relative to the world, or relative to an object that moves. Points of unknown depth do not
    count: nearly any motion explains them.
    """
    errors_px = np.fmin.reduce([each.refined.errors_px for each in hypotheses])
    testable = is_depth_known(rig, observations, config.pixel_sigma_px)
    unlike = testable & ~(errors_px < _T.min_unlike_px)
    unexplained = unlike & ~np.any([each.refined.inlier for each in hypotheses], axis=0)
    if unexplained.sum() < max(_T.min_rival_points, _T.min_unexplained_share * testable.sum()):
        return None
    seen = observations.of_rows(unexplained)
    refined = refine(rig, seen, search(rig, seen, hypotheses[0].refined.cur_T_ref, config, rng), config)
    if refined.inlier.sum() < max(_T.min_rival_points, _T.min_rival_share * unexplained.sum()):
        return None
    return MotionHypothesis(seen.pairs, _spread_over(unexplained, refined))


def _spread_over(rows: Bool, refined: Refined) -> Refined:
    """Extend the inliers and errors of a motion from the points in some rows, a mask (N,), to all N points."""
    inlier, errors_px = np.zeros(len(rows), dtype=bool), np.full(len(rows), np.nan)
    inlier[rows], errors_px[rows] = refined.inlier, refined.errors_px
    return replace(refined, inlier=inlier, errors_px=errors_px)
