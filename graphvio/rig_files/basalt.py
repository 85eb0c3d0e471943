"""Reader of Basalt's ``calibration.json``: cameras with their poses in the IMU's frame, and the IMU.

``T_imu_cam`` is ``body_T_cam``. The IMU's noise values are continuous-time densities. A calibrated reading is
``(I + S) raw - bias``: ``I + S`` is graphvio's matrix of the sensor, and the bias is left out, because graphvio
estimates it. Basalt adds ``cam_time_offset_ns`` to the cameras' stamps, so it has the sign of ``time_offset_s``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from graphvio.arrays import Float
from graphvio.cameras import COEFFICIENTS
from graphvio.errors import RigError
from graphvio.geometry import se3
from graphvio.rig import Camera, Imu, Rig
from graphvio.rig_files.grouping import grouped_rig
from graphvio.rig_files.reading import NOISE_KEYS, Section, named, read_text

FILE_NAME = "calibration.json"
_ROOT = "value0"
_MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "pinhole": ("radial-tangential", ()),
    "kb4": ("equidistant", COEFFICIENTS["equidistant"]),
    "pinhole-radtan8": ("rational", COEFFICIENTS["rational"]),
    "ds": ("double-sphere", COEFFICIENTS["double-sphere"]),
    "eucm": ("extended-unified", COEFFICIENTS["extended-unified"]),
    "ucm": ("extended-unified", ("alpha",)),
}
"""``camera_type`` -> graphvio's name of the lens model, and the names of the coefficients in the file."""
_NOISE = dict(zip(NOISE_KEYS, ("gyro_noise_std", "gyro_bias_std", "accel_noise_std", "accel_bias_std"), strict=True))


def is_calibration(path: Path) -> bool:
    """Return whether a file has the keys of a calibration by Basalt."""
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):
        return False
    return isinstance(values, dict) and isinstance(values.get(_ROOT), dict) and "T_imu_cam" in values[_ROOT]


def load(path: Path) -> Rig:
    """Read a calibration; cameras are grouped into pairs by `grouped_rig`.

    Raises:
        RigError: if the file cannot be read or lacks a value, or does not describe a usable rig.
    """
    try:
        values = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise RigError(f"{path}: line {error.lineno} is not valid JSON ({error.msg}); correct it there") from None
    if not isinstance(values, dict):
        raise RigError(f"{path}: is no calibration of Basalt; it must be a mapping with {_ROOT}")
    document = Section(values, path).section(_ROOT)
    lists = {key: _list(document, key) for key in ("T_imu_cam", "intrinsics", "resolution")}
    lengths = {key: len(each) for key, each in lists.items()}
    if len(set(lengths.values())) > 1:
        raise RigError(
            f"{path}: has {', '.join(f'{n} {key}' for key, n in lengths.items())}; give one of each a camera"
        )
    with named(path):
        cameras = [_camera(document, lists, i) for i in range(lengths["T_imu_cam"])]
        return grouped_rig(cameras, _imu(document), path.stem, path)


def _list(section: Section, key: str) -> list[Any]:
    given = section.get(key)
    if not isinstance(given, list):
        raise RigError(f"{section.where(key)}: must be a list with one entry a camera")
    return given


def _camera(document: Section, lists: dict[str, list[Any]], i: int) -> Camera:
    section = document.nested(lists["intrinsics"][i], f"intrinsics[{i}]")
    camera_type = section.model("camera_type", _MODELS)
    model, names = _MODELS[camera_type]
    values = section.section("intrinsics")
    coefficients = [values.number(name) for name in names]
    if camera_type == "ucm":
        coefficients.append(1.0)  # beta
    sizes = Section({f"resolution[{i}]": lists["resolution"][i]}, document.file, document.key)
    return Camera(
        name=f"cam{i}",
        model=model,
        size_px=sizes.size(f"resolution[{i}]"),
        intrinsics=np.array([values.number(name) for name in ("fx", "fy", "cx", "cy")]),
        distortion=np.array(coefficients),
        body_T_cam=_pose(document.nested(lists["T_imu_cam"][i], f"T_imu_cam[{i}]")),
    )


def _pose(section: Section) -> Float:
    quat_wxyz = np.array([section.number(f"q{axis}") for axis in "wxyz"])
    return se3(section.rotation(quat_wxyz, "qw"), np.array([section.number(f"p{axis}") for axis in "xyz"]))


def _imu(document: Section) -> Imu:
    noise = document.noise("imu_update_rate", {})
    for name, key in _NOISE.items():
        given = document.get(key)
        noise[name] = float(document.array(key, None if isinstance(given, list) else ()).max())  # the noisiest axis
    if document.values.get("calib_gyro_bias") is not None:
        scale = document.array("calib_gyro_bias", (12,))[3:].reshape(3, 3).T  # stored by columns
        noise["gyro_matrix"] = tuple((np.eye(3) + scale).ravel().tolist())
    if document.values.get("calib_accel_bias") is not None:
        scale = np.zeros((3, 3))
        scale.T[np.triu_indices(3)] = document.array("calib_accel_bias", (9,))[3:]  # lower triangle, stored by columns
        noise["accel_matrix"] = tuple((np.eye(3) + scale).ravel().tolist())
    return Imu(**noise, time_offset_s=1e-9 * document.number("cam_time_offset_ns", 0.0))
