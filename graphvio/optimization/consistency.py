"""Selection of loop closures that are consistent with the odometry and with each other.

A fragment is one epoch of a session. Fragments are first joined by the transform on which most closures between them
agree. Outliers are then rejected by graduated non-convexity (H. Yang, P. Antonante, V. Tzoumas, L. Carlone, RA-L 2020)
in a graph that has only the states in which closures end: the odometry between two such states is one factor, with its
covariance from the full graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.backend.factors import x
from graphvio.backend.gating import chi_square_quantile
from graphvio.backend.noise import isotropic
from graphvio.geometry import se3_inverse, se3_log
from graphvio.optimization.solver import Edge, KnownMotions, Marginals

_MAX_DIFFERENCE_M = 0.5  # between the transforms of closures that agree
_MAX_DIFFERENCE_RAD = 0.1
_MIN_VOTES = 3
_MIN_POINTS = 100  # inliers of a closure that votes: fewer may be on one object that two places have in common
_FRAME_SIGMA = 1e-6
_JOINED_SIGMAS = np.repeat([_MAX_DIFFERENCE_RAD, _MAX_DIFFERENCE_M], 3)  # of the transforms found by vote


@dataclass(frozen=True, eq=False)
class Joined:
    """The transforms of fragments into common frames."""

    frames: list[Float]  # ``frame_T_nav`` (4, 4) of each fragment
    component: list[int]  # for each fragment, the one whose nav frame is the common frame


def join_fragments(fragments: Sequence[range], poses: Float, edges: Sequence[Edge], inliers: Sequence[int]) -> Joined:
    """Transform each group of fragments that loop closures join into the frame of the group's first fragment.

    Args:
        fragments: states of each fragment.
        poses: poses (N, 4, 4) of all states, in their fragments' nav frames.
        edges: true and false loop closures.
        inliers: number of points of each loop closure.
    """
    of = fragment_of(fragments)
    frames = [np.eye(4) for _ in fragments]
    component = list(range(len(fragments)))
    between = [
        (int(of[edge.first]), int(of[edge.second]), edge)
        for edge, points in zip(edges, inliers, strict=True)
        if of[edge.first] != of[edge.second] and points >= _MIN_POINTS
    ]
    while True:
        transforms_of: dict[tuple[int, int], list[Float]] = {}
        for one, other, edge in between:
            a, c = component[one], component[other]
            if a == c:
                continue
            c_T_second = frames[other] @ poses[edge.second]
            a_T_c = frames[one] @ poses[edge.first] @ edge.first_T_second @ se3_inverse(c_T_second)
            if a < c:
                transforms_of.setdefault((a, c), []).append(a_T_c)
            else:
                transforms_of.setdefault((c, a), []).append(se3_inverse(a_T_c))
        best = max(
            ((*_most_voted(transforms), pair) for pair, transforms in transforms_of.items()),
            key=lambda each: (each[0], (-each[2][0], -each[2][1])),
            default=None,
        )
        if best is None or best[0] < _MIN_VOTES:
            return Joined(frames, component)
        _, a_T_c, (a, c) = best
        for number in range(len(fragments)):
            if component[number] == c:
                frames[number], component[number] = a_T_c @ frames[number], a


def fragment_of(fragments: Sequence[range]) -> Int:
    """Return the number of each state's fragment (N,)."""
    return np.repeat(np.arange(len(fragments)), [len(states) for states in fragments])


def consistent(
    fragments: Sequence[range],
    joined: Joined,
    poses: Float,
    edges: Sequence[Edge],
    odometry: KnownMotions,
    probability: float,
) -> tuple[Bool, Float]:
    """Return which loop closures (L,) are consistent with the odometry and with each other, and squared distances (L,).

    A distance is a squared Mahalanobis distance with 6 degrees of freedom: of a closure within a fragment, from the
    odometry; of one between fragments, from their joined transform, or NaN where they are not joined.

    If many closures are wrong, the initial solution with all of them is far from the truth, and graduated non-convexity
    does not always converge: closures that contradict the odometry are therefore rejected first.

    Args:
        fragments: states of each fragment.
        joined: transforms of the fragments; closures between fragments that are not joined are rejected.
        poses: poses (N, 4, 4) of all states, in the joined frames.
        edges: L loop closures.
        odometry: motions between states in the solution without loop closures.
        probability: quantile of the chi-square distribution at which a closure is rejected.
    """
    of = fragment_of(fragments)
    component = np.array(joined.component)[of]
    limit = chi_square_quantile(probability, 6)
    distances, candidates = np.full(len(edges), np.nan), []
    for k, edge in enumerate(edges):
        if of[edge.first] == of[edge.second]:
            distances[k] = edge.distance(odometry)
            is_candidate = distances[k] <= limit
        else:
            is_candidate = component[edge.first] == component[edge.second]
        if is_candidate:
            candidates.append(k)
    ends = sorted({end for k in candidates for end in (edges[k].first, edges[k].second)})
    graph, values = _ends_only(ends, of, joined, poses, _odometry_between(odometry, fragments, ends))
    kept = np.zeros(len(edges), dtype=bool)
    across = [k for k in candidates if of[edges[k].first] != of[edges[k].second]]
    if across:
        as_joined = Marginals(graph, values)
        for k in across:
            distances[k] = edges[k].distance(as_joined)
    candidates = [k for k in candidates if distances[k] <= limit]
    if not candidates:
        return kept, distances
    known = list(range(graph.size()))
    for k in candidates:
        graph.add(edges[k].factor())
    params = gtsam.GncLMParams()
    params.setKnownInliers(known)
    params.setLossType(gtsam.GncLossType.TLS)
    # Iterate until all weights are 0 or 1: if one closure is far off, the first weights of all are below any tolerance.
    params.setWeightsTol(0.0)
    optimizer = gtsam.GncLMOptimizer(graph, values, params)
    optimizer.setInlierCostThresholdsAtProbability(probability)
    solution = optimizer.optimize()
    for index, k in enumerate(candidates, start=len(known)):
        kept[k] = 2.0 * graph.at(index).error(solution) <= limit
    return kept, distances


def _ends_only(
    ends: Sequence[int], of: Int, joined: Joined, poses: Float, odometry: Sequence[Edge]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return a graph of the closures' end states; each fragment's first has a prior, which is weak unless in a root."""
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


def _odometry_between(odometry: KnownMotions, fragments: Sequence[range], ends: Sequence[int]) -> list[Edge]:
    """Return the odometry between successive end states of each fragment as edges; ``ends`` increase."""
    edges = []
    for states in fragments:
        inside = [end for end in ends if end in states]
        for first, second in pairwise(inside):
            edges.append(Edge(first, second, *odometry.motion(first, second)))
    return edges


def _most_voted(transforms: Sequence[Float]) -> tuple[int, Float]:
    """Return the number of votes, its own included, of the transform that most others agree with, and the transform."""
    votes = []
    for one in transforms:
        errors = np.array([se3_log(se3_inverse(one) @ other) for other in transforms])
        angles, distances = np.linalg.norm(errors[:, :3], axis=1), np.linalg.norm(errors[:, 3:], axis=1)
        votes.append(int(((angles < _MAX_DIFFERENCE_RAD) & (distances < _MAX_DIFFERENCE_M)).sum()))
    best = int(np.argmax(votes))
    return votes[best], transforms[best]
