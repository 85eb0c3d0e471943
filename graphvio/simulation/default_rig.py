"""Default rig of the simulator: the paper's four cameras, back to back in two stereo pairs.

Frame body is the IMU's: x forward, y left, z up. T_12 and the roll, pitch and yaw of R_12 are the paper's (section 5);
the angles are about the usual vehicle axes forward, right, down.
"""

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3, se3_inverse, so3_exp
from graphvio.rig import Camera, Imu, Rig, StereoPair

_SIZE_PX = (640, 480)
_BASELINE_M = 0.12
_FRONT_TILT_DEG = 14.0
_T_12 = np.array([0.3345, 0.0667, -0.1138])
_ROLL_PITCH_YAW_12_DEG = (-0.9267, -30.2715, -179.6150)

# Columns: the vehicle axes forward, right, down in frame cam (x right, y down, z forward).
_CAM_R_VEHICLE = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])

_INTRINSICS = np.array(
    [
        [394.2, 393.8, 321.6, 238.1],
        [395.1, 394.9, 317.3, 241.7],
        [393.4, 393.1, 322.9, 240.6],
        [394.8, 394.3, 318.5, 237.4],
    ]
)
_DISTORTION = np.array(
    [
        [-0.091, 0.021, 0.00031, -0.00018, 0.0],
        [-0.088, 0.019, -0.00022, 0.00027, 0.0],
        [-0.093, 0.023, 0.00012, 0.00024, 0.0],
        [-0.090, 0.020, -0.00029, -0.00011, 0.0],
    ]
)
# Rotation vectors of the right cameras, degrees: the cameras of a real pair are not perfectly parallel.
_RIGHT_MISALIGNMENT_DEG = np.array([[0.31, -0.42, 0.18], [-0.27, 0.36, -0.22]])


def rotation_zyx(yaw: float, pitch: float, roll: float) -> Float:
    """Return ``Rz(yaw) Ry(pitch) Rx(roll)`` (3, 3); angles in radians."""
    x, y, z = np.eye(3)
    return np.asarray(so3_exp(yaw * z) @ so3_exp(pitch * y) @ so3_exp(roll * x))


def paper_left2_T_left1() -> Float:
    """Return ``P_12`` (4, 4) of the paper's eq. (1), from the front left camera to the back left camera."""
    roll, pitch, yaw = np.deg2rad(_ROLL_PITCH_YAW_12_DEG)
    rotation = _CAM_R_VEHICLE @ rotation_zyx(yaw, pitch, roll) @ _CAM_R_VEHICLE.T
    return se3(np.ascontiguousarray(rotation), _T_12)


def default_rig() -> Rig:
    """Return the rig of pairs ``front`` (cam0, cam1) and ``back`` (cam2, cam3), 78 degrees wide, baselines of 12 cm."""
    tilt = np.deg2rad(_FRONT_TILT_DEG)
    forward = np.array([np.cos(tilt), 0.0, -np.sin(tilt)])
    right = np.array([0.0, -1.0, 0.0])
    body_R_left1 = np.column_stack([right, np.cross(forward, right), forward])
    body_T_left1 = se3(np.ascontiguousarray(body_R_left1), np.array([0.071, 0.164, 0.058]))
    body_T_left2 = body_T_left1 @ se3_inverse(paper_left2_T_left1())
    pairs = []
    for index, (name, body_T_left) in enumerate((("front", body_T_left1), ("back", body_T_left2))):
        misalignment = so3_exp(np.deg2rad(_RIGHT_MISALIGNMENT_DEG[index]))
        body_T_right = body_T_left @ se3(misalignment, np.array([_BASELINE_M, 0.0011, -0.0007]))
        pairs.append(StereoPair(name, _camera(2 * index, body_T_left), _camera(2 * index + 1, body_T_right)))
    return Rig(tuple(pairs), Imu(), name="simulated")


def _camera(number: int, body_T_cam: Float) -> Camera:
    return Camera(
        name=f"cam{number}",
        model="radial-tangential",
        size_px=_SIZE_PX,
        intrinsics=_INTRINSICS[number],
        distortion=_DISTORTION[number],
        body_T_cam=body_T_cam,
    )
