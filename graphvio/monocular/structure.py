"""Landmarks that single cameras see from the states of a window: reprojection errors with the landmarks eliminated.

A landmark is ``[a, b, w]``, the homogeneous point ``[a, b, 1, w]`` of a fixed frame, that of the camera which saw it
first as it was estimated then: `w` is its inverse depth there. Before there is a baseline a wide prior stands for `w`.
Where views overlap, several cameras see a landmark from one state, and know its distance in metres.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.cameras import distort, distortion_basis
from graphvio.geometry import so3_exp
from graphvio.kernels import kernel
from graphvio.rig import Rig
from graphvio.self_calibration.bundle import rows_of
from graphvio.self_calibration.parameters import CAMERA, INTRINSICS, PLACE, SINGLE

POSE = 6
_PLACE_AT = POSE + PLACE  # columns of a view's rows
_POINT_AT = POSE + SINGLE
_ERROR_AT = _POINT_AT + 3
_COLUMNS = _ERROR_AT + 1

PRIOR_INVERSE_DEPTH = 0.2
_PRIOR_INFORMATION = 1e-2  # of an inverse depth, known to 10 / m: more would pull the scale of all landmarks
_ERROR2_BEHIND = 1e6  # of a landmark behind the camera
_MIN_DEPTH_RATIO = 1e-3
_STEPS = 6
_FEW = 5  # views, of a landmark that is located again before the window is linearised


class Cameras(NamedTuple):
    """C cameras as kernels take them, and how they differ from the rig file.

    Attributes:
        body_T_cam: (C, 4, 4) with the difference.
        focal_px: (C,) pixels per normalised image unit.
        models: (C,) numbers of the camera models.
        intrinsics: (C, 4) ``[fx, fy, cx, cy]`` of the rig file, by which pixels became rays.
        distortion: (C, 8) of the rig file, likewise.
        lenses: (C, 9) difference of intrinsics and distortion from these.
    """

    body_T_cam: Float
    focal_px: Float
    models: Int
    intrinsics: Float
    distortion: Float
    lenses: Float

    @staticmethod
    def of(rig: Rig) -> "Cameras":
        """Collect the arrays of a rig of single cameras."""
        cameras = [single.left for single in rig.singles]
        return Cameras(
            np.array([camera.body_T_cam for camera in cameras]),
            np.array([camera.focal_px for camera in cameras]),
            np.array([camera.model_number for camera in cameras], dtype=np.int64),
            np.array([camera.intrinsics for camera in cameras]),
            np.array([camera.distortion for camera in cameras]),
            np.zeros((len(cameras), CAMERA)),
        )

    def moved(self, difference: Float) -> "Cameras":
        """Return the cameras that differ from these by a vector (C * SINGLE,)."""
        each, body_T_cam = difference.reshape(-1, SINGLE), self.body_T_cam.copy()
        for pose, place in zip(body_T_cam, each[:, PLACE:], strict=True):
            pose[:3, :3] = so3_exp(place[:3].copy()) @ pose[:3, :3]
            pose[:3, 3] += place[3:]
        return self._replace(body_T_cam=body_T_cam, lenses=self.lenses + each[:, :PLACE])


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
def _by_lens(cameras: Cameras, j: int, x: float, y: float, out: Float) -> None:
    """Fill the derivatives (2, 9) of a ray by the lens, for a pixel that stays where it was seen.

    They are wanted where a ray is expected. At the ray that was seen, they would go along with its noise: over tens of
    thousands of views, that is a focal length which is wrong by six standard deviations.
    """
    distortion, fx, fy = cameras.distortion[j], cameras.intrinsics[j, 0], cameras.intrinsics[j, 1]
    u, v, uu, uv, vu, vv = distort(cameras.models[j], distortion, x, y)
    determinant = uu * vv - uv * vu
    if not determinant > 0.0:
        determinant = np.inf  # beyond the lens's domain: no derivatives
    basis = distortion_basis(cameras.models[j], distortion, x, y)
    for c in range(CAMERA):
        du, dv = 0.0, 0.0  # of the distorted coordinates
        if c == 0:
            du = u / fx
        elif c == 1:
            dv = v / fy
        elif c == 2:
            du = 1.0 / fx
        elif c == 3:
            dv = 1.0 / fy
        else:
            du, dv = basis[c - INTRINSICS, 0], basis[c - INTRINSICS, 1]
        out[0, c] = -(vv * du - uv * dv) / determinant
        out[1, c] = -(uu * dv - vu * du) / determinant


@kernel
def _view(
    pose: Float, cameras: Cameras, j: int, frame: Float, landmark: Float, ray: Float, sigma_px: float,
    by_lens: Float, rows: Float,
) -> bool:  # fmt: skip
    """Fill the rows (2, _COLUMNS) of one view: derivatives by pose, camera and landmark, and the error, whitened.

    Args:
        pose: (4, 4) ``odom_T_body``.
        cameras: of the rig.
        j: index of the camera.
        frame: (4, 4) of the landmark in odom.
        landmark: (3,).
        ray: (2,) that was seen, by the lens of the rig file.
        sigma_px: noise of a corner's position.
        by_lens: (2, 9) for intermediate results; (0, 9) where the lens is that of the rig file, and no derivatives by
            the camera are wanted.
        rows: output.

    Returns:
        Whether the landmark is in front of the camera.
    """
    a, b, w, body_T_cam = landmark[0], landmark[1], landmark[2], cameras.body_T_cam[j]
    scale = cameras.focal_px[j] / sigma_px
    odom, body, left, cam = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for r in range(3):
        odom[r] = frame[r, 0] * a + frame[r, 1] * b + frame[r, 2] + w * (frame[r, 3] - pose[r, 3])
    for r in range(3):
        body[r] = pose[0, r] * odom[0] + pose[1, r] * odom[1] + pose[2, r] * odom[2]
        left[r] = body[r] - w * body_T_cam[r, 3]
    for r in range(3):
        cam[r] = 0.0
        for k in range(3):
            cam[r] += body_T_cam[k, r] * left[k]
    if not cam[2] > _MIN_DEPTH_RATIO:
        return False
    u, v = cam[0] / cam[2], cam[1] / cam[2]
    if len(by_lens):
        _by_lens(cameras, j, u, v, by_lens)
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
        rows[r, _POINT_AT] = o0 * frame[0, 0] + o1 * frame[1, 0] + o2 * frame[2, 0]
        rows[r, _POINT_AT + 1] = o0 * frame[0, 1] + o1 * frame[1, 1] + o2 * frame[2, 1]
        rows[r, _POINT_AT + 2] = (
            o0 * (frame[0, 3] - pose[0, 3])
            + o1 * (frame[1, 3] - pose[1, 3])
            + o2 * (frame[2, 3] - pose[2, 3])
            - m0 * body_T_cam[0, 3]
            - m1 * body_T_cam[1, 3]
            - m2 * body_T_cam[2, 3]
        )
        rows[r, _ERROR_AT] = scale * (at - ray[r])
        if len(by_lens):
            for c in range(CAMERA):
                rows[r, POSE + c] = -scale * by_lens[r, c]
                rows[r, _ERROR_AT] -= scale * by_lens[r, c] * cameras.lenses[j, c]
            rows[r, _PLACE_AT] = m1 * left[2] - m2 * left[1]
            rows[r, _PLACE_AT + 1] = m2 * left[0] - m0 * left[2]
            rows[r, _PLACE_AT + 2] = m0 * left[1] - m1 * left[0]
            for c in range(3):
                rows[r, _PLACE_AT + 3 + c] = rows[r, 3 + c]
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
        eliminated: output; its size says whether the cameras' calibration is unknown, too.

    Returns:
        Hessian (6 K + n, 6 K + n) and gradient (6 K + n,) of poses and n parameters of cameras, robust cost, and
        squared whitened errors (N,).
    """
    n_poses, n_calibration, n_cameras = POSE * len(poses), eliminated.by_cameras.shape[2], len(cameras.focal_px)
    size, calibrates = n_poses + n_calibration, n_calibration > 0
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    errors2, cost, rows, v, bl = (
        np.zeros(len(structure.state)),
        0.0,
        np.zeros((2, _COLUMNS)),
        np.zeros((3, 3)),
        np.zeros(3),
    )
    by_lens = np.zeros((2 if calibrates or _have_moved(cameras) else 0, CAMERA))
    of_camera_end = _POINT_AT if calibrates else POSE
    seen, weighed = np.zeros(n_cameras, dtype=np.bool_), np.zeros((3, n_calibration))
    for point in range(len(landmarks)):
        first, last = structure.rows[point], structure.rows[point + 1]
        away = landmarks[point, 2] - PRIOR_INVERSE_DEPTH
        cost += 0.5 * _PRIOR_INFORMATION * away * away
        by_cameras = eliminated.by_cameras[point]
        for c in range(3):
            bl[c] = _PRIOR_INFORMATION * away if c == 2 else 0.0
            for d in range(3):
                v[c, d] = _PRIOR_INFORMATION if c == 2 and d == 2 else 0.0
        for j in range(n_cameras):
            seen[j] = False
        for n in range(first, last):
            k, j, couplings = POSE * structure.state[n], structure.camera[n], eliminated.by_pose[n]
            in_front = _view(
                poses[structure.state[n]], cameras, j, structure.odom_T_landmark[point], landmarks[point],
                structure.rays[n], sigma_px, by_lens, rows,
            )  # fmt: skip
            e2 = rows[0, _ERROR_AT] ** 2 + rows[1, _ERROR_AT] ** 2 if in_front else _ERROR2_BEHIND
            errors2[n] = e2
            cost += 0.5 * scale * scale * np.log(1.0 + e2 / (scale * scale))
            weight = 1.0 / (1.0 + e2 / (scale * scale)) if in_front else 0.0
            at = n_poses + SINGLE * j - POSE  # where column POSE of the rows is
            for c in range(POSE):
                for d in range(3):
                    couplings[d, c] = weight * (
                        rows[0, c] * rows[0, _POINT_AT + d] + rows[1, c] * rows[1, _POINT_AT + d]
                    )
                gradient[k + c] += weight * (rows[0, c] * rows[0, _ERROR_AT] + rows[1, c] * rows[1, _ERROR_AT])
                for d in range(c, POSE):
                    hessian[k + c, k + d] += weight * (rows[0, c] * rows[0, d] + rows[1, c] * rows[1, d])
                for d in range(POSE, of_camera_end):
                    hessian[k + c, at + d] += weight * (rows[0, c] * rows[0, d] + rows[1, c] * rows[1, d])
            if calibrates and in_front:
                seen[j] = True
                for c in range(POSE, _POINT_AT):
                    of_u, of_v = weight * rows[0, c], weight * rows[1, c]
                    for d in range(3):
                        by_cameras[d, SINGLE * j + c - POSE] += (
                            of_u * rows[0, _POINT_AT + d] + of_v * rows[1, _POINT_AT + d]
                        )
                    gradient[at + c] += of_u * rows[0, _ERROR_AT] + of_v * rows[1, _ERROR_AT]
                    for d in range(c, _POINT_AT):
                        hessian[at + c, at + d] += of_u * rows[0, d] + of_v * rows[1, d]
            for c in range(3):
                bl[c] += weight * (
                    rows[0, _POINT_AT + c] * rows[0, _ERROR_AT] + rows[1, _POINT_AT + c] * rows[1, _ERROR_AT]
                )
                for d in range(c, 3):
                    v[c, d] += weight * (
                        rows[0, _POINT_AT + c] * rows[0, _POINT_AT + d]
                        + rows[1, _POINT_AT + c] * rows[1, _POINT_AT + d]
                    )
        v[0, 0] += 1e-9
        v[1, 1] += 1e-9
        inverse = eliminated.inverse[point]
        _inverse3(v, inverse)
        for c in range(3):
            eliminated.gradient[point, c] = bl[c]
        for n in range(first, last):
            k, one = POSE * structure.state[n], eliminated.by_pose[n]
            for c in range(POSE):
                x = inverse[0, 0] * one[0, c] + inverse[0, 1] * one[1, c] + inverse[0, 2] * one[2, c]
                y = inverse[1, 0] * one[0, c] + inverse[1, 1] * one[1, c] + inverse[1, 2] * one[2, c]
                z = inverse[2, 0] * one[0, c] + inverse[2, 1] * one[1, c] + inverse[2, 2] * one[2, c]
                gradient[k + c] -= x * bl[0] + y * bl[1] + z * bl[2]
                for m in range(n, last):
                    other, k2 = eliminated.by_pose[m], POSE * structure.state[m]
                    for d in range(c if m == n else 0, POSE):
                        product = x * other[0, d] + y * other[1, d] + z * other[2, d]
                        if k == k2 and m > n:  # of one state: the block's other half is this one's transpose
                            hessian[k + min(c, d), k + max(c, d)] -= 2.0 * product if c == d else product
                        else:
                            hessian[k + c, k2 + d] -= product
                for j in range(n_cameras if calibrates else 0):
                    if seen[j]:
                        for d in range(SINGLE * j, SINGLE * (j + 1)):
                            hessian[k + c, n_poses + d] -= (
                                x * by_cameras[0, d] + y * by_cameras[1, d] + z * by_cameras[2, d]
                            )
        if calibrates:
            _eliminate_from_cameras(inverse, bl, by_cameras, seen, weighed, hessian, gradient)
    for c in range(size):
        for d in range(c):
            hessian[c, d] = hessian[d, c]
    return hessian, gradient, cost, errors2


@kernel
def _eliminate_from_cameras(
    inverse: Float, bl: Float, by_cameras: Float, seen: Bool, weighed: Float, hessian: Float, gradient: Float
) -> None:
    """Subtract what a landmark takes from the information on the parameters (n,) of the cameras that see it.

    Args:
        inverse: (3, 3) of the landmark's normal matrix.
        bl: (3,) gradient by the landmark.
        by_cameras: (3, n) coupling.
        seen: (C,) which cameras see it.
        weighed: (3, n) for intermediate results.
        hessian: whose last n columns are changed, in the upper triangle.
        gradient: whose last n elements are changed.
    """
    at = len(gradient) - by_cameras.shape[1]
    for i in range(len(seen)):
        for c in range(SINGLE * i, SINGLE * (i + 1) if seen[i] else 0):
            for r in range(3):
                weighed[r, c] = (
                    inverse[r, 0] * by_cameras[0, c]
                    + inverse[r, 1] * by_cameras[1, c]
                    + inverse[r, 2] * by_cameras[2, c]
                )
            x, y, z = weighed[0, c], weighed[1, c], weighed[2, c]
            gradient[at + c] -= x * bl[0] + y * bl[1] + z * bl[2]
            for j in range(i, len(seen)):
                for d in range(max(c, SINGLE * j), SINGLE * (j + 1) if seen[j] else 0):
                    hessian[at + c, at + d] -= x * by_cameras[0, d] + y * by_cameras[1, d] + z * by_cameras[2, d]


@kernel
def _have_moved(cameras: Cameras) -> bool:
    """Return whether a lens differs from that of the rig file."""
    for j in range(len(cameras.lenses)):
        for c in range(CAMERA):
            if cameras.lenses[j, c] != 0.0:
                return True
    return False


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
    moved, rows = landmarks.copy(), np.zeros((2, _COLUMNS))
    v, inverse, bl = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    by_lens = np.zeros((2 if _have_moved(cameras) else 0, CAMERA))
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
                    poses[structure.state[n]], cameras, j, structure.odom_T_landmark[point], moved[point],
                    structure.rays[n], sigma_px, by_lens, rows,
                ):  # fmt: skip
                    continue
                for c in range(3):
                    of_u, of_v = rows[0, _POINT_AT + c], rows[1, _POINT_AT + c]
                    bl[c] += of_u * rows[0, _ERROR_AT] + of_v * rows[1, _ERROR_AT]
                    for d in range(c, 3):
                        v[c, d] += of_u * rows[0, _POINT_AT + d] + of_v * rows[1, _POINT_AT + d]
            v[0, 0] += 1e-9
            v[1, 1] += 1e-9
            _inverse3(v, inverse)
            for r in range(3):
                for c in range(3):
                    moved[point, r] -= inverse[r, c] * bl[c]
    return moved
