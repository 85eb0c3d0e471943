"""The factory's calibration of an OAK camera, in its EEPROM, as a rig."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError
from graphvio.geometry import se3_inverse
from graphvio.live.lens_fit import FittedLens, fit_rational
from graphvio.rig import Camera, Imu, Rig, StereoPair

_CM = 0.01


def fitted_lens(calibration: Any, socket: Any, size_px: tuple[int, int], where: str) -> FittedLens:
    """The lens of a camera, for images of this size.

    Args:
        calibration: `depthai.CalibrationHandler`.
        socket: `depthai.CameraBoardSocket`.
        size_px: (width, height); images of another shape than the sensor's are cut, as the camera does by itself.
        where: for messages.

    Raises:
        RigError: if it is not calibrated, or of a model that graphvio cannot come near.
    """
    width, height = size_px
    matrix = _read(lambda: calibration.getCameraIntrinsics(socket, width, height), where)
    coefficients = _read(lambda: calibration.getDistortionCoefficients(socket), where).ravel()
    kind = calibration.getDistortionModel(socket).name
    intrinsics = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    if kind == "Perspective":
        return fit_rational(intrinsics, coefficients, size_px, where)
    if kind == "Fisheye":
        return FittedLens("equidistant", intrinsics, np.pad(coefficients[:4], (0, 1)))
    raise RigError(f"{where}: its lens is of model {kind}, which graphvio has not; give a rig file (--rig)")


def factory_rig(
    calibration: Any,
    sockets: tuple[Any, Any],
    lenses: tuple[FittedLens, FittedLens],
    size_px: tuple[int, int],
    imu_rate_hz: float | None,
    is_guessed: bool,
    name: str,
) -> Rig:
    """A rig of one pair, cameras ``cam0`` and ``cam1``.

    Args:
        calibration: `depthai.CalibrationHandler`.
        sockets: of the left and the right camera.
        lenses: theirs.
        size_px: (width, height) of both.
        imu_rate_hz: of the IMU, whose frame is body; None for no IMU, and body is the left camera.
        is_guessed: whether an IMU that nobody calibrated may be taken to lie as the left camera does.
        name: of the rig.

    Raises:
        RigError: if the calibration is incomplete.
    """
    left, right = sockets
    right_T_left = _transform(lambda: calibration.getCameraExtrinsics(left, right), name)
    body_T_left = np.eye(4)
    if imu_rate_hz is not None:
        try:
            body_T_left = se3_inverse(_transform(lambda: calibration.getImuToCameraExtrinsics(left), name))
        except RigError as error:
            if not is_guessed:
                raise RigError(
                    f"{name}: the factory does not tell where the IMU is, as with most OAK cameras ({error}); give a "
                    "rig file (--rig), or imu=none. To make one, record a walk with places=guess, then: graphvio "
                    "calibrate RECORDING --correct-imu --out rig.yaml"
                ) from None
    body_T_right = body_T_left @ se3_inverse(right_T_left)
    cameras = [
        Camera(f"cam{k}", lens.model, size_px, lens.intrinsics, lens.distortion, body_T_cam)
        for k, (lens, body_T_cam) in enumerate(zip(lenses, (body_T_left, body_T_right), strict=True))
    ]
    imu = None if imu_rate_hz is None else Imu(imu_rate_hz)
    return Rig((StereoPair("pair0", cameras[0], cameras[1]),), imu, name)


def _transform(read: Callable[[], Any], where: str) -> Float:
    """A transform (4, 4) in metres from one in centimetres."""
    transform = _read(read, where)
    transform[:3, 3] *= _CM
    if not np.abs(transform[:3, :3]).max() > 0.0:  # an EEPROM that was never written
        raise RigError(f"{where}: the factory's calibration is empty")
    return transform


def _read(read: Callable[[], Any], where: str) -> Float:
    try:
        return np.array(read(), dtype=np.float64)
    except (RuntimeError, IndexError) as error:  # depthai looks cameras up without asking whether they are there
        raise RigError(f"{where}: the factory's calibration is incomplete ({error}); give a rig file (--rig)") from None
