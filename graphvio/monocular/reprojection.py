"""Reprojection error of one view of a landmark by a single camera, with derivatives by pose, camera and landmark."""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.cameras import N_ESTIMATED, distort, distortion_basis
from graphvio.geometry import so3_exp, so3_left_jacobian
from graphvio.kernels import kernel
from graphvio.rig import Rig
from graphvio.self_calibration.observation import MIN_DEPTH_RATIO
from graphvio.self_calibration.parameters import CAMERA, INTRINSICS, PLACE, SINGLE

POSE = 6
# Columns of a view's rows: [camera 15, error, pose 6, none 2, landmark 3], so that loops over them have lengths of 16
# and 24, which fill vector registers.
ERROR_AT = SINGLE
POSE_AT = ERROR_AT + 1
OF_STATE = 24
POINT_AT = OF_STATE
COLUMNS = POINT_AT + 3


class Cameras(NamedTuple):
    """Arrays of C cameras for kernels, with their difference from the rig file.

    Attributes:
        body_T_cam: (C, 4, 4) poses of the cameras in body, including the difference.
        focal_px: (C,) pixels per normalised image unit.
        models: (C,) numbers of the camera models.
        intrinsics: (C, 4) ``[fx, fy, cx, cy]`` of the rig file, by which pixels became rays.
        distortion: (C, 8) coefficients of the rig file, likewise.
        lenses: (C, 9) difference of intrinsics and distortion from these.
        turns: (C, 3, 3) derivatives of the cameras' rotation in body with respect to the rotation vector of its
            difference.
    """

    body_T_cam: Float
    focal_px: Float
    models: Int
    intrinsics: Float
    distortion: Float
    lenses: Float
    turns: Float

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
            np.tile(np.eye(3), (len(cameras), 1, 1)),
        )

    def moved(self, difference: Float) -> "Cameras":
        """Return cameras that differ by a vector (C * SINGLE,) from these, which have to be those of the rig file."""
        each, body_T_cam = difference.reshape(-1, SINGLE), self.body_T_cam.copy()
        turns = np.array([so3_left_jacobian(place[:3].copy()) for place in each[:, PLACE:]])
        for pose, place in zip(body_T_cam, each[:, PLACE:], strict=True):
            pose[:3, :3] = so3_exp(place[:3].copy()) @ pose[:3, :3]
            pose[:3, 3] += place[3:]
        return self._replace(body_T_cam=body_T_cam, lenses=self.lenses + each[:, :PLACE], turns=turns)


@kernel
def have_moved(cameras: Cameras) -> bool:
    """Return whether any lens differs from that of the rig file."""
    for j in range(len(cameras.lenses)):
        for c in range(CAMERA):
            if cameras.lenses[j, c] != 0.0:
                return True
    return False


@kernel
def _by_lens(cameras: Cameras, j: int, x: float, y: float, out: Float) -> None:
    """Fill the derivatives (2, 9) of a ray with respect to the lens, for a pixel that stays where it was seen.

    They are evaluated at the predicted ray. At the measured ray they would be correlated with its noise: over tens of
    thousands of views, the focal length would be wrong by six standard deviations.
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
    for c in range(N_ESTIMATED):
        out[0, INTRINSICS + c] = xu * basis[c, 0] + xv * basis[c, 1]
        out[1, INTRINSICS + c] = yu * basis[c, 0] + yv * basis[c, 1]


@kernel
def whiten_view(
    pose: Float, fall: Float, cameras: Cameras, j: int, frame: Float, landmark: Float, ray: Float, readout: Float,
    sigma_px: float, of_state: bool, by_lens: Float, rows: Float,
) -> bool:  # fmt: skip
    """Fill the rows (2, COLUMNS) of one view: derivatives with respect to pose, camera and landmark, whitened error.

    Coordinates are scalar variables throughout, since arrays would be allocated for each view. For a line of a rolling
    shutter, derivatives of the camera's motion between the stamp and the line's exposure are neglected: over 10 ms, an
    error of 5 cm/s is half a millimetre.

    Args:
        pose: (4, 4) ``odom_T_body``.
        fall: (2, 3) motion of body in free fall, see `graphvio.monocular.states.States.falls`.
        cameras: cameras of the rig.
        j: index of the camera.
        frame: (4, 4) frame of the landmark in odom.
        landmark: (3,) the landmark ``[a, b, w]`` in its frame.
        ray: (2,) measured normalised coordinates, by the lens of the rig file.
        readout: (4,) when and from where it was seen, see `graphvio.measurements.motion.CameraTracks`.
        sigma_px: noise of a corner's position.
        of_state: whether derivatives with respect to pose and camera are wanted, too.
        by_lens: (2, 9) for intermediate results; (0, 9) where the lens is that of the rig file, and no derivatives with
            respect to the camera are wanted.
        rows: (2, COLUMNS) output.

    Returns:
        Whether the landmark is in front of the camera.
    """
    a, b, w, body_T_cam = landmark[0], landmark[1], landmark[2], cameras.body_T_cam[j]
    turns = cameras.turns[j]
    scale = cameras.focal_px[j] / sigma_px
    from_x, from_y, from_z = frame[0, 3] - pose[0, 3], frame[1, 3] - pose[1, 3], frame[2, 3] - pose[2, 3]
    odom_x = frame[0, 0] * a + frame[0, 1] * b + frame[0, 2] + w * from_x
    odom_y = frame[1, 0] * a + frame[1, 1] * b + frame[1, 2] + w * from_y
    odom_z = frame[2, 0] * a + frame[2, 1] * b + frame[2, 2] + w * from_z
    body_x = pose[0, 0] * odom_x + pose[1, 0] * odom_y + pose[2, 0] * odom_z
    body_y = pose[0, 1] * odom_x + pose[1, 1] * odom_y + pose[2, 1] * odom_z
    body_z = pose[0, 2] * odom_x + pose[1, 2] * odom_y + pose[2, 2] * odom_z
    centre_x, centre_y, centre_z = body_T_cam[0, 3], body_T_cam[1, 3], body_T_cam[2, 3]
    t = readout[0]
    if t != 0.0:
        centre_x += readout[1] + t * (fall[0, 0] + t * fall[1, 0])
        centre_y += readout[2] + t * (fall[0, 1] + t * fall[1, 1])
        centre_z += readout[3] + t * (fall[0, 2] + t * fall[1, 2])
    left_x, left_y, left_z = body_x - w * centre_x, body_y - w * centre_y, body_z - w * centre_z
    cam_x = body_T_cam[0, 0] * left_x + body_T_cam[1, 0] * left_y + body_T_cam[2, 0] * left_z
    cam_y = body_T_cam[0, 1] * left_x + body_T_cam[1, 1] * left_y + body_T_cam[2, 1] * left_z
    cam_z = body_T_cam[0, 2] * left_x + body_T_cam[1, 2] * left_y + body_T_cam[2, 2] * left_z
    if not cam_z > MIN_DEPTH_RATIO:
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
        rows[r, POINT_AT] = o0 * frame[0, 0] + o1 * frame[1, 0] + o2 * frame[2, 0]
        rows[r, POINT_AT + 1] = o0 * frame[0, 1] + o1 * frame[1, 1] + o2 * frame[2, 1]
        of_cam = m0 * centre_x + m1 * centre_y + m2 * centre_z
        rows[r, POINT_AT + 2] = o0 * from_x + o1 * from_y + o2 * from_z - of_cam
        error = at - ray[r]
        for c in range(CAMERA if len(by_lens) else 0):
            error -= by_lens[r, c] * cameras.lenses[j, c]
        rows[r, ERROR_AT] = scale * error
        if not of_state:
            continue
        rows[r, POSE_AT] = m1 * body_z - m2 * body_y
        rows[r, POSE_AT + 1] = m2 * body_x - m0 * body_z
        rows[r, POSE_AT + 2] = m0 * body_y - m1 * body_x
        rows[r, POSE_AT + 3], rows[r, POSE_AT + 4], rows[r, POSE_AT + 5] = -w * m0, -w * m1, -w * m2
        if len(by_lens):
            for c in range(CAMERA):
                rows[r, c] = -scale * by_lens[r, c]
            turn_x, turn_y, turn_z = m1 * left_z - m2 * left_y, m2 * left_x - m0 * left_z, m0 * left_y - m1 * left_x
            for c in range(3):
                rows[r, PLACE + c] = turn_x * turns[0, c] + turn_y * turns[1, c] + turn_z * turns[2, c]
            rows[r, PLACE + 3], rows[r, PLACE + 4], rows[r, PLACE + 5] = -w * m0, -w * m1, -w * m2
    return True
