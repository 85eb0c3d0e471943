"""The calibrated rig: stereo pairs, single cameras and an IMU, rigidly mounted.

All extrinsics are ``body_T_cam``. Body is the IMU's frame; a rig without an IMU may choose any. The objects are
immutable and validate their values on construction.
"""

from graphvio.rig.camera import Camera, as_written, axes_angle_deg, overlap
from graphvio.rig.groups import MAX_AXES_ANGLE_DEG, MIN_BASELINE_M, CameraGroup, SingleCamera, StereoPair
from graphvio.rig.imu import Imu
from graphvio.rig.rig import Rig, checked_views
from graphvio.rig.values import checked_transform

__all__ = [
    "MAX_AXES_ANGLE_DEG",
    "MIN_BASELINE_M",
    "Camera",
    "CameraGroup",
    "Imu",
    "Rig",
    "SingleCamera",
    "StereoPair",
    "as_written",
    "axes_angle_deg",
    "checked_transform",
    "checked_views",
    "overlap",
]
