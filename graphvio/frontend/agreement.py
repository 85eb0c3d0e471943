"""Do the pairs agree? Each pair's own motion against the others', by their covariances.

Two pairs that both see rigid scenes must report one motion. Where they do not, something fills a view and moves (a
door, a crowd), images are late, or the transfer between the pairs, eq. (1), is wrong. A motion refined on all points
is then a compromise that is right for nobody: each side's own motion is kept apart instead, and the better-supported
side comes first, as in eq. (4).
"""

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.config import MotionConfig
from graphvio.frontend.observations import Observations, RigArrays
from graphvio.frontend.ransac import search
from graphvio.frontend.refinement import Refined, explained, refine
from graphvio.geometry import se3_inverse, se3_log

_BEYOND_5_SIGMA = 40.0  # chi-square of 6 degrees of freedom that a normal error exceeds once in 2 million
_POORLY_EXPLAINED = 0.5  # share of a pair's points below which the pair looks for a motion of its own


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
        sides: one if all pairs that see enough agree; else one for each opinion, the best supported first.
        own: pair -> its own motion, of the pairs that see enough.
    """

    sides: tuple[Side, ...]
    own: dict[int, Refined]


def agree(
    rig: RigArrays, observations: Observations, joint: Refined, config: MotionConfig, rng: np.random.Generator
) -> Agreement:
    """Compare the pairs' own motions; arguments as of `graphvio.frontend.selection.joint_motion`, and its result."""
    everyone = tuple(int(j) for j in np.unique(observations.pair))
    together = Side(everyone, joint)
    own = {j: _own_motion(rig, observations.of_pair(j), joint, config, rng) for j in everyone} if everyone[1:] else {}
    own = {j: motion for j, motion in own.items() if is_supported(motion.inlier, config)}
    camps: list[list[int]] = []
    for j in sorted(own, key=lambda j: -int(own[j].inlier.sum())):
        for camp in camps:
            if disagreement(own[camp[0]], own[j]) < _BEYOND_5_SIGMA:
                camp.append(j)
                break
        else:
            camps.append([j])
    if len(camps) < 2:
        return Agreement((together,), own)
    sides = [_side(rig, observations, sorted(camp), own, joint, config) for camp in camps]
    return Agreement(tuple(sorted(sides, key=lambda side: -side.support)), own)


def disagreement(one: Refined, other: Refined) -> float:
    """Squared Mahalanobis distance between two motions of body over the same time, measured independently."""
    apart = se3_log(np.ascontiguousarray(one.cur_T_ref @ se3_inverse(other.cur_T_ref)))
    return float(apart @ np.linalg.solve(one.covariance + other.covariance, apart))


def is_supported(inlier: Bool, config: MotionConfig) -> bool:
    """Whether a motion explains enough of the points (N,) that it was estimated from."""
    return bool(inlier.sum() >= max(config.min_inliers, config.min_inlier_share * len(inlier)))


def _own_motion(
    rig: RigArrays, observations: Observations, joint: Refined, config: MotionConfig, rng: np.random.Generator
) -> Refined:
    start: Float = joint.cur_T_ref
    if np.mean(explained(rig, observations, start, config)) < _POORLY_EXPLAINED:
        start = search(rig, observations, start, config, rng)
    return refine(rig, observations, start, config)


def _side(
    rig: RigArrays,
    observations: Observations,
    camp: list[int],
    own: dict[int, Refined],
    joint: Refined,
    config: MotionConfig,
) -> Side:
    rows = np.isin(observations.pair, camp)
    first = own[max(camp, key=lambda j: int(own[j].inlier.sum()))]
    refined = first
    if len(camp) > 1:
        refined = refine(rig, Observations(*(column[rows] for column in observations)), first.cur_T_ref, config)
    inlier = np.zeros(len(rows), dtype=bool)
    inlier[rows] = refined.inlier
    return Side(
        tuple(camp),
        Refined(refined.cur_T_ref, refined.covariance, refined.shared_covariance, inlier, refined.rms_px),
    )
