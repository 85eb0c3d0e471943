"""The map's pose graph: chains of places, and the closures between them that are believed.

A closure is refused at once where the odometry between its ends refutes it. One that the present solution bears out is
used; what it does not is kept, and when such doubts or closures between unjoined fragments have grown, all are judged
anew together, as for recorded sessions (`graphvio.optimization.consistency`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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

_MOST_VOTES = 30  # of two fragments: votes are compared with each other
_LEAST_DOUBTS = 3  # before all closures are judged anew,
_DOUBTED_SHARE = 0.1  # and this share of those that are used
_LATEST = 50  # closures that are doubted no more if the solution comes to bear them out
_IN_SIGHT_M = 10.0  # two places further apart have little in common that stereo measures well,
_SIGMAS = 4.0  # and so many standard deviations of both places' positions
_MOST_JUDGED_AGAIN = 3  # rounds in which refused closures are taken up that the solution bears out


@dataclass(eq=False)
class Judged:
    """A closure between places of the graph, whose numbers are their rows.

    Attributes:
        closure: as it was found.
        edge: the same as a factor.
        is_used: whether the solution rests on it.
        is_refuted: whether the odometry alone refutes it, for good.
    """

    closure: LoopClosure
    edge: Edge
    is_used: bool = False
    is_refuted: bool = False


class PoseGraph:
    """Places, and where they are: those of joined fragments in the frame of the first of them.

    Args:
        probability: a closure beyond this share of the chi-square distribution is refused.
        chains: of an earlier map.
        closures: of it.
        poses: (N, 4, 4) its solution.
        component: of each of its fragments, the one whose frame it is in.
        bounds: (N, 6, 6) covariances of the poses.
    """

    def __init__(
        self,
        probability: float,
        chains: Chains | None = None,
        closures: Sequence[Judged] = (),
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
        self._known_of: dict[int, Marginals] = {}  # of components, as far as they have not changed
        self._doubts = 0

    def __len__(self) -> int:
        return len(self._poses)

    def begin(self, odom_T_body: Float) -> int:
        """Add a place that begins a fragment, by its pose (4, 4) in odom; returns its number."""
        self.chains.begin(odom_T_body)
        self._poses.append(odom_T_body)
        self._component.append(len(self._component))
        self._bounds.append(EXACT)
        return len(self) - 1

    def add(self, previous_T_body: Float, covariance: Float) -> int:
        """Add a place to the last fragment, by its motion (4, 4) since the place before it; returns its number."""
        self.chains.add(previous_T_body, covariance)
        pose, bound = composed(self._poses[-1], self._bounds[-1], previous_T_body, covariance)
        self._poses.append(pose)
        self._bounds.append(bound)
        self._known_of.pop(self._component[-1], None)
        return len(self) - 1

    @property
    def component(self) -> list[int]:
        """Of each fragment, the fragment whose odom frame it is in; 0 is the map's."""
        return list(self._component)

    def is_in_map(self, place: int) -> bool:
        """Whether a place is in the map's frame, which is the first fragment's odom frame."""
        return self._component_of(place) == 0

    def pose(self, place: int) -> Float:
        """(4, 4) of a place in its component's frame."""
        return self._poses[place]

    def covariance(self, place: int) -> Float:
        """Its covariance (6, 6) relative to the frame's first place, tangent ``[rotation, translation]`` in body."""
        return self._known(self._component_of(place)).pose(place)

    def may_see(self, one: int, other: int) -> bool:
        """Whether two places are perhaps near enough to see the same; always, as long as nothing joins them."""
        if self._component_of(one) != self._component_of(other):
            return True
        sigma_m = sum(float(np.sqrt(np.trace(self._bounds[place][3:, 3:]))) for place in (one, other))
        distance_m = np.linalg.norm(self._poses[one][:3, 3] - self._poses[other][:3, 3])
        return bool(distance_m <= _IN_SIGHT_M + _SIGMAS * sigma_m)

    def add_closures(self, found: Sequence[LoopClosure]) -> bool:
        """Judge closures whose places' rows are numbers of the graph; returns whether the solution has changed.

        Raises:
            OptimizationError: if the graph cannot be solved.
        """
        is_new, asks_votes = False, False
        for closure in found:
            one, other = closure.reference.row, closure.current.row
            judged = Judged(closure, Edge(one, other, closure.reference_T_current, closure.covariance))
            self.closures.append(judged)
            is_inside = self.chains.fragment(one) == self.chains.fragment(other)
            if is_inside and self.chains.distance(judged.edge) > self._limit:
                judged.is_refuted = True
            elif self._component_of(one) != self._component_of(other):
                asks_votes = True
            elif self._known(self._component_of(one)).distance(judged.edge) <= self._limit:
                judged.is_used = is_new = True
            else:
                self._doubts += 1
        newest = self._component[-1]
        is_new |= self._take_up_doubted(newest)
        used = sum(each.is_used for each in self.closures)
        if (asks_votes and self._joined().component != self._component) or self._doubts >= max(
            _LEAST_DOUBTS, _DOUBTED_SHARE * used
        ):
            return self._judge_all()
        if is_new:
            self._solve(newest)
            self._bounds[-1] = self.covariance(len(self) - 1)  # of older places, what was known before is a bound
        return is_new

    def _take_up_doubted(self, root: int) -> bool:
        """Use closures of a component that were doubted once, and that the solution bears out by now."""
        taken = False
        for each in self.closures[-_LATEST:]:
            ends = {self._component_of(each.edge.first), self._component_of(each.edge.second)}
            if each.is_used or each.is_refuted or ends != {root}:
                continue
            if self._known(root).distance(each.edge) <= self._limit:
                each.is_used = taken = True
        return taken

    def _judge_all(self) -> bool:
        """Which closures to believe, from the odometry on; all of it as for recorded sessions."""
        self._doubts = 0
        before = [each.is_used for each in self.closures], self._component
        joined, fragments = self._joined(), self.chains.fragments
        asked = [each for each in self.closures if not each.is_refuted]
        edges = [each.edge for each in asked]
        believed, distances = consistent(fragments, joined, self._moved(joined), edges, self.chains, self._probability)
        joined = self._held_together(joined, [edge for edge, is_used in zip(edges, believed, strict=True) if is_used])
        moved = self._moved(joined)
        changed: list[int] = []
        for number, states in enumerate(fragments):
            if joined.component[number] != self._component[number]:
                self._poses[states.start : states.stop] = moved[states.start : states.stop]
                changed += states
        self._component, self._known_of = list(joined.component), {}
        for _ in range(_MOST_JUDGED_AGAIN):
            for each, is_believed in zip(asked, believed, strict=True):
                each.is_used = bool(is_believed)
            for root in set(self._component):
                self._solve(root)
            # Refused too soon: the odometry does not refute them, and the solution without them bears them out.
            again = [k for k in np.flatnonzero(~believed & (distances <= self._limit)).tolist() if self._fits(edges[k])]
            if not again:
                break
            believed[again] = True
        for place in changed:
            self._bounds[place] = self.covariance(place)
        return before != ([each.is_used for each in self.closures], self._component)

    def _fits(self, edge: Edge) -> bool:
        root = self._component_of(edge.first)
        return root == self._component_of(edge.second) and self._known(root).distance(edge) <= self._limit

    def _moved(self, joined: Joined) -> Float:
        """Poses (N, 4, 4) by the odometry alone, in the frames that are common."""
        poses = np.array(self.chains.poses)
        for frame, states in zip(joined.frames, self.chains.fragments, strict=True):
            poses[states.start : states.stop] = frame @ poses[states.start : states.stop]
        return poses

    def _held_together(self, joined: Joined, used: Sequence[Edge]) -> Joined:
        """Only those fragments joined that closures which are believed hold together: the others would be free."""
        root = list(range(len(joined.component)))
        for edge in used:
            ends = root[self.chains.fragment(edge.first)], root[self.chains.fragment(edge.second)]
            root = [min(ends) if of in ends else of for of in root]
        frames = [se3_inverse(joined.frames[of]) @ frame for of, frame in zip(root, joined.frames, strict=True)]
        return Joined(frames, root)

    def _joined(self) -> Joined:
        """How the fragments lie to each other, by votes: one of each place, so that no single look decides."""
        strongest: dict[tuple[int, int], Judged] = {}
        for each in self.closures:
            first, second = self.chains.fragment(each.edge.first), self.chains.fragment(each.edge.second)
            if first != second:
                known = strongest.get((first, each.edge.second))
                if known is None or each.closure.inliers > known.closure.inliers:
                    strongest[first, each.edge.second] = each
        votes: dict[tuple[int, int], list[Judged]] = {}
        for (first, place), each in strongest.items():
            votes.setdefault((first, self.chains.fragment(place)), []).append(each)
        heard = [
            each
            for of_two in votes.values()
            for each in sorted(of_two, key=lambda each: -each.closure.inliers)[:_MOST_VOTES]
        ]
        fragments, edges = self.chains.fragments, [each.edge for each in heard]
        # In the present solution: by the odometry alone, two views of a place may lie further apart than votes may.
        now = join_fragments(fragments, np.array(self._poses), edges, [each.closure.inliers for each in heard])
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
        """Of one component: METIS, which orders variables, breaks on graphs that fall apart."""
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
        self._known_of.pop(root, None)

    def _known(self, root: int) -> Marginals:
        if root not in self._known_of:
            self._known_of[root] = Marginals(*self._graph(root))
        return self._known_of[root]
