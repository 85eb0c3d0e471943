"""Positions of a window's points, seen from its newest state, with joint covariances of states and landmarks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.geometry import se3_adjoint, se3_inverse, skew
from graphvio.measurements.motion import LocatedPoints
from graphvio.monocular.adjustment import Adjusted, covariance_of
from graphvio.monocular.sightings import Views
from graphvio.monocular.states import BIASES, GRAVITY

_MIN_DEPTH_SIGMAS = 3.0  # a more uncertain inverse depth has no covariance in metres


class Solved(NamedTuple):
    """A window as it was solved last.

    Attributes:
        adjusted: adjusted states and landmarks.
        ids: (L,) identities of the landmarks.
        newest: views from the newest state.
    """

    adjusted: Adjusted
    ids: Int
    newest: Views


def covariance_since(solved: Solved, then_ns: int) -> Float | None:
    """Return the covariance (6, 6) of the motion since a state, in the newest body frame; None where it has left."""
    states = solved.adjusted.states
    found, n = np.flatnonzero(states.stamps_ns == then_ns), len(states.poses)
    if not len(found) or found[0] == n - 1:
        return None
    then = int(found[0])
    joint = covariance_of(solved.adjusted.equations.hessian, np.r_[6 * then : 6 * then + 6, 6 * n - 6 : 6 * n])
    now_T_then = np.ascontiguousarray(se3_inverse(states.poses[-1]) @ states.poses[then])
    by_both = np.hstack([-se3_adjoint(now_T_then), np.eye(6)])
    return np.asarray(by_both @ joint @ by_both.T)


def located_points(solved: Solved) -> dict[int, LocatedPoints]:
    """Return the points of each camera's tracks whose inverse depth exceeds three standard deviations.

    Covariances are of the points in the body frame of the newest state: they include the uncertainty of the scale, and
    of the motion between the states.
    """
    newest = solved.newest
    own = np.flatnonzero(newest.camera == newest.owner)
    rows = np.minimum(np.searchsorted(solved.ids, newest.landmark[own]), max(len(solved.ids) - 1, 0))
    if not len(solved.ids) or not len(own):
        return {}
    own, rows = own[solved.ids[rows] == newest.landmark[own]], rows[solved.ids[rows] == newest.landmark[own]]
    points, covariances, known = _in_body(solved, rows)
    own = own[known]
    found = {}
    for j in np.unique(newest.camera[own]):
        of_camera = np.flatnonzero(newest.camera[own] == j)
        of_camera = of_camera[np.argsort(newest.ids[own[of_camera]])]
        found[int(j)] = LocatedPoints(newest.ids[own[of_camera]], points[of_camera], covariances[of_camera])
    return found


def _in_body(solved: Solved, rows: Int) -> tuple[Float, Float, Bool]:
    """Return points (K, 3) and covariances (K, 3, 3) of those landmarks (M,) whose depth is known, and which these are.

    After a change x of poses and cameras, a landmark is ``l - V^-1 (b + W^T x)``. Its covariance is that for known
    poses and cameras, ``V^-1``, plus what the covariance of x adds.
    """
    states, landmarks, measured, at = solved.adjusted
    structure = measured.structure
    n_poses, n_camera_parameters = 6 * len(states.poses), at.eliminated.by_cameras.shape[2]
    of_cameras = 9 * len(states.poses) + GRAVITY + BIASES + np.arange(n_camera_parameters)
    joint, n_unknowns = covariance_of(at.hessian, np.r_[:n_poses, of_cameras]), n_poses + n_camera_parameters
    odom_R_body, position = states.poses[-1, :3, :3], states.poses[-1, :3, 3]
    points, covariances, known = np.zeros((len(rows), 3)), np.zeros((len(rows), 3, 3)), np.zeros(len(rows), dtype=bool)
    for i, row in enumerate(rows):
        by_poses = np.zeros((3, n_unknowns))
        for n in range(structure.rows[row], structure.rows[row + 1]):
            k = 6 * structure.state[n]
            by_poses[:, k : k + 6] -= at.eliminated.by_pose[n]
        by_poses[:, n_poses:] -= at.eliminated.by_cameras[row]
        inverse, w = at.eliminated.inverse[row], float(landmarks[row, 2])
        by_poses = inverse @ by_poses
        sigma_w = np.sqrt(inverse[2, 2] + by_poses[2] @ joint @ by_poses[2])
        if not w > _MIN_DEPTH_SIGMAS * sigma_w:
            continue
        frame = structure.odom_T_landmark[row]
        in_frame = np.array([landmarks[row, 0], landmarks[row, 1], 1.0]) / w
        points[i] = (frame[:3, :3] @ in_frame + frame[:3, 3] - position) @ odom_R_body
        by_landmark = odom_R_body.T @ frame[:3, :3] @ np.column_stack([np.eye(3)[:, :2], -in_frame]) / w
        by_poses = by_landmark @ by_poses
        by_poses[:, n_poses - 6 : n_poses - 3] += skew(points[i])
        by_poses[:, n_poses - 3 : n_poses] -= np.eye(3)
        covariances[i] = by_landmark @ inverse @ by_landmark.T + by_poses @ joint @ by_poses.T
        known[i] = True
    return points[known], covariances[known], known
