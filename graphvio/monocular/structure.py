"""Landmarks that single cameras see from the states of a window: their views, and their positions.

A landmark is ``[a, b, w]``: the homogeneous point ``[a, b, 1, w]`` in a frame of its own, which is that of the camera
that sees it first, as it was last estimated. `w` is its inverse depth there; before there is a baseline, a wide prior
determines it. Where views overlap, several cameras see a landmark from one state, which shows its distance in metres.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.kernels import kernel
from graphvio.monocular.reprojection import (
    COLUMNS,
    ERROR_AT,
    POINT_AT,
    POSE,
    Cameras,
    have_moved,
    whiten_view,
)
from graphvio.self_calibration.bundle import inverse3, rows_of
from graphvio.self_calibration.moving_landmarks import move_landmark
from graphvio.self_calibration.parameters import CAMERA

PRIOR_INVERSE_DEPTH = 0.2
PRIOR_INFORMATION = 1e-2  # of a prior inverse depth, sigma 10 / m: a stronger one would bias the scale of all landmarks
_STEPS = 6
_LOCATED = 1e-9  # a smaller step ends the search of a landmark's place: it is less than a millionth of a pixel
_FEW = 5  # views: landmarks with no more are located again before the window is linearised


class Structure(NamedTuple):
    """Views of L landmarks from K states: N rows, sorted by landmark.

    Attributes:
        odom_T_landmark: (L, 4, 4) frame of each landmark.
        rows: (L + 1,) the views of landmark l are ``rows[l]`` to ``rows[l + 1]``, in the order of states and cameras.
        state: (N,) index of the state.
        camera: (N,) index of the camera.
        rays: (N, 2) normalised coordinates.
        readout: (N, 4) see `graphvio.measurements.motion.CameraTracks`; zero for global shutters.
    """

    odom_T_landmark: Float
    rows: Int
    state: Int
    camera: Int
    rays: Float
    readout: Float

    def of(self, kept: Bool) -> "Structure":
        """Return the landmarks (L,) that are kept, with their views."""
        rows, begins = rows_of(self.rows, kept)
        rays, readout = np.compress(rows, self.rays, axis=0), np.compress(rows, self.readout, axis=0)
        return Structure(self.odom_T_landmark[kept], begins, self.state[rows], self.camera[rows], rays, readout)


class Eliminated(NamedTuple):
    """Terms of the landmarks' elimination, from which the landmarks' own step follows.

    Attributes:
        inverse: (L, 3, 3) inverse of each landmark's normal matrix.
        gradient: (L, 3) gradient of the cost with respect to each landmark.
        by_pose: (N, 3, 6) coupling of each view with its state's pose.
        by_cameras: (L, 3, C * SINGLE) coupling with the cameras' calibration, (L, 3, 0) where that is taken as known.
    """

    inverse: Float
    gradient: Float
    by_pose: Float
    by_cameras: Float

    @staticmethod
    def empty(structure: Structure, n_calibration: int = 0) -> "Eliminated":
        """Allocate for a structure, and a number of parameters of the cameras."""
        n = len(structure.odom_T_landmark)
        by_pose = np.zeros((len(structure.state), 3, POSE))
        return Eliminated(np.zeros((n, 3, 3)), np.zeros((n, 3)), by_pose, np.zeros((n, 3, n_calibration)))


@kernel
def landmarks_after(
    landmarks: Float, structure: Structure, cameras: Cameras, poses: Float, moved_poses: Float, eliminated: Eliminated,
    step: Float,
) -> tuple[Float, Float]:  # fmt: skip
    """Return the landmarks (L, 3) after a step of the poses and cameras, and their frames (L, 4, 4).

    A landmark moves along with the camera that sees it first, see `graphvio.self_calibration.moving_landmarks`.

    Args:
        landmarks: (L, 3) before.
        structure: views of the landmarks.
        cameras: cameras of the rig, before.
        poses: (K, 4, 4) ``odom_T_body``, before.
        moved_poses: (K, 4, 4) after.
        eliminated: terms of the landmarks' elimination.
        step: (6 K + n,) step of the poses and of n parameters of cameras.
    """
    n_poses = POSE * len(poses)
    moved, frames = np.empty_like(landmarks), structure.odom_T_landmark.copy()
    b, work = np.zeros(3), np.zeros((4, 3))
    for point in range(len(landmarks)):
        for r in range(3):
            b[r] = eliminated.gradient[point, r]
            for n in range(structure.rows[point], structure.rows[point + 1]):
                for c in range(POSE):
                    b[r] += eliminated.by_pose[n, r, c] * step[POSE * structure.state[n] + c]
            for c in range(eliminated.by_cameras.shape[2]):
                b[r] += eliminated.by_cameras[point, r, c] * step[n_poses + c]
        first = structure.rows[point]
        k, body_T_cam = structure.state[first], cameras.body_T_cam[structure.camera[first]]
        move_landmark(
            frames[point], landmarks[point], eliminated.inverse[point], b, poses[k], moved_poses[k], body_T_cam,
            step[POSE * k : POSE * k + POSE], np.inf, work, moved[point],
        )  # fmt: skip
    return moved, frames


@kernel
def located(
    poses: Float, falls: Float, cameras: Cameras, landmarks: Float, structure: Structure, sigma_px: float,
    depth_information: float, everywhere: bool,
) -> Float:  # fmt: skip
    """Return the landmarks (L, 3), with those of few views (all if ``everywhere``) optimised again for fixed poses."""
    moved, rows = landmarks.copy(), np.zeros((2, COLUMNS))
    v, inverse, bl = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    by_lens = np.zeros((2 if have_moved(cameras) else 0, CAMERA))
    for point in range(len(landmarks)):
        first, last = structure.rows[point], structure.rows[point + 1]
        if last - first > _FEW and not everywhere:
            continue
        for _ in range(_STEPS):
            for c in range(3):
                bl[c] = depth_information * (moved[point, 2] - PRIOR_INVERSE_DEPTH) if c == 2 else 0.0
                for d in range(3):
                    v[c, d] = depth_information if c == 2 and d == 2 else 0.0
            for n in range(first, last):
                k, j = structure.state[n], structure.camera[n]
                if not whiten_view(
                    poses[k], falls[k], cameras, j, structure.odom_T_landmark[point], moved[point],
                    structure.rays[n], structure.readout[n], sigma_px, False, by_lens, rows,
                ):  # fmt: skip
                    continue
                for c in range(3):
                    of_u, of_v = rows[0, POINT_AT + c], rows[1, POINT_AT + c]
                    bl[c] += of_u * rows[0, ERROR_AT] + of_v * rows[1, ERROR_AT]
                    for d in range(c, 3):
                        v[c, d] += of_u * rows[0, POINT_AT + d] + of_v * rows[1, POINT_AT + d]
            v[0, 0] += 1e-9
            v[1, 1] += 1e-9
            inverse3(v, inverse)
            largest = 0.0
            for r in range(3):
                step = inverse[r, 0] * bl[0] + inverse[r, 1] * bl[1] + inverse[r, 2] * bl[2]
                moved[point, r] -= step
                largest = max(largest, abs(step))
            if largest < _LOCATED:
                break
    return moved
