"""The map's pose graph: chains of places, and the closures between them.

A closure that contradicts the odometry between its ends is refuted for good. A closure that is consistent with the
present solution is used; others are doubted. When there are enough doubted closures, or closures that join fragments,
all closures are tested again together, as for recorded sessions (`graphvio.optimization.consistency`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.factors import x
from graphvio.backend.gating import chi_square_quantile
from graphvio.geometry import se3_inverse
from graphvio.mapping.chains import EXACT, Chains
from graphvio.mapping.places import composed
from graphvio.optimization.consistency import Joined, consistent, join_fragments
from graphvio.optimization.loops.closures import LoopClosure
from graphvio.optimization.solver import Edge, Marginals, solve

_MAX_VOTES = 30  # closures that vote for the transform between two fragments: each is compared with all others
_MIN_DOUBTS = 3  # number of doubted closures from which all closures are tested again
_MIN_DOUBTED_SHARE = 0.1  # the same as a share of the used closures; the larger number counts
_MAX_RECONSIDERED = 50  # newest closures, of which doubted ones are used as soon as the solution agrees with them
_MAX_SIGHT_M = 10.0  # places that are farther apart have little in common that stereo measures well
_SIGHT_SIGMAS = 4.0  # standard deviations of both positions that are added to this distance
_MAX_ROUNDS = 3  # in which rejected closures are used after all if the solution agrees with them


@dataclass(eq=False)
class TestedClosure:
    """A closure between two places of the graph, whose rows are the places' indices."""

    closure: LoopClosure  # the closure as it was found
    is_used: bool = False  # whether the solution uses it
    is_refuted: bool = False  # whether it contradicts the odometry alone

    @cached_property
    def edge(self) -> Edge:
        """The closure as an edge between two places of the graph."""
        found = self.closure
        return Edge(found.reference.row, found.current.row, found.reference_T_current, found.covariance)


class PoseGraph:
    """Places and their poses; a component of joined fragments has the frame of its first fragment.

    Args:
        probability: Probability of the quantile of the chi-square distribution beyond which a closure is rejected.
        chains: Chains of an earlier map.
        closures: Closures of an earlier map.
        poses: (N, 4, 4) poses of an earlier map.
        component: For each of its fragments, the fragment in whose frame it is.
        bounds: (N, 6, 6) covariances of the poses, or upper bounds of them.
    """

    def __init__(
        self,
        probability: float,
        chains: Chains | None = None,
        closures: Sequence[TestedClosure] = (),
        poses: Sequence[Float] = (),
        component: Sequence[int] = (),
        bounds: Sequence[Float] = (),
    ) -> None:
        self.chains = Chains() if chains is None else chains
        self.closures = list(closures)
        self._probability = probability
        self._limit = chi_square_quantile(probability, 6)
        self._poses = list(poses)
        self._component = list(component)
        self._bounds = list(bounds)
        self._marginals_of: dict[int, Marginals] = {}  # component -> marginals, if it has not changed since
        self._doubts = 0

    def __len__(self) -> int:
        return len(self._poses)

    def begin(self, odom_T_body: Float) -> None:
        """Add the first place of a fragment by its pose (4, 4) in odom."""
        self.chains.begin(odom_T_body)
        self._poses.append(odom_T_body)
        self._component.append(len(self._component))
        self._bounds.append(EXACT)

    def add(self, previous_T_body: Float, covariance: Float) -> None:
        """Add a place to the last fragment by its motion (4, 4) from the previous place, with covariance (6, 6)."""
        self.chains.add(previous_T_body, covariance)
        pose, bound = composed(self._poses[-1], self._bounds[-1], previous_T_body, covariance)
        self._poses.append(pose)
        self._bounds.append(bound)
        self._marginals_of.pop(self._component[-1], None)

    @property
    def component(self) -> list[int]:
        """For each fragment, the fragment in whose odom frame it is; 0 is the map's frame."""
        return list(self._component)

    def is_in_map(self, place: int) -> bool:
        """Return whether a place is in the map's frame, which is the first fragment's odom frame."""
        return self._component_of(place) == 0

    def pose(self, place: int) -> Float:
        """Return the pose (4, 4) of a place in its component's frame."""
        return self._poses[place]

    def covariance(self, place: int) -> Float:
        """Return a pose's covariance (6, 6) relative to the component's first place, tangent in body."""
        return self._marginals(self._component_of(place)).variable(x(place))

    def may_see(self, one: int, other: int) -> bool:
        """Return whether two places may be near enough to see the same points; true if in different components."""
        if self._component_of(one) != self._component_of(other):
            return True
        sigma_m = sum(float(np.sqrt(np.trace(self._bounds[place][3:, 3:]))) for place in (one, other))
        distance_m = np.linalg.norm(self._poses[one][:3, 3] - self._poses[other][:3, 3])
        return bool(distance_m <= _MAX_SIGHT_M + _SIGHT_SIGMAS * sigma_m)

    def add_closures(self, found: Sequence[LoopClosure]) -> bool:
        """Test and add closures, whose rows are places of the graph; returns whether the solution has changed.

        Raises:
            OptimizationError: If the graph cannot be solved.
        """
        is_new, asks_votes = False, False
        for closure in found:
            one, other, tested = closure.reference.row, closure.current.row, TestedClosure(closure)
            self.closures.append(tested)
            is_inside = self.chains.fragment(one) == self.chains.fragment(other)
            if is_inside and tested.edge.distance(self.chains) > self._limit:
                tested.is_refuted = True
            elif self._component_of(one) != self._component_of(other):
                asks_votes = True
            elif tested.edge.distance(self._marginals(self._component_of(one))) <= self._limit:
                tested.is_used = is_new = True
            else:
                self._doubts += 1
        newest = self._component[-1]
        is_new |= self._take_up_doubted(newest)
        used = sum(each.is_used for each in self.closures)
        if (asks_votes and self._joined().component != self._component) or self._doubts >= max(
            _MIN_DOUBTS, _MIN_DOUBTED_SHARE * used
        ):
            return self._test_all()
        if is_new:
            self._solve(newest)
            self._bounds[-1] = self.covariance(len(self) - 1)  # for older places, the previous covariance is a bound
        return is_new

    def _take_up_doubted(self, root: int) -> bool:
        """Use the doubted closures of a component that the solution agrees with by now; return whether any are."""
        taken = False
        for each in self.closures[-_MAX_RECONSIDERED:]:
            ends = {self._component_of(each.edge.first), self._component_of(each.edge.second)}
            if each.is_used or each.is_refuted or ends != {root}:
                continue
            if each.edge.distance(self._marginals(root)) <= self._limit:
                each.is_used = taken = True
        return taken

    def _test_all(self) -> bool:
        """Select the consistent closures again from the odometry alone, and solve; returns whether anything changed."""
        self._doubts = 0
        before = [each.is_used for each in self.closures], self._component
        joined, fragments = self._joined(), self.chains.fragments
        tested = [each for each in self.closures if not each.is_refuted]
        edges = [each.edge for each in tested]
        accepted, distances = consistent(fragments, joined, self._moved(joined), edges, self.chains, self._probability)
        joined = self._held_together(joined, [edge for edge, is_used in zip(edges, accepted, strict=True) if is_used])
        moved = self._moved(joined)
        changed: list[int] = []
        for number, states in enumerate(fragments):
            if joined.component[number] != self._component[number]:
                self._poses[states.start : states.stop] = moved[states.start : states.stop]
                changed += states
        self._component, self._marginals_of = list(joined.component), {}
        for _ in range(_MAX_ROUNDS):
            for each, is_accepted in zip(tested, accepted, strict=True):
                each.is_used = bool(is_accepted)
            for root in set(self._component):
                self._solve(root)
            # These were rejected too soon: the odometry does not refute them, and the solution without them agrees.
            again = [k for k in np.flatnonzero(~accepted & (distances <= self._limit)).tolist() if self._fits(edges[k])]
            if not again:
                break
            accepted[again] = True
        for place in changed:
            self._bounds[place] = self.covariance(place)
        return before != ([each.is_used for each in self.closures], self._component)

    def _fits(self, edge: Edge) -> bool:
        root = self._component_of(edge.first)
        return root == self._component_of(edge.second) and edge.distance(self._marginals(root)) <= self._limit

    def _moved(self, joined: Joined) -> Float:
        """Return the poses (N, 4, 4) from the odometry alone, in the joined components' frames."""
        poses = np.array(self.chains.poses)
        for frame, states in zip(joined.frames, self.chains.fragments, strict=True):
            poses[states.start : states.stop] = frame @ poses[states.start : states.stop]
        return poses

    def _held_together(self, joined: Joined, used: Sequence[Edge]) -> Joined:
        """Return only those joins of fragments that used closures support: others would leave a fragment free."""
        root = list(range(len(joined.component)))
        for edge in used:
            ends = root[self.chains.fragment(edge.first)], root[self.chains.fragment(edge.second)]
            root = [min(ends) if of in ends else of for of in root]
        frames = [se3_inverse(joined.frames[of]) @ frame for of, frame in zip(root, joined.frames, strict=True)]
        return Joined(frames, root)

    def _joined(self) -> Joined:
        """Join fragments by votes of closures: one for each place and fragment that it is matched with."""
        strongest: dict[tuple[int, int], TestedClosure] = {}
        for each in self.closures:
            first, second = self.chains.fragment(each.edge.first), self.chains.fragment(each.edge.second)
            if first != second:
                known = strongest.get((first, each.edge.second))
                if known is None or each.closure.inliers > known.closure.inliers:
                    strongest[first, each.edge.second] = each
        votes: dict[tuple[int, int], list[TestedClosure]] = {}
        for (first, place), each in strongest.items():
            votes.setdefault((first, self.chains.fragment(place)), []).append(each)
        voters = [
            each
            for of_two in votes.values()
            for each in sorted(of_two, key=lambda each: -each.closure.inliers)[:_MAX_VOTES]
        ]
        fragments, edges = self.chains.fragments, [each.edge for each in voters]
        # Votes are compared in the present solution: by the odometry alone, those that agree may be too far apart.
        now = join_fragments(fragments, np.array(self._poses), edges, [each.closure.inliers for each in voters])
        seen_at = {self.chains.fragment(edge.second): edge.second for edge in reversed(edges)}
        frames = []
        for number, states in enumerate(fragments):
            place = seen_at.get(number, states.start)
            by_odometry = now.frames[number] @ self._poses[place] @ se3_inverse(self.chains.poses[place])
            frames.append(np.eye(4) if now.component[number] == number else by_odometry)
        return Joined(frames, now.component)

    def _component_of(self, place: int) -> int:
        return self._component[self.chains.fragment(place)]

    def _fragments_of(self, root: int) -> list[int]:
        return [number for number, of in enumerate(self._component) if of == root]

    def _graph(self, root: int) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return the graph of one component, as METIS, which orders variables, fails on disconnected graphs."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(self.chains.prior(root))
        fragments = self.chains.fragments
        for number in self._fragments_of(root):
            self.chains.add_to(graph, number)
            for place in fragments[number]:
                values.insert(x(place), gtsam.Pose3(self._poses[place]))
        for each in self.closures:
            if each.is_used and self._component_of(each.edge.first) == root:
                graph.add(each.edge.factor())
        return graph, values

    def _solve(self, root: int) -> None:
        solved = solve(*self._graph(root))
        fragments = self.chains.fragments
        for number in self._fragments_of(root):
            for place in fragments[number]:
                self._poses[place] = np.asarray(solved.atPose3(x(place)).matrix())
        self._marginals_of.pop(root, None)

    def _marginals(self, root: int) -> Marginals:
        if root not in self._marginals_of:
            self._marginals_of[root] = Marginals(*self._graph(root))
        return self._marginals_of[root]
