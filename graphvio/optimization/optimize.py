"""Optimisation of sessions as one graph: solved without loop closures, joined by them, and solved again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

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
from graphvio.optimization.solver import Edge, Marginals, Residuals, gtsam_errors, residuals, solve
from graphvio.rig import Imu

Progress = Callable[[str, int, float], None]
"""Called with the name of the solution, the number of the iteration and the cost."""


@dataclass(frozen=True, eq=False)
class OptimizedSession:
    """The solution of one session."""

    nodes: Nodes  # states of the graph
    nav_T_body: Float  # (F, 4, 4) poses of all framesets, in the frame that ``frame`` gives
    # (N, 6, 6) of the states' poses relative to the origin of their frame, tangent ``[rotation, translation]`` in body
    covariance: Float
    frame: Int  # (F,) number of each frameset's frame; 0 is the frame of the first session's first epoch

    @property
    def record(self) -> SessionRecord:
        """The session's record."""
        return self.nodes.record


@dataclass(frozen=True, eq=False)
class JudgedLoop:
    """A loop closure and whether it is used."""

    closure: LoopClosure  # as it was found
    refusal: str  # why it is not used, or empty
    # squared Mahalanobis distance from the solution, 6 degrees of freedom; of a refused closure, with the covariance of
    # the solution, or of the odometry if that contradicts it. NaN between parts that are not joined
    distance: float


@dataclass(frozen=True, eq=False)
class Optimization:
    """The solution of all sessions."""

    sessions: Sequence[OptimizedSession]  # in the given order
    loops: Sequence[JudgedLoop]  # all given loop closures
    fragments: Sequence[Fragment]  # epochs of all sessions
    frames: Sequence[int]  # number of each fragment's frame
    before: dict[str, Residuals]  # kind of factor -> residuals at the odometry's states
    after: dict[str, Residuals]  # kind of factor -> residuals at the solution
    graph: gtsam.NonlinearFactorGraph  # the graph with the loop closures that are used
    values: gtsam.Values  # the solution
    edges: Sequence[Edge]  # the loop closures that are used, as edges
    graph_alone: gtsam.NonlinearFactorGraph  # without loop closures, each fragment in its own frame
    alone: gtsam.Values  # solution of ``graph_alone``
    # corrections of each session's rig file, or None where the calibration is not estimated
    corrections: Sequence[RigCorrection | None]

    @property
    def cost_before(self) -> float:
        """Half the sum of all squared residuals at the odometry's states, without loop closures."""
        return _cost(self.before)

    @property
    def cost_after(self) -> float:
        """Half the sum of all squared residuals at the solution, without loop closures."""
        return _cost(self.after)


@gtsam_errors("the sessions' graph has no unique solution")
def optimize(
    records: Sequence[SessionRecord],
    imus: Sequence[Imu | None],
    closures: Sequence[LoopClosure],
    config: Config,
    on_progress: Progress = lambda *_: None,
    calibrates: bool = False,
) -> Optimization:
    """Optimise the trajectories of sessions over all their measurements.

    Args:
        records: what the odometry measured in each of S sessions.
        imus: the IMU of each session's rig, or None.
        closures: true and false loop closures.
        config: the configuration of the back-end and of this stage.
        on_progress: called after each iteration.
        calibrates: whether the extrinsics of the pairs and the IMU's time offset are estimated, with priors.

    Raises:
        OptimizationError: if the graph has no unique solution, or closures are of other sessions.
    """
    settings = config.optimization
    interval_s = np.inf if calibrates else settings.keyframe_interval_s
    sessions = [choose_nodes(record, interval_s) for record in records]
    whole = SessionGraph(sessions, imus, config.smoother, calibrates)
    fragments = whole.fragments
    graph_alone, kinds = whole.complete(range(len(fragments)))
    before = residuals(graph_alone, kinds, whole.values)
    alone = solve(graph_alone, whole.values, partial(on_progress, "without loops"))
    edges = [_edge(closure, sessions, whole) for closure in closures]
    states = [each.states for each in fragments]
    poses = poses_of(alone, len(whole))
    joined = join_fragments(states, poses, edges, [closure.inliers for closure in closures])
    values = moved(alone, list(zip(states, joined.frames, strict=True)))
    poses = poses_of(values, len(whole))
    is_used, distances = consistent(
        states, joined, poses, edges, Marginals(graph_alone, alone), settings.loop_probability
    )
    roots = sorted(set(joined.component))
    limit = chi_square_quantile(settings.loop_probability, 6)
    while True:  # a refused closure that neither odometry nor solution contradicts is used after all
        used = [edges[k] for k in np.flatnonzero(is_used).tolist()]
        graph, kinds_with_loops = whole.complete(roots, used)
        values = solve(graph, values, partial(on_progress, "with loops"))
        marginals = Marginals(graph, values)
        refused = np.flatnonzero(~is_used & (distances <= limit))
        distances[refused] = [edges[k].distance(marginals) for k in refused.tolist()]
        again = refused[distances[refused] <= limit]
        if not len(again):
            break
        is_used[again] = True
    solution = poses_of(values, len(whole))
    covariances = marginals.poses(len(whole))
    frames = [roots.index(number) for number in joined.component]
    return Optimization(
        sessions=[
            _session(nodes, slice(*whole.firsts[number : number + 2]), solution, covariances, fragments, frames)
            for number, nodes in enumerate(sessions)
        ],
        loops=[
            _judged(closure, edge, bool(kept), float(distance), solution, limit)
            for closure, edge, kept, distance in zip(closures, edges, is_used, distances, strict=True)
        ],
        fragments=fragments,
        frames=frames,
        before=before,
        after=residuals(graph, kinds_with_loops, values),
        graph=graph,
        values=values,
        edges=used,
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
            raise OptimizationError("the loop closures belong to other sessions than the given ones")
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
    """Return a closure with its outcome; ``distance`` counts if it is refused: NaN if its fragments are not joined."""
    if is_used:
        error = se3_log(se3_inverse(se3_inverse(solution[edge.first]) @ solution[edge.second]) @ edge.first_T_second)
        return JudgedLoop(closure, "", float(error @ np.linalg.solve(edge.covariance, error)))
    if np.isnan(distance):
        return JudgedLoop(closure, "too few closures agree on the transform between its two parts", distance)
    sigmas, max_sigmas = np.sqrt(distance), np.sqrt(limit)
    refusal = f"{sigmas:.0f} standard deviations from the solution by all others, more than {max_sigmas:.1f}"
    return JudgedLoop(closure, refusal, distance)


def _cost(kinds: dict[str, Residuals]) -> float:
    return 0.5 * float(sum(each.distances.sum() for kind, each in kinds.items() if kind != "loop"))
