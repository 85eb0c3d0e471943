"""Sessions as one graph: solved, joined by loop closures, and solved again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from graphvio.arrays import Float, Int
from graphvio.backend.gating import chi_square_quantile
from graphvio.config import Config
from graphvio.errors import OptimizationError
from graphvio.geometry import se3_inverse, se3_log
from graphvio.optimization.consistency import consistent, join_fragments
from graphvio.optimization.extrinsics import RigCorrection, correction_of
from graphvio.optimization.graph import Fragment, SessionGraph, moved, poses_of
from graphvio.optimization.loops.closures import LoopClosure
from graphvio.optimization.nodes import Nodes, choose_nodes, spread
from graphvio.optimization.record import SessionRecord
from graphvio.optimization.solver import Edge, Marginals, Residuals, residuals, solve
from graphvio.rig import Imu

Progress = Callable[[str, int, float], None]
"""Called with what is solved, the number of the iteration, and the cost."""


@dataclass(frozen=True, eq=False)
class OptimizedSession:
    """One of the sessions.

    Attributes:
        nodes: the states of its graph.
        nav_T_body: (F, 4, 4) of all its framesets; nav is the frame of the fragment that ``frame`` tells.
        covariance: (N, 6, 6) of the states' poses, tangent ``[rotation, translation]`` in body; of what their frame's
            origin is told from.
        frame: (F,) number of the frame of each frameset; 0 is the first session's first.
    """

    nodes: Nodes
    nav_T_body: Float
    covariance: Float
    frame: Int

    @property
    def record(self) -> SessionRecord:
        """What the odometry made of it."""
        return self.nodes.record


@dataclass(frozen=True, eq=False)
class JudgedLoop:
    """A loop closure, and what became of it.

    Attributes:
        closure: as it was found.
        refusal: why it is not used, or empty.
        distance: squared Mahalanobis distance from the solution, 6 degrees of freedom; of one that is refused, the
            solution's own uncertainty counts, too. NaN between parts that nothing joins.
    """

    closure: LoopClosure
    refusal: str
    distance: float


@dataclass(frozen=True, eq=False)
class Optimization:
    """What became of the sessions.

    Attributes:
        sessions: in the order in which they were given.
        loops: all closures that were offered.
        fragments: the epochs of all sessions.
        frames: number of the frame that each fragment is in.
        before: kind of factor -> its residuals as the odometry left the states.
        after: the same in the solution.
        graph: with all that was used.
        values: the solution.
        edges: closures that are used, as factors.
        graph_alone: without closures, each fragment in a frame of its own.
        alone: its solution.
        corrections: of each session's rig file, or None where the calibration was not asked for.
    """

    sessions: Sequence[OptimizedSession]
    loops: Sequence[JudgedLoop]
    fragments: Sequence[Fragment]
    frames: Sequence[int]
    before: dict[str, Residuals]
    after: dict[str, Residuals]
    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    edges: Sequence[Edge]
    graph_alone: gtsam.NonlinearFactorGraph
    alone: gtsam.Values
    corrections: Sequence[RigCorrection | None]

    @property
    def cost_before(self) -> float:
        """Half the sum of all squared residuals as the odometry left the states, closures not counted."""
        return _cost(self.before)

    @property
    def cost_after(self) -> float:
        """The same in the solution."""
        return _cost(self.after)


def optimize(
    records: Sequence[SessionRecord],
    imus: Sequence[Imu | None],
    closures: Sequence[LoopClosure],
    config: Config,
    on_progress: Progress | None = None,
    calibrates: bool = False,
) -> Optimization:
    """The best trajectories that all measurements of the sessions hold together.

    Args:
        records: S sessions as the odometry saw them.
        imus: of each session's rig, or None.
        closures: places seen from others, right ones and wrong ones.
        config: of the back-end and of this stage.
        on_progress: told how far it is.
        calibrates: whether the places of the pairs, and the IMU's time offset, are unknowns with priors.

    Raises:
        OptimizationError: if the graph has no unique solution, or closures are of other sessions.
    """
    try:
        return _optimize(records, imus, closures, config, on_progress, calibrates)
    except RuntimeError as error:  # of gtsam
        why = " ".join(str(error).split())[:200]
        raise OptimizationError(f"the sessions' graph has no unique solution ({why})") from None


def _optimize(
    records: Sequence[SessionRecord],
    imus: Sequence[Imu | None],
    closures: Sequence[LoopClosure],
    config: Config,
    on_progress: Progress | None,
    calibrates: bool,
) -> Optimization:
    settings = config.optimization
    interval_s = np.inf if calibrates else settings.keyframe_interval_s
    sessions = [choose_nodes(record, interval_s) for record in records]
    whole = SessionGraph(sessions, imus, config.smoother, calibrates)
    fragments = whole.fragments
    graph_alone, kinds = whole.complete(range(len(fragments)))
    before = residuals(graph_alone, kinds, whole.values)
    alone = solve(graph_alone, whole.values, _named(on_progress, "without loops"))
    edges = [_edge(closure, sessions, whole) for closure in closures]
    states = [each.states for each in fragments]
    poses = poses_of(alone, len(whole))
    joined = join_fragments(states, poses, edges, [closure.inliers for closure in closures])
    values = moved(alone, list(zip(states, joined.frames, strict=True)))
    poses = poses_of(values, len(whole))
    known_alone = Marginals(graph_alone, alone)
    believed, distances = consistent(states, joined, poses, edges, known_alone, settings.loop_probability)
    roots = sorted(set(joined.component))
    limit = chi_square_quantile(settings.loop_probability, 6)
    while True:
        graph, kinds = whole.complete(roots, [edge for edge, is_used in zip(edges, believed, strict=True) if is_used])
        values = solve(graph, values, _named(on_progress, "with loops"))
        marginals = Marginals(graph, values)
        # Refused too soon are those that the odometry does not refute, and that the solution without them bears out.
        doubted = np.flatnonzero(~believed & (distances <= limit))
        distances[doubted] = [marginals.distance(edges[k]) for k in doubted.tolist()]
        again = doubted[distances[doubted] <= limit]
        if not len(again):
            break
        believed[again] = True
    solution = poses_of(values, len(whole))
    covariances = np.array([marginals.pose(k) for k in range(len(whole))]).reshape(-1, 6, 6)
    frames = [roots.index(number) for number in joined.component]
    return Optimization(
        sessions=[
            _session(nodes, slice(*whole.firsts[number : number + 2]), solution, covariances, fragments, frames)
            for number, nodes in enumerate(sessions)
        ],
        loops=[
            _judged(closure, edge, bool(is_used), float(distance), solution, limit)
            for closure, edge, is_used, distance in zip(closures, edges, believed, distances, strict=True)
        ],
        fragments=fragments,
        frames=frames,
        before=before,
        after=residuals(graph, kinds, values),
        graph=graph,
        values=values,
        edges=[edge for edge, is_used in zip(edges, believed, strict=True) if is_used],
        graph_alone=graph_alone,
        alone=alone,
        corrections=[
            correction_of(marginals, values, number, int(record.own_pair.max()) + 1)
            if calibrates and len(record.own_pair)
            else None
            for number, record in enumerate(records)
        ],
    )


def _edge(closure: LoopClosure, sessions: Sequence[Nodes], whole: SessionGraph) -> Edge:
    for place in (closure.reference, closure.current):
        stamps_ns = sessions[place.session].record.stamps_ns
        if place.row >= len(stamps_ns) or stamps_ns[place.row] != place.stamp_ns:
            raise OptimizationError("the loop closures are of other sessions than those that are given")
    first, second = (
        int(whole.firsts[place.session]) + sessions[place.session].index_of_row(place.row)
        for place in (closure.reference, closure.current)
    )
    return Edge(first, second, closure.reference_T_current, closure.covariance)


def _session(
    nodes: Nodes, states: slice, solution: Float, covariances: Float, fragments: Sequence[Fragment],
    frames: Sequence[int],
) -> OptimizedSession:  # fmt: skip
    of_epoch = {
        each.epoch: frame
        for each, frame in zip(fragments, frames, strict=True)
        if states.start <= each.states.start < states.stop
    }
    return OptimizedSession(
        nodes,
        spread(nodes, solution[states]),
        covariances[states],
        np.array([of_epoch[epoch] for epoch in nodes.record.epoch.tolist()], dtype=np.int64),
    )


def _judged(
    closure: LoopClosure, edge: Edge, is_used: bool, distance: float, solution: Float, limit: float
) -> JudgedLoop:
    """What became of a closure, whose squared distance is known if it is not used, but could have been."""
    if is_used:
        error = se3_log(se3_inverse(se3_inverse(solution[edge.first]) @ solution[edge.second]) @ edge.first_T_second)
        return JudgedLoop(closure, "", float(error @ np.linalg.solve(edge.covariance, error)))
    if np.isnan(distance):
        return JudgedLoop(closure, "too few closures agree on how its two parts lie to each other", distance)
    sigmas, most = np.sqrt(distance), np.sqrt(limit)
    why = f"{sigmas:.0f} standard deviations from what all others say, more than {most:.1f}"
    return JudgedLoop(closure, why, distance)


def _cost(kinds: dict[str, Residuals]) -> float:
    return 0.5 * float(sum(each.distances.sum() for kind, each in kinds.items() if kind != "loop"))


def _named(on_progress: Progress | None, name: str) -> Callable[[int, float], None] | None:
    if on_progress is None:
        return None
    return lambda iteration, cost: on_progress(name, iteration, cost)
