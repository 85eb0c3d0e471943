"""Landmarks that single cameras see from the states of a window: reprojection errors with the landmarks eliminated.

A landmark is ``[a, b, w]``, the homogeneous point ``[a, b, 1, w]`` of a fixed frame, that of the camera which saw it
first as it was estimated then: `w` is its inverse depth there. Before there is a baseline a wide prior stands for `w`.
Where views overlap, several cameras see a landmark from one state, and know its distance in metres.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.kernels import kernel
from graphvio.self_calibration.bundle import rows_of

PRIOR_INVERSE_DEPTH = 0.2
_PRIOR_INFORMATION = 1e-2  # of an inverse depth, known to 10 / m: more would pull the scale of all landmarks
_ERROR2_BEHIND = 1e6  # of a landmark behind the camera
_MIN_DEPTH_RATIO = 1e-3
_STEPS = 6
_FEW = 5  # views, of a landmark that is located again before the window is linearised


class Cameras(NamedTuple):
    """C cameras as kernels take them.

    Attributes:
        body_T_cam: (C, 4, 4).
        focal_px: (C,) pixels per normalised image unit.
    """

    body_T_cam: Float
    focal_px: Float


class Structure(NamedTuple):
    """Views of L landmarks from K states: N rows, sorted by landmark.

    Attributes:
        odom_T_landmark: (L, 4, 4) fixed frame of each.
        rows: (L + 1,) the views of landmark l are ``rows[l]`` to ``rows[l + 1]``, in the order of states and cameras.
        state: (N,) index of the state.
        camera: (N,) index of the camera.
        rays: (N, 2) normalised coordinates.
    """

    odom_T_landmark: Float
    rows: Int
    state: Int
    camera: Int
    rays: Float

    def of(self, kept: Bool) -> "Structure":
        """Return those of the landmarks (L,) that are kept."""
        rows, begins = rows_of(self.rows, kept)
        return Structure(self.odom_T_landmark[kept], begins, self.state[rows], self.camera[rows], self.rays[rows])


class Eliminated(NamedTuple):
    """What the elimination of the landmarks leaves behind, to find them again.

    Attributes:
        inverse: (L, 3, 3) of their normal matrices.
        gradient: (L, 3).
        by_pose: (N, 3, 6) coupling of each view with its state's pose.
    """

    inverse: Float
    gradient: Float
    by_pose: Float

    @staticmethod
    def empty(structure: Structure) -> "Eliminated":
        """Allocate for a structure."""
        n = len(structure.odom_T_landmark)
        return Eliminated(np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((len(structure.state), 3, 6)))


@kernel
def _view(pose: Float, body_T_cam: Float, frame: Float, landmark: Float, ray: Float, scale: float, rows: Float) -> bool:
    """Fill the rows (2, 10) of one view: derivatives by pose (6) and landmark (3), and the error, whitened by a scale.

    Returns:
        Whether the landmark is in front of the camera.
    """
    a, b, w = landmark[0], landmark[1], landmark[2]
    odom, body, cam = np.empty(3), np.empty(3), np.empty(3)
    for r in range(3):
        odom[r] = frame[r, 0] * a + frame[r, 1] * b + frame[r, 2] + w * (frame[r, 3] - pose[r, 3])
    for r in range(3):
        body[r] = pose[0, r] * odom[0] + pose[1, r] * odom[1] + pose[2, r] * odom[2]
    for r in range(3):
        cam[r] = 0.0
        for k in range(3):
            cam[r] += body_T_cam[k, r] * (body[k] - w * body_T_cam[k, 3])
    if not cam[2] > _MIN_DEPTH_RATIO:
        return False
    u, v = cam[0] / cam[2], cam[1] / cam[2]
    for r in range(2):
        at = u if r == 0 else v
        m0 = scale * (body_T_cam[0, r] - at * body_T_cam[0, 2]) / cam[2]
        m1 = scale * (body_T_cam[1, r] - at * body_T_cam[1, 2]) / cam[2]
        m2 = scale * (body_T_cam[2, r] - at * body_T_cam[2, 2]) / cam[2]
        rows[r, 0] = m1 * body[2] - m2 * body[1]
        rows[r, 1] = m2 * body[0] - m0 * body[2]
        rows[r, 2] = m0 * body[1] - m1 * body[0]
        rows[r, 3], rows[r, 4], rows[r, 5] = -w * m0, -w * m1, -w * m2
        # From body to odom, and there by the columns of the landmark's frame.
        o0 = m0 * pose[0, 0] + m1 * pose[0, 1] + m2 * pose[0, 2]
        o1 = m0 * pose[1, 0] + m1 * pose[1, 1] + m2 * pose[1, 2]
        o2 = m0 * pose[2, 0] + m1 * pose[2, 1] + m2 * pose[2, 2]
        rows[r, 6] = o0 * frame[0, 0] + o1 * frame[1, 0] + o2 * frame[2, 0]
        rows[r, 7] = o0 * frame[0, 1] + o1 * frame[1, 1] + o2 * frame[2, 1]
        rows[r, 8] = (
            o0 * (frame[0, 3] - pose[0, 3])
            + o1 * (frame[1, 3] - pose[1, 3])
            + o2 * (frame[2, 3] - pose[2, 3])
            - m0 * body_T_cam[0, 3]
            - m1 * body_T_cam[1, 3]
            - m2 * body_T_cam[2, 3]
        )
        rows[r, 9] = scale * (at - ray[r])
    return True


@kernel
def _inverse3(m: Float, out: Float) -> None:
    """Invert a symmetric matrix (3, 3), given by its upper triangle."""
    a, b, c, d, e, f = m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]
    x, y, z = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * x + b * y + c * z
    out[0, 0], out[0, 1], out[0, 2] = x / determinant, y / determinant, z / determinant
    out[1, 1], out[1, 2] = (a * f - c * c) / determinant, (b * c - a * e) / determinant
    out[2, 2] = (a * d - b * b) / determinant
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


@kernel
def visual_equations(
    poses: Float, cameras: Cameras, landmarks: Float, structure: Structure, sigma_px: float, scale: float,
    eliminated: Eliminated,
) -> tuple[Float, Float, float, Float]:  # fmt: skip
    """Linearise the reprojection errors, with the landmarks eliminated.

    Args:
        poses: (K, 4, 4) ``odom_T_body``; perturbed on the right, ``R Exp(r)``, ``p + R t``.
        cameras: that see the landmarks.
        landmarks: (L, 3).
        structure: of these.
        sigma_px: noise of a corner's position.
        scale: of the Cauchy cost, in whitened units.
        eliminated: output.

    Returns:
        Hessian (6 K, 6 K) and gradient (6 K,) of the poses, robust cost, and squared whitened errors (N,).
    """
    size = 6 * len(poses)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    errors2, cost, rows, v, bl = np.zeros(len(structure.state)), 0.0, np.zeros((2, 10)), np.zeros((3, 3)), np.zeros(3)
    for point in range(len(landmarks)):
        first, last = structure.rows[point], structure.rows[point + 1]
        away = landmarks[point, 2] - PRIOR_INVERSE_DEPTH
        cost += 0.5 * _PRIOR_INFORMATION * away * away
        for c in range(3):
            bl[c] = _PRIOR_INFORMATION * away if c == 2 else 0.0
            for d in range(3):
                v[c, d] = _PRIOR_INFORMATION if c == 2 and d == 2 else 0.0
        for n in range(first, last):
            k, j, couplings = 6 * structure.state[n], structure.camera[n], eliminated.by_pose[n]
            in_front = _view(
                poses[structure.state[n]], cameras.body_T_cam[j], structure.odom_T_landmark[point], landmarks[point],
                structure.rays[n], cameras.focal_px[j] / sigma_px, rows,
            )  # fmt: skip
            e2 = rows[0, 9] ** 2 + rows[1, 9] ** 2 if in_front else _ERROR2_BEHIND
            errors2[n] = e2
            cost += 0.5 * scale * scale * np.log(1.0 + e2 / (scale * scale))
            weight = 1.0 / (1.0 + e2 / (scale * scale)) if in_front else 0.0
            for c in range(6):
                for d in range(3):
                    couplings[d, c] = weight * (rows[0, c] * rows[0, 6 + d] + rows[1, c] * rows[1, 6 + d])
                gradient[k + c] += weight * (rows[0, c] * rows[0, 9] + rows[1, c] * rows[1, 9])
                for d in range(c, 6):
                    hessian[k + c, k + d] += weight * (rows[0, c] * rows[0, d] + rows[1, c] * rows[1, d])
            for c in range(3):
                bl[c] += weight * (rows[0, 6 + c] * rows[0, 9] + rows[1, 6 + c] * rows[1, 9])
                for d in range(c, 3):
                    v[c, d] += weight * (rows[0, 6 + c] * rows[0, 6 + d] + rows[1, 6 + c] * rows[1, 6 + d])
        v[0, 0] += 1e-9
        v[1, 1] += 1e-9
        inverse = eliminated.inverse[point]
        _inverse3(v, inverse)
        for c in range(3):
            eliminated.gradient[point, c] = bl[c]
        for n in range(first, last):
            k, one = 6 * structure.state[n], eliminated.by_pose[n]
            for c in range(6):
                x = inverse[0, 0] * one[0, c] + inverse[0, 1] * one[1, c] + inverse[0, 2] * one[2, c]
                y = inverse[1, 0] * one[0, c] + inverse[1, 1] * one[1, c] + inverse[1, 2] * one[2, c]
                z = inverse[2, 0] * one[0, c] + inverse[2, 1] * one[1, c] + inverse[2, 2] * one[2, c]
                gradient[k + c] -= x * bl[0] + y * bl[1] + z * bl[2]
                for m in range(n, last):
                    other, k2 = eliminated.by_pose[m], 6 * structure.state[m]
                    for d in range(c if m == n else 0, 6):
                        product = x * other[0, d] + y * other[1, d] + z * other[2, d]
                        if k == k2 and m > n:  # of one state: the block's other half is this one's transpose
                            hessian[k + min(c, d), k + max(c, d)] -= 2.0 * product if c == d else product
                        else:
                            hessian[k + c, k2 + d] -= product
    for c in range(size):
        for d in range(c):
            hessian[c, d] = hessian[d, c]
    return hessian, gradient, cost, errors2


@kernel
def landmarks_after(landmarks: Float, structure: Structure, eliminated: Eliminated, step: Float) -> Float:
    """Return the landmarks (L, 3) after a step (6 K,) of the poses."""
    moved, b = landmarks.copy(), np.zeros(3)
    for point in range(len(landmarks)):
        for r in range(3):
            b[r] = eliminated.gradient[point, r]
            for n in range(structure.rows[point], structure.rows[point + 1]):
                for c in range(6):
                    b[r] += eliminated.by_pose[n, r, c] * step[6 * structure.state[n] + c]
        for r in range(3):
            for c in range(3):
                moved[point, r] -= eliminated.inverse[point, r, c] * b[c]
    return moved


@kernel
def located(
    poses: Float, cameras: Cameras, landmarks: Float, structure: Structure, sigma_px: float, everywhere: bool
) -> Float:
    """Return the landmarks (L, 3) with those of few views, or all, located again for poses that stay."""
    moved, rows, v, inverse, bl = landmarks.copy(), np.zeros((2, 10)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    for point in range(len(landmarks)):
        first, last = structure.rows[point], structure.rows[point + 1]
        if last - first > _FEW and not everywhere:
            continue
        for _ in range(_STEPS):
            for c in range(3):
                bl[c] = _PRIOR_INFORMATION * (moved[point, 2] - PRIOR_INVERSE_DEPTH) if c == 2 else 0.0
                for d in range(3):
                    v[c, d] = _PRIOR_INFORMATION if c == 2 and d == 2 else 0.0
            for n in range(first, last):
                j = structure.camera[n]
                if not _view(
                    poses[structure.state[n]], cameras.body_T_cam[j], structure.odom_T_landmark[point], moved[point],
                    structure.rays[n], cameras.focal_px[j] / sigma_px, rows,
                ):  # fmt: skip
                    continue
                for c in range(3):
                    bl[c] += rows[0, 6 + c] * rows[0, 9] + rows[1, 6 + c] * rows[1, 9]
                    for d in range(c, 3):
                        v[c, d] += rows[0, 6 + c] * rows[0, 6 + d] + rows[1, 6 + c] * rows[1, 6 + d]
            v[0, 0] += 1e-9
            v[1, 1] += 1e-9
            _inverse3(v, inverse)
            for r in range(3):
                for c in range(3):
                    moved[point, r] -= inverse[r, c] * bl[c]
    return moved
