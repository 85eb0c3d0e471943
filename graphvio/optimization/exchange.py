"""The result as other tools read it: trajectory, covariances, and a pose graph in the g2o format."""

from __future__ import annotations

from itertools import combinations_with_replacement
from pathlib import Path

import gtsam
import numpy as np

from graphvio.optimization.consistency import odometry_between
from graphvio.optimization.marginals import Marginals
from graphvio.optimization.optimize import Optimization, OptimizedSession
from graphvio.trajectory import tum_line

_TANGENT = ("rx", "ry", "rz", "tx", "ty", "tz")
_UPPER = np.triu_indices(6)


def trajectory_text(session: OptimizedSession) -> str:
    """All its poses in the TUM format, each in its frame."""
    poses = zip(session.record.stamps_ns.tolist(), session.nav_T_body, strict=True)
    return "".join(f"{tum_line(stamp, pose)}\n" for stamp, pose in poses)


def covariance_text(session: OptimizedSession) -> str:
    """Upper triangles (21) of the states' covariances, tangent ``[rotation, translation]`` in body."""
    header = ",".join(["stamp_ns", *(f"{one}_{other}" for one, other in combinations_with_replacement(_TANGENT, 2))])
    lines = [header]
    for stamp, covariance in zip(session.nodes.stamps_ns.tolist(), session.covariance, strict=True):
        lines.append(",".join([str(stamp), *(f"{value:.9e}" for value in covariance[_UPPER])]))
    return "\n".join(lines) + "\n"


def write_g2o(optimization: Optimization, path: Path) -> None:
    """A graph of the states' poses, for tools that know poses only.

    What motions, IMU and rests say together of two states that follow each other is one edge, with its covariance;
    closures are edges as they are.
    """
    count = int(sum(len(session.nodes.rows) for session in optimization.sessions))
    fragments = [each.states for each in optimization.fragments]
    marginals = Marginals(optimization.graph_alone, optimization.alone)
    odometry = odometry_between(marginals, fragments, range(count))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    at = 0
    for session in optimization.sessions:
        for pose in session.nav_T_body[session.nodes.rows]:
            values.insert(at, gtsam.Pose3(pose))
            at += 1
    for tie in (*odometry, *optimization.ties):
        noise = gtsam.noiseModel.Gaussian.Covariance(0.5 * (tie.covariance + tie.covariance.T), False)
        graph.add(gtsam.BetweenFactorPose3(tie.first, tie.second, gtsam.Pose3(tie.first_T_second), noise))
    gtsam.writeG2o(graph, values, str(path))
