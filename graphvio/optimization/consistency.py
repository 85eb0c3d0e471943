"""Which loop closures to believe: those that agree with the odometry and with each other.

Fragments, which are the epochs of the sessions, are first joined by the transforms on which most closures between them
agree. Closures are then weighed by graduated non-convexity (H. Yang, P. Antonante, V. Tzoumas, L. Carlone, RA-L 2020),
in a graph that holds their ends only: the odometry between two ends is one factor, with the covariance that the full
graph has for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import gtsam
import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.backend.factors import x
from graphvio.backend.gating import chi_square_quantile
from graphvio.backend.noise import isotropic
from graphvio.geometry import se3_inverse, se3_log
from graphvio.optimization.solver import Edge, Marginals

_AGREE_M = 0.5
_AGREE_RAD = 0.1
_LEAST_VOTES = 3
_STRONG_POINTS = 100  # of a closure that may vote: fewer may be one thing that two places have alike
_FRAME_SIGMA = 1e-6
_JOINED_SIGMAS = np.repeat([_AGREE_RAD, _AGREE_M], 3)  # of how fragments lie to each other before closures are weighed


class KnownMotions(Protocol):
    """Who knows the motion between any two states of a fragment; `Marginals` of a solution do."""

    def motion(self, first: int, second: int) -> tuple[Float, Float]:
        """``first_T_second`` (4, 4) and its covariance (6, 6), in body at the second."""

    def distance(self, edge: Edge) -> float:
        """Squared Mahalanobis distance of a closure that it does not rest on, 6 degrees of freedom."""


@dataclass(frozen=True, eq=False)
class Joined:
    """Fragments in common frames.

    Attributes:
        frames: of each fragment, ``frame_T_nav`` (4, 4).
        component: of each fragment, the fragment whose nav frame it is in.
    """

    frames: list[Float]
    component: list[int]


def join_fragments(fragments: Sequence[range], poses: Float, edges: Sequence[Edge], inliers: Sequence[int]) -> Joined:
    """Bring fragments that closures tie into the frame of the first of them.

    Args:
        fragments: states of each, which share a nav frame.
        poses: (N, 4, 4) of all states, in their fragments' frames.
        edges: closures, right and wrong ones.
        inliers: points of each closure.
    """
    of = fragment_of(fragments)
    frames = [np.eye(4) for _ in fragments]
    component = list(range(len(fragments)))
    between = [
        (int(of[edge.first]), int(of[edge.second]), edge)
        for edge, points in zip(edges, inliers, strict=True)
        if of[edge.first] != of[edge.second] and points >= _STRONG_POINTS
    ]
    while True:
        offers: dict[tuple[int, int], list[Float]] = {}
        for one, other, edge in between:
            a, c = component[one], component[other]
            if a == c:
                continue
            c_T_second = frames[other] @ poses[edge.second]
            a_T_c = frames[one] @ poses[edge.first] @ edge.first_T_second @ se3_inverse(c_T_second)
            if a < c:
                offers.setdefault((a, c), []).append(a_T_c)
            else:
                offers.setdefault((c, a), []).append(se3_inverse(a_T_c))
        best = max(
            ((*_most_voted(transforms), pair) for pair, transforms in offers.items()),
            key=lambda each: (each[0], (-each[2][0], -each[2][1])),
            default=None,
        )
        if best is None or best[0] < _LEAST_VOTES:
            return Joined(frames, component)
        _, a_T_c, (a, c) = best
        for number in range(len(fragments)):
            if component[number] == c:
                frames[number], component[number] = a_T_c @ frames[number], a


def fragment_of(fragments: Sequence[range]) -> Int:
    """Number (N,) of the fragment of each state."""
    return np.repeat(np.arange(len(fragments)), [len(states) for states in fragments])


def consistent(
    fragments: Sequence[range],
    joined: Joined,
    poses: Float,
    edges: Sequence[Edge],
    alone: KnownMotions,
    probability: float,
) -> tuple[Bool, Float]:
    """Which closures (L,) agree with the odometry and with each other.

    Where many are wrong, a first solution with all of them lies far from the truth, and graduated non-convexity does
    not always find back: what the odometry alone refutes is left out before.

    Args:
        fragments: states of each.
        joined: how they lie to each other; closures between those that are not joined are left out.
        poses: (N, 4, 4) of all states, in the frames that are common now.
        edges: L closures.
        alone: of the solution without closures.
        probability: a closure beyond this share of the chi-square distribution is refused.

    Returns:
        Which agree, and their squared distances (L,) from what is known without any, 6 degrees of freedom: from the
        odometry, or between fragments from how these are joined; NaN where they are not.
    """
    of = fragment_of(fragments)
    component = np.array(joined.component)[of]
    limit = chi_square_quantile(probability, 6)
    distances, asked = np.full(len(edges), np.nan), []
    for k, edge in enumerate(edges):
        if of[edge.first] == of[edge.second]:
            distances[k] = alone.distance(edge)
            may_be_used = distances[k] <= limit
        else:
            may_be_used = component[edge.first] == component[edge.second]
        if may_be_used:
            asked.append(k)
    ends = sorted({end for k in asked for end in (edges[k].first, edges[k].second)})
    graph, values = _ends_only(ends, of, joined, poses, _odometry_between(alone, fragments, ends))
    kept = np.zeros(len(edges), dtype=bool)
    across = [k for k in asked if of[edges[k].first] != of[edges[k].second]]
    if across:
        as_joined = Marginals(graph, values)
        for k in across:
            distances[k] = as_joined.distance(edges[k])
    asked = [k for k in asked if distances[k] <= limit]
    if not asked:
        return kept, distances
    known = list(range(graph.size()))
    for k in asked:
        graph.add(edges[k].factor())
    params = gtsam.GncLMParams()
    params.setKnownInliers(known)
    params.setLossType(gtsam.GncLossType.TLS)
    optimizer = gtsam.GncLMOptimizer(graph, values, params)
    optimizer.setInlierCostThresholdsAtProbability(probability)
    solution = optimizer.optimize()
    for place, k in enumerate(asked, start=len(known)):
        kept[k] = 2.0 * graph.at(place).error(solution) <= limit
    return kept, distances


def _ends_only(
    ends: Sequence[int], of: Int, joined: Joined, poses: Float, odometry: Sequence[Edge]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A graph of the states that are ends of closures; each fragment lies to its root as the votes have it, about."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    seen: set[int] = set()
    for end in ends:
        values.insert(x(end), gtsam.Pose3(poses[end]))
        if of[end] not in seen:
            seen.add(int(of[end]))
            is_root = joined.component[of[end]] == of[end]
            noise = isotropic(6, _FRAME_SIGMA) if is_root else gtsam.noiseModel.Diagonal.Sigmas(_JOINED_SIGMAS)
            graph.add(gtsam.PriorFactorPose3(x(end), gtsam.Pose3(poses[end]), noise))
    for edge in odometry:
        graph.add(edge.factor())
    return graph, values


def _odometry_between(marginals: KnownMotions, fragments: Sequence[range], ends: Sequence[int]) -> list[Edge]:
    """The motion between the states of each fragment that are ends of closures, with its covariance.

    Args:
        marginals: of the solution without closures.
        fragments: states of each.
        ends: states, increasing.
    """
    made = []
    for states in fragments:
        inside = [end for end in ends if end in states]
        for first, second in pairwise(inside):
            made.append(Edge(first, second, *marginals.motion(first, second)))
    return made


def _most_voted(transforms: Sequence[Float]) -> tuple[int, Float]:
    """The transform with which most others agree, and how many do, itself included."""
    votes = []
    for one in transforms:
        errors = np.array([se3_log(se3_inverse(one) @ other) for other in transforms])
        near = (np.linalg.norm(errors[:, :3], axis=1) < _AGREE_RAD) & (np.linalg.norm(errors[:, 3:], axis=1) < _AGREE_M)
        votes.append(int(near.sum()))
    best = int(np.argmax(votes))
    return votes[best], transforms[best]
