"""Do the pairs agree? Each pair's own motion against the others', by their covariances.

Two pairs that both see rigid scenes must report one motion. Where they do not, something fills a view and moves (a
door, a crowd), images are late, or the transfer between the pairs, eq. (1), is wrong. A motion refined on all points
is then a compromise that is right for nobody: each side's own motion is kept apart instead, and the better-supported
side comes first, as in eq. (4).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from graphvio.arrays import Bool
from graphvio.config.stages import MotionConfig
from graphvio.frontend.alignment import Misalignment, combined, placed
from graphvio.frontend.observations import Observations, RigArrays
from graphvio.frontend.ransac import search
from graphvio.frontend.refinement import Refined, refine
from graphvio.geometry import se3_inverse, se3_log

_BEYOND_5_SIGMA = 40.0  # chi-square of 6 degrees of freedom that a normal error exceeds once in 2 million
_BEYOND_2_SIGMA = 12.6  # once in 20: enough for pairs that contradicted each other a moment ago
_POORLY_EXPLAINED = 0.5  # share of a pair's points below which the pair looks for a motion of its own
_WELL_EXPLAINED = 0.9  # from there on its own motion is next to the joint one
_RIVAL_POINTS = 12
_UNLIKE_PX = 1.0  # less is a lens that is not quite known: such points are left out, but they are no second motion
_COMPARABLE = 0.85  # support over that of the best supported: support alone does not tell who is right
_UNEXPLAINED_SHARE = 0.12  # of all points, unexplained: from there on they may have a motion of their own
_NONE: Mapping[int, Misalignment] = {}


@dataclass(frozen=True, eq=False)
class Side:
    """Pairs that agree, and what they say together.

    Attributes:
        pairs: their indices.
        refined: the motion on their points; ``inlier`` (N,) covers the points of all pairs, False for other sides'.
    """

    pairs: tuple[int, ...]
    refined: Refined

    @property
    def support(self) -> int:
        """Number of points that the motion explains."""
        return int(self.refined.inlier.sum())


@dataclass(frozen=True, eq=False)
class Agreement:
    """What all pairs say.

    Attributes:
        sides: one if all pairs that see enough agree; else one for each opinion, the best supported first; of pairs
            with about as much support the lowest in number, from which the others' places are told.
        own: pair -> its own motion, of the pairs that see enough, as if the pair's place were known exactly.
        tension: the largest squared Mahalanobis distance between two pairs of one side, 0 for a single pair.
        contradicts: whether two pairs are beyond 5 sigma of each other.
    """

    sides: tuple[Side, ...]
    own: dict[int, Refined]
    tension: float = 0.0
    contradicts: bool = False


def agree(
    rig: RigArrays,
    observations: Observations,
    joint: Refined,
    config: MotionConfig,
    rng: np.random.Generator,
    misaligned: Mapping[int, Misalignment] = _NONE,
    in_doubt: bool = False,
) -> Agreement:
    """Compare the pairs' own motions with each other.

    Args:
        rig: of P pairs.
        observations: of any subset of them.
        joint: `graphvio.frontend.selection.joint_motion` of these.
        config: of this stage.
        rng: source of random triples.
        misaligned: pairs whose place has been corrected, which leaves it uncertain.
        in_doubt: the pairs contradicted each other a moment ago, so that less is enough to tell them apart now.
    """
    everyone = observations.pairs
    own: dict[int, Refined] = {}
    if len(everyone) > 1:
        motions = {j: _own_motion(rig, observations, j, joint, config, rng) for j in everyone}
        own = {j: motion for j, motion in motions.items() if is_supported(motion.inlier, config)}
    elif everyone:
        joint = placed(joint, misaligned.get(everyone[0]))
    opinions = {j: placed(motion, misaligned.get(j)) for j, motion in own.items()}
    apart = {(i, j): disagreement(opinions[i], opinions[j]) for i, j in combinations(sorted(opinions), 2)}
    camps = _camps(sorted(own, key=lambda j: -int(own[j].inlier.sum())), apart, in_doubt)
    tension = max((apart[pair] for camp in camps for pair in combinations(sorted(camp), 2)), default=0.0)
    if len(camps) > 1:
        sides = _in_order([_side(rig, observations, sorted(camp), own, opinions, misaligned, config) for camp in camps])
    else:
        if camps and not misaligned.keys().isdisjoint(camps[0]):
            joint = combined(joint, [opinions[j] for j in sorted(camps[0])])
        sides = [Side(everyone, joint)]
    second = _second_motion(rig, observations, sides, config, rng)
    if second is not None:
        sides = [second, *sides] if second.support > max(side.support for side in sides) else [*sides, second]
    return Agreement(tuple(sides), own, tension, max(apart.values(), default=0.0) >= _BEYOND_5_SIGMA)


def _camps(pairs: Sequence[int], apart: Mapping[tuple[int, int], float], in_doubt: bool) -> list[list[int]]:
    """Pairs, the best supported first, gathered so that within a camp each agrees with every other."""
    limit = _BEYOND_2_SIGMA if in_doubt else _BEYOND_5_SIGMA
    camps: list[list[int]] = []
    for j in pairs:
        for camp in camps:
            if all(apart[min(i, j), max(i, j)] < limit for i in camp):
                camp.append(j)
                break
        else:
            camps.append([j])
    return camps


def _in_order(sides: list[Side]) -> list[Side]:
    """The best supported first; but an error of P_12 puts no pair in the wrong, and to change sides would add it up."""
    enough = _COMPARABLE * max(side.support for side in sides)
    comparable = [side for side in sides if side.support >= enough]
    others = [side for side in sides if side.support < enough]
    return sorted(comparable, key=lambda side: side.pairs[0]) + sorted(others, key=lambda side: -side.support)


def disagreement(one: Refined, other: Refined) -> float:
    """Squared Mahalanobis distance between two motions of body over the same time, measured independently."""
    apart = se3_log(np.ascontiguousarray(one.cur_T_ref @ se3_inverse(other.cur_T_ref)))
    return float(apart @ np.linalg.solve(one.covariance + other.covariance, apart))


def is_supported(inlier: Bool, config: MotionConfig) -> bool:
    """Whether a motion explains enough of the points (N,) that it was estimated from."""
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
    share = float(inlier.mean())
    if share >= _WELL_EXPLAINED:
        return refine(rig, seen, joint.cur_T_ref, config, known=inlier)
    start = joint.cur_T_ref
    if share < _POORLY_EXPLAINED:
        start = search(rig, seen, start, config, rng)
    return refine(rig, seen, start, config)


def _side(
    rig: RigArrays,
    observations: Observations,
    camp: list[int],
    own: Mapping[int, Refined],
    opinions: Mapping[int, Refined],
    misaligned: Mapping[int, Misalignment],
    config: MotionConfig,
) -> Side:
    """The motion of pairs that agree."""
    rows = np.isin(observations.pair, camp)
    refined = opinions[camp[0]]
    if len(camp) > 1:
        first = own[max(camp, key=lambda j: int(own[j].inlier.sum()))]
        refined = refine(rig, observations.of_rows(rows), first.cur_T_ref, config)
        if not misaligned.keys().isdisjoint(camp):
            refined = combined(refined, [opinions[j] for j in camp])
    return Side(tuple(camp), _spread_over(rows, refined))


def _second_motion(
    rig: RigArrays, observations: Observations, sides: list[Side], config: MotionConfig, rng: np.random.Generator
) -> Side | None:
    """One more rigid motion, of most points that no side explains: the world's, or what moves in it."""
    errors_px = np.fmin.reduce([side.refined.errors_px for side in sides])  # of the side that likes a point best
    unlike = ~(errors_px < _UNLIKE_PX)
    rest = unlike & ~np.any([side.refined.inlier for side in sides], axis=0)
    if rest.sum() < max(_RIVAL_POINTS, _UNEXPLAINED_SHARE * len(rest)):
        return None
    seen = observations.of_rows(rest)
    refined = refine(rig, seen, search(rig, seen, sides[0].refined.cur_T_ref, config, rng), config)
    if refined.inlier.sum() < max(_RIVAL_POINTS, _POORLY_EXPLAINED * rest.sum()):
        return None
    return Side(seen.pairs, _spread_over(rest, refined))


def _spread_over(rows: Bool, refined: Refined) -> Refined:
    """A motion of some rows' points, its inliers and errors among all points."""
    inlier, errors_px = np.zeros(len(rows), dtype=bool), np.full(len(rows), np.nan)
    inlier[rows], errors_px[rows] = refined.inlier, refined.errors_px
    return replace(refined, inlier=inlier, errors_px=errors_px)
