"""The factory's calibration of a RealSense camera as a rig."""

from __future__ import annotations

from typing import Any

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError
from graphvio.geometry import se3, se3_inverse
from graphvio.rig import Camera, Imu, Rig, StereoPair

# The data sheets of the IMUs of D435i, D455 and others (BMI055, BMI085): 0.014 deg/s/sqrt(Hz), 150 ug/sqrt(Hz).
_GYRO_NOISE = 2.4e-4
_ACCEL_NOISE = 1.5e-3


def factory_rig(left: Any, right: Any, gyro: Any | None, imu_rate_hz: float, name: str) -> Rig:
    """A rig of one pair, cameras ``cam0`` and ``cam1``.

    Args:
        left: `pyrealsense2.stream_profile` of infrared 1.
        right: that of infrared 2.
        gyro: that of the gyro, whose frame is body; None if there is no IMU, and body is the left camera.
        imu_rate_hz: of the gyro.
        name: of the rig.

    Raises:
        RigError: if a lens is of a model that graphvio does not have, or the calibration is incomplete.
    """
    body_T_left = np.eye(4) if gyro is None else transform(left, gyro, name)
    body_T_right = body_T_left @ se3_inverse(transform(left, right, name))
    imu = Imu(imu_rate_hz, gyro_noise_density=_GYRO_NOISE, accel_noise_density=_ACCEL_NOISE) if gyro else None
    pair = StereoPair("pair0", _camera("cam0", left, body_T_left, name), _camera("cam1", right, body_T_right, name))
    return Rig((pair,), imu, name)


def transform(a: Any, b: Any, where: str) -> Float:
    """``b_T_a`` (4, 4) between the frames of two stream profiles.

    Raises:
        RigError: if the factory did not tell it.
    """
    try:
        extrinsics = a.get_extrinsics_to(b)
    except RuntimeError as error:
        raise RigError(f"{where}: the factory's calibration is incomplete ({error}); give a rig file (--rig)") from None
    rotation = np.array(extrinsics.rotation, dtype=np.float64).reshape(3, 3, order="F")  # columns one after the other
    return np.asarray(se3(np.ascontiguousarray(rotation), np.array(extrinsics.translation, dtype=np.float64)))


def _camera(name: str, profile: Any, body_T_cam: Float, where: str) -> Camera:
    lens = profile.as_video_stream_profile().get_intrinsics()
    model, distortion = _lens(lens, f"{where}: {name}")
    intrinsics = np.array([lens.fx, lens.fy, lens.ppx, lens.ppy])
    return Camera(name, model, (lens.width, lens.height), intrinsics, distortion, body_T_cam)


def _lens(lens: Any, where: str) -> tuple[str, Float]:
    kind = lens.model.name
    coefficients = np.array(lens.coeffs, dtype=np.float64)
    if kind == "kannala_brandt4":
        return "equidistant", coefficients[:4]
    # Infrared images of the D400 series are rectified by the camera: a model is named, but its coefficients are zero.
    if kind in ("brown_conrady", "none") or not coefficients.any():
        return "radial-tangential", coefficients
    raise RigError(
        f"{where}: its lens is of model {kind}, which graphvio has not; calibrate it with Kalibr, and give the rig file"
    )
