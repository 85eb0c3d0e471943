"""Landmarks that single cameras see from the states of a window: reprojection errors with the landmarks eliminated.

A landmark is ``[a, b, w]``, the homogeneous point ``[a, b, 1, w]`` of a fixed frame, that of the camera which saw it
first as it was estimated then: `w` is its inverse depth there. Before there is a baseline a wide prior stands for `w`.
Where views overlap, several cameras see a landmark from one state, and know its distance in metres.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.kernels import kernel, vector_kernel
from graphvio.monocular.reprojection import (
    COLUMNS,
    ERROR_AT,
    OF_STATE,
    POINT_AT,
    POSE,
    POSE_AT,
    Cameras,
    have_moved,
    whiten_view,
)
from graphvio.self_calibration.bundle import rows_of
from graphvio.self_calibration.parameters import CAMERA, SINGLE

PRIOR_INVERSE_DEPTH = 0.2
_PRIOR_INFORMATION = 1e-2  # of an inverse depth, known to 10 / m: more would pull the scale of all landmarks
_ERROR2_BEHIND = 1e6  # of a landmark behind the camera
_STEPS = 6
_LOCATED = 1e-9  # a smaller step ends the search of a landmark's place: it is less than a millionth of a pixel
_FEW = 5  # views, of a landmark that is located again before the window is linearised


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
        by_cameras: (L, 3, C * SINGLE) coupling with the cameras' calibration, (L, 3, 0) where that is taken for known.
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
def _inverse3(m: Float, out: Float) -> None:
    """Invert a symmetric matrix (3, 3), given by its upper triangle."""
    a, b, c, d, e, f = m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]
    x, y, z = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * x + b * y + c * z
    out[0, 0], out[0, 1], out[0, 2] = x / determinant, y / determinant, z / determinant
    out[1, 1], out[1, 2] = (a * f - c * c) / determinant, (b * c - a * e) / determinant
    out[2, 2] = (a * d - b * b) / determinant
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


@vector_kernel
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
        eliminated: output; its size says whether the cameras' calibration is unknown, too.

    Returns:
        Hessian (6 K + n, 6 K + n) and gradient (6 K + n,) of poses and n parameters of cameras, robust cost, and
        squared whitened errors (N,).
    """
    n_poses, n_calibration, n_cameras = POSE * len(poses), eliminated.by_cameras.shape[2], len(cameras.focal_px)
    size, calibrates = n_poses + n_calibration, n_calibration > 0
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    errors2, cost, rows = np.zeros(len(structure.state)), 0.0, np.zeros((2, COLUMNS))
    u, v = rows[0], rows[1]
    # Lengths 16 and 24 that the compiler does not know: else it writes loops out number by number, without vectors.
    of_one, of_both = 4 * cameras.intrinsics.shape[1], 6 * cameras.intrinsics.shape[1]
    inverse, b, per_scale2 = np.zeros((3, 3)), np.zeros(3), 1.0 / (scale * scale)
    normal = np.zeros((3, 3))
    by_lens = np.zeros((2 if calibrates or have_moved(cameras) else 0, CAMERA))
    # Sums over all views of a camera from a state, by their columns, and of two cameras.
    of_states = np.zeros((len(poses) * n_cameras, POSE, OF_STATE))
    of_cameras = np.zeros((n_cameras * n_cameras, SINGLE, POSE_AT))
    # A landmark's couplings, and these times its inverse normal matrix, for all poses and cameras.
    coupled, weighed, of_camera = np.zeros((3, size)), np.zeros((3, size)), np.zeros((3, POSE_AT))
    seen, by_camera = np.zeros(n_cameras, dtype=np.bool_), np.zeros((n_cameras, 3, POSE_AT))
    for point in range(len(landmarks)):
        first, last = structure.rows[point], structure.rows[point + 1]
        if last <= first:
            continue
        begin, end = POSE * structure.state[first], POSE * (structure.state[last - 1] + 1)
        away = landmarks[point, 2] - PRIOR_INVERSE_DEPTH
        cost += 0.5 * _PRIOR_INFORMATION * away * away
        of_calibration = eliminated.by_cameras[point]
        b0, b1, b2 = 0.0, 0.0, _PRIOR_INFORMATION * away
        v00, v01, v02, v11, v12, v22 = 1e-9, 0.0, 0.0, 1e-9, 0.0, _PRIOR_INFORMATION
        for r in range(3):
            for c in range(begin, end):
                coupled[r, c] = 0.0
        for j in range(n_cameras):
            seen[j] = False
            for r in range(3):
                for c in range(of_one):
                    by_camera[j, r, c] = 0.0
        for n in range(first, last):
            k, j, by_pose = structure.state[n], structure.camera[n], eliminated.by_pose[n]
            in_front = whiten_view(
                poses[k], cameras, j, structure.odom_T_landmark[point], landmarks[point], structure.rays[n], sigma_px,
                True, by_lens, rows,
            )  # fmt: skip
            e2 = u[ERROR_AT] * u[ERROR_AT] + v[ERROR_AT] * v[ERROR_AT] if in_front else _ERROR2_BEHIND
            errors2[n] = e2
            cost += 0.5 * scale * scale * np.log(1.0 + e2 * per_scale2)
            if not in_front:
                for r in range(3):
                    for c in range(POSE):
                        by_pose[r, c] = 0.0
                continue
            root_weight = np.sqrt(1.0 / (1.0 + e2 * per_scale2))
            for c in range(of_both + 3):
                u[c] *= root_weight
                v[c] *= root_weight
            for r in range(3):
                pu, pv = u[POINT_AT + r], v[POINT_AT + r]
                for c in range(POSE):
                    by_pose[r, c] = pu * u[POSE_AT + c] + pv * v[POSE_AT + c]
                    coupled[r, POSE * k + c] += by_pose[r, c]
            sums = of_states[k * n_cameras + j]
            for c in range(POSE):
                cu, cv = u[POSE_AT + c], v[POSE_AT + c]
                sums[c, ERROR_AT] += 0.0 if calibrates else cu * u[ERROR_AT] + cv * v[ERROR_AT]
                if calibrates:
                    for d in range(of_both):
                        sums[c, d] += cu * u[d] + cv * v[d]
                else:
                    for d in range(of_one, of_both):
                        sums[c, d] += cu * u[d] + cv * v[d]
            if calibrates:
                seen[j] = True
                sums = of_cameras[j * n_cameras + j]
                for c in range(SINGLE):
                    cu, cv = u[c], v[c]
                    for d in range(of_one):
                        sums[c, d] += cu * u[d] + cv * v[d]
                for r in range(3):
                    pu, pv = u[POINT_AT + r], v[POINT_AT + r]
                    for c in range(of_one):
                        by_camera[j, r, c] += pu * u[c] + pv * v[c]
            x0, y0, z0, e0 = u[POINT_AT], u[POINT_AT + 1], u[POINT_AT + 2], u[ERROR_AT]
            x1, y1, z1, e1 = v[POINT_AT], v[POINT_AT + 1], v[POINT_AT + 2], v[ERROR_AT]
            b0, b1, b2 = b0 + x0 * e0 + x1 * e1, b1 + y0 * e0 + y1 * e1, b2 + z0 * e0 + z1 * e1
            v00, v01, v02 = v00 + x0 * x0 + x1 * x1, v01 + x0 * y0 + x1 * y1, v02 + x0 * z0 + x1 * z1
            v11, v12, v22 = v11 + y0 * y0 + y1 * y1, v12 + y0 * z0 + y1 * z1, v22 + z0 * z0 + z1 * z1
        normal[0, 0], normal[0, 1], normal[0, 2] = v00, v01, v02
        normal[1, 1], normal[1, 2], normal[2, 2] = v11, v12, v22
        b[0], b[1], b[2] = b0, b1, b2
        _inverse3(normal, inverse)
        for r in range(3):
            eliminated.gradient[point, r] = b[r]
            for c in range(3):
                eliminated.inverse[point, r, c] = inverse[r, c]
        _weigh(inverse, coupled, begin, end, weighed, b, gradient)
        for c in range(begin, end):
            _subtract(coupled, weighed, c, c, end, hessian)
        for j in range(n_cameras):
            if not seen[j]:
                continue
            at = n_poses + SINGLE * j
            for r in range(3):
                for c in range(SINGLE):
                    coupled[r, at + c] = of_calibration[r, SINGLE * j + c] = by_camera[j, r, c]
            _weigh(inverse, coupled, at, at + SINGLE, weighed, b, gradient)
            for r in range(3):
                for c in range(SINGLE):
                    of_camera[r, c] = weighed[r, at + c]
            for k in range(structure.state[first], structure.state[last - 1] + 1):
                _subtract_block(coupled, POSE * k, of_camera, of_one, of_states[k * n_cameras + j])
            for i in range(j + 1):
                if seen[i]:
                    _subtract_block(coupled, n_poses + SINGLE * i, of_camera, of_one, of_cameras[i * n_cameras + j])
    for k in range(len(poses)):
        for j in range(n_cameras):
            sums, at, at_camera = of_states[k * n_cameras + j], POSE * k, n_poses + SINGLE * j
            for c in range(POSE):
                gradient[at + c] += sums[c, ERROR_AT]
                for d in range(POSE):
                    hessian[at + c, at + d] += sums[c, POSE_AT + d]
                for d in range(SINGLE if calibrates else 0):
                    hessian[at + c, at_camera + d] += sums[c, d]
    for i in range(n_cameras if calibrates else 0):
        for j in range(i, n_cameras):
            sums, at, other = of_cameras[i * n_cameras + j], n_poses + SINGLE * i, n_poses + SINGLE * j
            for c in range(SINGLE):
                gradient[at + c] += sums[c, ERROR_AT]
                for d in range(SINGLE):
                    hessian[at + c, other + d] += sums[c, d]
    for c in range(size):
        for d in range(c):
            hessian[c, d] = hessian[d, c]
    return hessian, gradient, cost, errors2


@vector_kernel
def _weigh(
    inverse: Float, coupled: Float, begin: int, end: int, weighed: Float, of_landmark: Float, gradient: Float
) -> None:
    """Multiply a landmark's couplings with some unknowns by its inverse normal matrix, and eliminate its gradient.

    Args:
        inverse: (3, 3) of its normal matrix.
        coupled: (3, n) couplings.
        begin: first of the unknowns.
        end: of these.
        weighed: (3, n), output in their columns.
        of_landmark: (3,) its gradient.
        gradient: (n,) is changed.
    """
    b0, b1, b2 = of_landmark[0], of_landmark[1], of_landmark[2]
    if begin < 0:
        return  # never: but the compiler learns from it that no index counts from the end
    for c in range(begin, end):
        a0, a1, a2 = coupled[0, c], coupled[1, c], coupled[2, c]
        t0 = inverse[0, 0] * a0 + inverse[0, 1] * a1 + inverse[0, 2] * a2
        t1 = inverse[1, 0] * a0 + inverse[1, 1] * a1 + inverse[1, 2] * a2
        t2 = inverse[2, 0] * a0 + inverse[2, 1] * a1 + inverse[2, 2] * a2
        weighed[0, c], weighed[1, c], weighed[2, c] = t0, t1, t2
        gradient[c] -= t0 * b0 + t1 * b1 + t2 * b2


@vector_kernel
def _subtract(coupled: Float, weighed: Float, row: int, begin: int, end: int, hessian: Float) -> None:
    """Subtract what a landmark takes from one row of the normal equations (n, n), in some columns of it."""
    a0, a1, a2 = coupled[0, row], coupled[1, row], coupled[2, row]
    if begin < 0 or (a0 == 0.0 and a1 == 0.0 and a2 == 0.0):  # the state does not see it
        return
    for d in range(begin, end):
        hessian[row, d] -= a0 * weighed[0, d] + a1 * weighed[1, d] + a2 * weighed[2, d]


@vector_kernel
def _subtract_block(coupled: Float, at: int, of_camera: Float, n_columns: int, sums: Float) -> None:
    """Subtract what a landmark takes from the normal equations of a few unknowns and a camera.

    Args:
        coupled: (3, n) couplings of all unknowns.
        at: first of the few.
        of_camera: (3, 16) what the camera's couplings were weighed to; the last column is zero.
        n_columns: 16.
        sums: (R, 16 at least) of R unknowns, is changed.
    """
    for c in range(len(sums)):
        a0, a1, a2 = coupled[0, at + c], coupled[1, at + c], coupled[2, at + c]
        for d in range(n_columns):
            sums[c, d] -= a0 * of_camera[0, d] + a1 * of_camera[1, d] + a2 * of_camera[2, d]


@kernel
def landmarks_after(
    landmarks: Float, structure: Structure, eliminated: Eliminated, step: Float, n_states: int
) -> Float:
    """Return the landmarks (L, 3) after a step (6 K + n,) of K states' poses and n parameters of cameras."""
    moved, b, n_poses = landmarks.copy(), np.zeros(3), POSE * n_states
    for point in range(len(landmarks)):
        for r in range(3):
            b[r] = eliminated.gradient[point, r]
            for n in range(structure.rows[point], structure.rows[point + 1]):
                for c in range(POSE):
                    b[r] += eliminated.by_pose[n, r, c] * step[POSE * structure.state[n] + c]
            for c in range(eliminated.by_cameras.shape[2]):
                b[r] += eliminated.by_cameras[point, r, c] * step[n_poses + c]
        for r in range(3):
            for c in range(3):
                moved[point, r] -= eliminated.inverse[point, r, c] * b[c]
    return moved


@kernel
def located(
    poses: Float, cameras: Cameras, landmarks: Float, structure: Structure, sigma_px: float, everywhere: bool
) -> Float:
    """Return the landmarks (L, 3) with those of few views, or all, located again for poses that stay."""
    moved, rows = landmarks.copy(), np.zeros((2, COLUMNS))
    v, inverse, bl = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    by_lens = np.zeros((2 if have_moved(cameras) else 0, CAMERA))
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
                if not whiten_view(
                    poses[structure.state[n]], cameras, j, structure.odom_T_landmark[point], moved[point],
                    structure.rays[n], sigma_px, False, by_lens, rows,
                ):  # fmt: skip
                    continue
                for c in range(3):
                    of_u, of_v = rows[0, POINT_AT + c], rows[1, POINT_AT + c]
                    bl[c] += of_u * rows[0, ERROR_AT] + of_v * rows[1, ERROR_AT]
                    for d in range(c, 3):
                        v[c, d] += of_u * rows[0, POINT_AT + d] + of_v * rows[1, POINT_AT + d]
            v[0, 0] += 1e-9
            v[1, 1] += 1e-9
            _inverse3(v, inverse)
            largest = 0.0
            for r in range(3):
                step = inverse[r, 0] * bl[0] + inverse[r, 1] * bl[1] + inverse[r, 2] * bl[2]
                moved[point, r] -= step
                largest = max(largest, abs(step))
            if largest < _LOCATED:
                break
    return moved
