"""Export of an optimisation: trajectory (TUM), covariances and frames (CSV), pose graph (g2o), points (PLY)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from errno import ENOSPC
from pathlib import Path
from typing import NamedTuple

import gtsam
import numpy as np

from graphvio.arrays import AnyArray, Float
from graphvio.errors import OptimizationError, writing
from graphvio.geometry import se3_inverse
from graphvio.optimization.graph import poses_of
from graphvio.optimization.loops.colmap_library import colmap
from graphvio.optimization.optimize import Optimization, OptimizedSession
from graphvio.optimization.solver import Edge, Marginals
from graphvio.results.writer import COVARIANCE_HEADER, covariance_row
from graphvio.trajectory_files import tum_line

_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]  # as viewers expect
)
_PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


def trajectory_text(session: OptimizedSession) -> str:
    """Return all poses of a session in the TUM format, each pose in the frame of its epoch."""
    poses = zip(session.record.stamps_ns.tolist(), session.nav_T_body, strict=True)
    return "".join(f"{tum_line(stamp, pose)}\n" for stamp, pose in poses)


def frames_text(session: OptimizedSession) -> str:
    """Return, as CSV, the first stamp, last stamp and frame of each sequence of poses that share a frame."""
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

    Its edges are the measured motions, with their covariances but with the relative poses of the solution without loop
    closures, to which the IMU contributes; an edge from the previous state to each state in which no motion ends; and
    the loop closures.

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
    with writing(path, OptimizationError, "choose another place"):
        if unfinished.read_bytes().count(b"EDGE") != graph.size():
            raise OSError(ENOSPC, os.strerror(ENOSPC))  # gtsam reports no error
        unfinished.replace(path)


def _odometry_edges(optimization: Optimization) -> Iterator[Edge]:
    """Yield an edge per measured motion, and one from the previous state to each state in which no motion ends."""
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


class Points(NamedTuple):
    """Triangulated points in one frame of the optimisation."""

    positions: Float  # (N, 3) in nav, metres
    grey: AnyArray  # (N,) uint8, mean of the images that see the point


def model_points(model: Path) -> Points:
    """Read the points of a COLMAP model, in the order of their ids."""
    points = [point for _, point in sorted(colmap().Reconstruction(model).points3D.items())]
    positions = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    return Points(positions, np.array([point.color[0] for point in points], dtype=np.uint8))


def ply(points: Points) -> bytes:
    """Return points as a binary PLY file."""
    rows = np.zeros(len(points.grey), dtype=_POINT)
    for axis, values in zip("xyz", points.positions.T, strict=True):
        rows[axis] = values
    for channel in ("red", "green", "blue"):
        rows[channel] = points.grey
    properties = [f"property {_PLY_TYPES[kind.str]} {name}" for name, (kind, *_) in (_POINT.fields or {}).items()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties, "end_header", ""]
    return "\n".join(header).encode() + rows.tobytes()
