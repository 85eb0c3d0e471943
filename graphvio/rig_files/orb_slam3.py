"""Reader of ORB-SLAM3's settings of version 1.0: one or two cameras, and the IMU.

``Stereo.T_c1_c2`` maps points from the second camera's frame to the first camera's, and ``IMU.T_b_c1`` from the first
camera's frame to the IMU's, which is body; without an IMU body is the first camera. Noise values are densities.
"""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError
from graphvio.geometry import se3
from graphvio.rig import Camera, Imu, Rig, checked_transform
from graphvio.rig_files.grouping import grouped_rig
from graphvio.rig_files.reading import NOISE_KEYS, Section, named

_TYPE_KEY = "Camera.type"
_IMU_KEY, _STEREO_KEY, _BASELINE_KEY = "IMU.T_b_c1", "Stereo.T_c1_c2", "Stereo.b"
_RECTIFIED = "Rectified"
_LENSES = {
    "PinHole": ("radial-tangential", ("k1", "k2", "p1", "p2", "k3")),
    "KannalaBrandt8": ("equidistant", ("k1", "k2", "k3", "k4")),
    _RECTIFIED: ("radial-tangential", ()),
}
"""``Camera.type`` -> graphvio's name of the lens model, and the keys of its coefficients."""
_NOISE = dict(zip(NOISE_KEYS, ("NoiseGyro", "GyroWalk", "NoiseAcc", "AccWalk"), strict=True))


def is_settings(document: Section) -> bool:
    """Return whether a YAML document has settings of ORB-SLAM3, of any version."""
    return _TYPE_KEY in document.values


def load(document: Section) -> Rig:
    """Read a rig of one or two cameras from settings.

    Raises:
        RigError: if a value is missing, the settings are of another version, or do not describe a usable rig.
    """
    path, values = document.file, document.values
    if "Camera1.fx" not in values:
        raise RigError(f"{document.where('Camera1.fx')} is missing; settings of ORB-SLAM3 have to be of version 1.0")
    has_imu = _IMU_KEY in values
    body_T_c1 = checked_transform(document.matrix(_IMU_KEY), document.where(_IMU_KEY)) if has_imu else np.eye(4)
    with named(path):
        cameras = [_camera(document, 1, body_T_c1)]
        if _STEREO_KEY in values or _BASELINE_KEY in values:
            cameras.append(_camera(document, 2, body_T_c1 @ _c1_T_c2(document)))
        return grouped_rig(cameras, _imu(document) if has_imu else None, path.stem, path)


def _camera(document: Section, number: int, body_T_cam: Float) -> Camera:
    camera_type = document.text(_TYPE_KEY)
    if camera_type not in _LENSES:
        raise RigError(f"{document.where(_TYPE_KEY)}: unknown type {camera_type!r}; use one of {', '.join(_LENSES)}")
    model, coefficients = _LENSES[camera_type]
    prefix = "Camera1" if camera_type == _RECTIFIED else f"Camera{number}"
    is_fisheye = model == "equidistant"  # its coefficients are required; those of other models are 0 if missing
    return Camera(
        name=f"cam{number - 1}",
        model=model,
        size_px=(int(document.number("Camera.width")), int(document.number("Camera.height"))),
        intrinsics=np.array([document.number(f"{prefix}.{key}") for key in ("fx", "fy", "cx", "cy")]),
        distortion=np.array([document.number(f"{prefix}.{key}", None if is_fisheye else 0.0) for key in coefficients]),
        body_T_cam=body_T_cam,
    )


def _c1_T_c2(document: Section) -> Float:
    if _STEREO_KEY in document.values:
        return checked_transform(document.matrix(_STEREO_KEY), document.where(_STEREO_KEY))
    return se3(np.eye(3), np.array([document.number(_BASELINE_KEY), 0.0, 0.0]))


def _imu(document: Section) -> Imu:
    return Imu(**document.noise("IMU.Frequency", {name: f"IMU.{key}" for name, key in _NOISE.items()}))
