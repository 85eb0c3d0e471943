"""The result in other formats: trajectory (TUM), covariances and frames (CSV), pose graph (g2o)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from errno import ENOSPC
from pathlib import Path

import gtsam
import numpy as np

from graphvio.errors import OptimizationError
from graphvio.geometry import se3_inverse
from graphvio.optimization.graph import poses_of
from graphvio.optimization.optimize import Optimization, OptimizedSession
from graphvio.optimization.solver import Edge, Marginals
from graphvio.results.writer import COVARIANCE_HEADER, covariance_row
from graphvio.trajectory_files import tum_line


def trajectory_text(session: OptimizedSession) -> str:
    """Return all poses in the TUM format, each in its frame."""
    poses = zip(session.record.stamps_ns.tolist(), session.nav_T_body, strict=True)
    return "".join(f"{tum_line(stamp, pose)}\n" for stamp, pose in poses)


def frames_text(session: OptimizedSession) -> str:
    """Return first stamp, last stamp and frame of each run of poses in one frame, as CSV."""
    stamps, frame = session.record.stamps_ns, session.frame
    begins = np.concatenate([[0], np.flatnonzero(np.diff(frame)) + 1]).tolist()
    ends = [*(begin - 1 for begin in begins[1:]), len(frame) - 1]
    rows = [f"{stamps[one]},{stamps[other]},{frame[one]}" for one, other in zip(begins, ends, strict=True)]
    return "\n".join(["first_stamp_ns,last_stamp_ns,frame", *rows]) + "\n"


def covariance_text(session: OptimizedSession) -> str:
    """Return the upper triangles of the states' covariances, tangent ``[rotation, translation]`` in body, as CSV."""
    rows = map(covariance_row, session.nodes.stamps_ns.tolist(), session.covariance)
    return "\n".join([COVARIANCE_HEADER, *rows]) + "\n"


def write_g2o(optimization: Optimization, path: Path) -> None:
    """Write the states' poses as a pose graph, for tools without IMU factors.

    Its edges are the measured motions with their covariances, but with the relative poses of the solution without loop
    closures, which the IMU contributes to; one from the previous state where no motion ends in a state; and the loop
    closures.

    Raises:
        OptimizationError: if the file cannot be written.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    count = 0
    for session in optimization.sessions:
        for pose in session.nav_T_body[session.nodes.rows]:
            values.insert(count, gtsam.Pose3(pose))
            count += 1
    for edge in (*_odometry_edges(optimization), *optimization.edges):
        noise = gtsam.noiseModel.Gaussian.Covariance(0.5 * (edge.covariance + edge.covariance.T), False)
        graph.add(gtsam.BetweenFactorPose3(edge.first, edge.second, gtsam.Pose3(edge.first_T_second), noise))
    unfinished = path.with_name(f".{path.name}.tmp")
    gtsam.writeG2o(graph, values, str(unfinished))
    try:
        if unfinished.read_bytes().count(b"EDGE") != graph.size():
            raise OSError(ENOSPC, os.strerror(ENOSPC))  # gtsam reports no error
        unfinished.replace(path)
    except OSError as error:
        raise OptimizationError(f"{path}: cannot be written ({error.strerror or error})") from None


def _odometry_edges(optimization: Optimization) -> Iterator[Edge]:
    """Yield an edge for each measured motion, and one from the previous state to each state in which none ends."""
    marginals: Marginals | None = None
    poses, first = poses_of(optimization.alone, int(sum(len(each.nodes.rows) for each in optimization.sessions))), 0
    for session in optimization.sessions:
        nodes, motions = session.nodes, session.record.motions
        has_motion = np.zeros(len(nodes.rows), dtype=bool)
        for k in nodes.motions.tolist():
            i, j = nodes.index_of_row(int(motions.reference[k])), nodes.index_of_row(int(motions.row[k]))
            has_motion[j] = True
            yield Edge(first + i, first + j, se3_inverse(poses[first + i]) @ poses[first + j], motions.covariance[k])
        for n in np.flatnonzero(~has_motion).tolist():
            if n and nodes.epoch[n] == nodes.epoch[n - 1]:
                marginals = marginals or Marginals(optimization.graph_alone, optimization.alone)
                yield Edge(first + n - 1, first + n, *marginals.motion(first + n - 1, first + n))
        first += len(nodes.rows)
