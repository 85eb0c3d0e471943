"""Landmarks that single cameras see from the states of a window: reprojection errors with the landmarks eliminated.

A landmark is ``[a, b, w]``, the homogeneous point ``[a, b, 1, w]`` of a fixed frame, that of the camera which saw it
first as it was estimated then: `w` is its inverse depth there. Before there is a baseline a wide prior stands for `w`.
Where views overlap, several cameras see a landmark from one state, and know its distance in metres.
"""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.cameras import N_BASIS, distort, distortion_basis
from graphvio.geometry import so3_exp
from graphvio.kernels import kernel, vector_kernel
from graphvio.rig import Rig
from graphvio.self_calibration.bundle import rows_of
from graphvio.self_calibration.parameters import CAMERA, INTRINSICS, PLACE, SINGLE

POSE = 6
# Columns of a view's rows: [camera 15, error, pose 6, none 2, landmark 3], so that loops over them have lengths of 16
# and 24, which fill vector registers.
_ERROR_AT = SINGLE
_POSE_AT = _ERROR_AT + 1
_OF_STATE = 24
_POINT_AT = _OF_STATE
_COLUMNS = _POINT_AT + 3

PRIOR_INVERSE_DEPTH = 0.2
_PRIOR_INFORMATION = 1e-2  # of an inverse depth, known to 10 / m: more would pull the scale of all landmarks
_ERROR2_BEHIND = 1e6  # of a landmark behind the camera
_MIN_DEPTH_RATIO = 1e-3
_STEPS = 6
_LOCATED = 1e-9  # a smaller step ends the search of a landmark's place: it is less than a millionth of a pixel
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
    # Minus the inverse of the Jacobian, which takes the distorted coordinates' derivatives to those of the ray.
    inverse = 1.0 / determinant
    xu, xv, yu, yv = -vv * inverse, uv * inverse, vu * inverse, -uu * inverse
    per_fx, per_fy = 1.0 / fx, 1.0 / fy
    out[0, 0], out[1, 0], out[0, 1], out[1, 1] = xu * u * per_fx, yu * u * per_fx, xv * v * per_fy, yv * v * per_fy
    out[0, 2], out[1, 2], out[0, 3], out[1, 3] = xu * per_fx, yu * per_fx, xv * per_fy, yv * per_fy
    for c in range(N_BASIS):
        out[0, INTRINSICS + c] = xu * basis[c, 0] + xv * basis[c, 1]
        out[1, INTRINSICS + c] = yu * basis[c, 0] + yv * basis[c, 1]


@kernel
def _view(
    pose: Float, cameras: Cameras, j: int, frame: Float, landmark: Float, ray: Float, sigma_px: float,
    of_state: bool, by_lens: Float, rows: Float,
) -> bool:  # fmt: skip
    """Fill the rows (2, _COLUMNS) of one view: derivatives by pose, camera and landmark, and the error, whitened.

    Coordinates are variables throughout: arrays would be allocated for each view.

    Args:
        pose: (4, 4) ``odom_T_body``.
        cameras: of the rig.
        j: index of the camera.
        frame: (4, 4) of the landmark in odom.
        landmark: (3,).
        ray: (2,) that was seen, by the lens of the rig file.
        sigma_px: noise of a corner's position.
        of_state: whether derivatives by pose and camera are wanted, too.
        by_lens: (2, 9) for intermediate results; (0, 9) where the lens is that of the rig file, and no derivatives by
            the camera are wanted.
        rows: output.

    Returns:
        Whether the landmark is in front of the camera.
    """
    a, b, w, body_T_cam = landmark[0], landmark[1], landmark[2], cameras.body_T_cam[j]
    scale = cameras.focal_px[j] / sigma_px
    from_x, from_y, from_z = frame[0, 3] - pose[0, 3], frame[1, 3] - pose[1, 3], frame[2, 3] - pose[2, 3]
    odom_x = frame[0, 0] * a + frame[0, 1] * b + frame[0, 2] + w * from_x
    odom_y = frame[1, 0] * a + frame[1, 1] * b + frame[1, 2] + w * from_y
    odom_z = frame[2, 0] * a + frame[2, 1] * b + frame[2, 2] + w * from_z
    body_x = pose[0, 0] * odom_x + pose[1, 0] * odom_y + pose[2, 0] * odom_z
    body_y = pose[0, 1] * odom_x + pose[1, 1] * odom_y + pose[2, 1] * odom_z
    body_z = pose[0, 2] * odom_x + pose[1, 2] * odom_y + pose[2, 2] * odom_z
    left_x, left_y, left_z = body_x - w * body_T_cam[0, 3], body_y - w * body_T_cam[1, 3], body_z - w * body_T_cam[2, 3]
    cam_x = body_T_cam[0, 0] * left_x + body_T_cam[1, 0] * left_y + body_T_cam[2, 0] * left_z
    cam_y = body_T_cam[0, 1] * left_x + body_T_cam[1, 1] * left_y + body_T_cam[2, 1] * left_z
    cam_z = body_T_cam[0, 2] * left_x + body_T_cam[1, 2] * left_y + body_T_cam[2, 2] * left_z
    if not cam_z > _MIN_DEPTH_RATIO:
        return False
    u, v, by_depth = cam_x / cam_z, cam_y / cam_z, scale / cam_z
    if len(by_lens):
        _by_lens(cameras, j, u, v, by_lens)
    for r in range(2):
        at = u if r == 0 else v
        m0 = by_depth * (body_T_cam[0, r] - at * body_T_cam[0, 2])
        m1 = by_depth * (body_T_cam[1, r] - at * body_T_cam[1, 2])
        m2 = by_depth * (body_T_cam[2, r] - at * body_T_cam[2, 2])
        # From body to odom, and there by the columns of the landmark's frame.
        o0 = m0 * pose[0, 0] + m1 * pose[0, 1] + m2 * pose[0, 2]
        o1 = m0 * pose[1, 0] + m1 * pose[1, 1] + m2 * pose[1, 2]
        o2 = m0 * pose[2, 0] + m1 * pose[2, 1] + m2 * pose[2, 2]
        rows[r, _POINT_AT] = o0 * frame[0, 0] + o1 * frame[1, 0] + o2 * frame[2, 0]
        rows[r, _POINT_AT + 1] = o0 * frame[0, 1] + o1 * frame[1, 1] + o2 * frame[2, 1]
        of_cam = m0 * body_T_cam[0, 3] + m1 * body_T_cam[1, 3] + m2 * body_T_cam[2, 3]
        rows[r, _POINT_AT + 2] = o0 * from_x + o1 * from_y + o2 * from_z - of_cam
        error = at - ray[r]
        for c in range(CAMERA if len(by_lens) else 0):
            error -= by_lens[r, c] * cameras.lenses[j, c]
        rows[r, _ERROR_AT] = scale * error
        if not of_state:
            continue
        rows[r, _POSE_AT] = m1 * body_z - m2 * body_y
        rows[r, _POSE_AT + 1] = m2 * body_x - m0 * body_z
        rows[r, _POSE_AT + 2] = m0 * body_y - m1 * body_x
        rows[r, _POSE_AT + 3], rows[r, _POSE_AT + 4], rows[r, _POSE_AT + 5] = -w * m0, -w * m1, -w * m2
        if len(by_lens):
            for c in range(CAMERA):
                rows[r, c] = -scale * by_lens[r, c]
            rows[r, PLACE] = m1 * left_z - m2 * left_y
            rows[r, PLACE + 1] = m2 * left_x - m0 * left_z
            rows[r, PLACE + 2] = m0 * left_y - m1 * left_x
            rows[r, PLACE + 3], rows[r, PLACE + 4], rows[r, PLACE + 5] = -w * m0, -w * m1, -w * m2
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
    errors2, cost, rows = np.zeros(len(structure.state)), 0.0, np.zeros((2, _COLUMNS))
    u, v = rows[0], rows[1]
    # Lengths 16 and 24 that the compiler does not know: else it writes loops out number by number, without vectors.
    of_one, of_both = 4 * cameras.intrinsics.shape[1], 6 * cameras.intrinsics.shape[1]
    inverse, b, per_scale2 = np.zeros((3, 3)), np.zeros(3), 1.0 / (scale * scale)
    normal = np.zeros((3, 3))
    by_lens = np.zeros((2 if calibrates or _have_moved(cameras) else 0, CAMERA))
    # Sums over all views of a camera from a state, by their columns, and of two cameras.
    of_states = np.zeros((len(poses) * n_cameras, POSE, _OF_STATE))
    of_cameras = np.zeros((n_cameras * n_cameras, SINGLE, _POSE_AT))
    # A landmark's couplings, and these times its inverse normal matrix, for all poses and cameras.
    coupled, weighed, of_camera = np.zeros((3, size)), np.zeros((3, size)), np.zeros((3, _POSE_AT))
    seen, by_camera = np.zeros(n_cameras, dtype=np.bool_), np.zeros((n_cameras, 3, _POSE_AT))
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
            in_front = _view(
                poses[k], cameras, j, structure.odom_T_landmark[point], landmarks[point], structure.rays[n], sigma_px,
                True, by_lens, rows,
            )  # fmt: skip
            e2 = u[_ERROR_AT] * u[_ERROR_AT] + v[_ERROR_AT] * v[_ERROR_AT] if in_front else _ERROR2_BEHIND
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
                pu, pv = u[_POINT_AT + r], v[_POINT_AT + r]
                for c in range(POSE):
                    by_pose[r, c] = pu * u[_POSE_AT + c] + pv * v[_POSE_AT + c]
                    coupled[r, POSE * k + c] += by_pose[r, c]
            sums = of_states[k * n_cameras + j]
            for c in range(POSE):
                cu, cv = u[_POSE_AT + c], v[_POSE_AT + c]
                sums[c, _ERROR_AT] += 0.0 if calibrates else cu * u[_ERROR_AT] + cv * v[_ERROR_AT]
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
                    pu, pv = u[_POINT_AT + r], v[_POINT_AT + r]
                    for c in range(of_one):
                        by_camera[j, r, c] += pu * u[c] + pv * v[c]
            x0, y0, z0, e0 = u[_POINT_AT], u[_POINT_AT + 1], u[_POINT_AT + 2], u[_ERROR_AT]
            x1, y1, z1, e1 = v[_POINT_AT], v[_POINT_AT + 1], v[_POINT_AT + 2], v[_ERROR_AT]
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
                gradient[at + c] += sums[c, _ERROR_AT]
                for d in range(POSE):
                    hessian[at + c, at + d] += sums[c, _POSE_AT + d]
                for d in range(SINGLE if calibrates else 0):
                    hessian[at + c, at_camera + d] += sums[c, d]
    for i in range(n_cameras if calibrates else 0):
        for j in range(i, n_cameras):
            sums, at, other = of_cameras[i * n_cameras + j], n_poses + SINGLE * i, n_poses + SINGLE * j
            for c in range(SINGLE):
                gradient[at + c] += sums[c, _ERROR_AT]
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
                    structure.rays[n], sigma_px, False, by_lens, rows,
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
            largest = 0.0
            for r in range(3):
                step = inverse[r, 0] * bl[0] + inverse[r, 1] * bl[1] + inverse[r, 2] * bl[2]
                moved[point, r] -= step
                largest = max(largest, abs(step))
            if largest < _LOCATED:
                break
    return moved
