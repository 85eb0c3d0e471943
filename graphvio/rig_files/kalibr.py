"""Reader of Kalibr's ``camchain-imucam.yaml`` with the ``imu.yaml`` next to it, or a camera-only ``camchain.yaml``.

Kalibr's ``T_cam_imu`` maps points from the IMU's frame to the camera's, so ``body_T_cam`` is its inverse;
``timeshift_cam_imu`` has graphvio's sign, ``t_imu = t_cam + timeshift``. ``intrinsics`` are ``[fu, fv, pu, pv]``,
preceded by ``[xi, alpha]`` for the camera model ``ds``, ``[alpha, beta]`` for ``eucm`` and ``[xi]`` for ``omni``.
OpenVINS has the same files with ``T_imu_cam``, which is ``body_T_cam``, and other names for the IMU's matrices.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.cameras import COEFFICIENTS
from graphvio.errors import RigError
from graphvio.geometry import se3_inverse
from graphvio.rig import Camera, Imu, Rig, checked_transform
from graphvio.rig_files.grouping import grouped_rig
from graphvio.rig_files.reading import NOISE_KEYS, Section, named, read_yaml
from graphvio.rig_files.time_shifts import with_time_shifts
from graphvio.wording import listed

PINHOLE = "pinhole"
SPHERES = {"ds": "double-sphere", "eucm": "extended-unified", "omni": "omnidirectional"}
"""Camera model in files of Kalibr -> graphvio's name; the parameters of the sphere come first in ``intrinsics``."""
_MODELS = {
    "radtan": "radial-tangential",
    "radial-tangential": "radial-tangential",
    "plumb_bob": "radial-tangential",
    "none": "radial-tangential",
    "equidistant": "equidistant",
    "equi": "equidistant",
    "rational": "rational",
    "rational_polynomial": "rational",
}
"""Distortion model in files of Kalibr, EuRoC and ROS -> graphvio's name."""
IMU_KEYS = {
    "gyro_noise_density": "gyroscope_noise_density",
    "gyro_random_walk": "gyroscope_random_walk",
    "accel_noise_density": "accelerometer_noise_density",
    "accel_random_walk": "accelerometer_random_walk",
}
"""graphvio's name of a noise density -> Kalibr's and EuRoC's key."""
LINE_DELAY_KEY = "line_delay"
"""Seconds from one line of a rolling shutter to the next."""
_TIME_SHIFT_KEY = "timeshift_cam_imu"
_PLACE_KEYS = ("T_cam_imu", "T_imu_cam")
"""Keys of a camera's extrinsics: Kalibr's, and OpenVINS's, which is the inverse."""
_MIN_DETERMINANT = 1e-3


def load(path: Path) -> Rig:
    """Read a camera chain, and the IMU's file from the same folder if the chain has extrinsics to an IMU.

    Cameras are grouped into pairs by `grouped_rig`. Without ``T_cam_imu`` or OpenVINS's ``T_imu_cam`` the rig has no
    IMU, and body is cam0.

    Raises:
        RigError: if a file cannot be read or lacks a value, or the files do not describe a usable rig.
    """
    document = read_yaml(path)
    names = camera_names(document)
    has_imu = bool(names) and any(key in document.section(names[0]).values for key in _PLACE_KEYS)
    with named(path):
        cameras = cameras_of(document)
        imu = imu_of(find_imu_file(path)) if has_imu else None
        rig = grouped_rig(cameras, imu, path.stem, path)
        return with_time_shifts(rig, time_shifts_of(document), path)


def camera_names(document: Section) -> list[str]:
    """List the names of a chain's cameras, ``cam0``, ``cam1`` ..., in the order of their numbers."""
    names = [key for key in document.values if re.fullmatch(r"cam\d+", str(key))]
    return sorted(names, key=lambda name: int(name[3:]))


def cameras_of(document: Section) -> list[Camera]:
    """Read all cameras of a chain."""
    cameras: list[Camera] = []
    previous_T_body = np.eye(4)
    for index, name in enumerate(camera_names(document)):
        section = document.section(name)
        cam_T_body = _cam_T_body(section, previous_T_body, first=index == 0)
        lens = lens_of(section, "distortion_coeffs")
        cameras.append(
            Camera(
                name=name,
                model=lens.model,
                size_px=section.size("resolution"),
                intrinsics=lens.intrinsics,
                distortion=lens.distortion,
                body_T_cam=se3_inverse(cam_T_body),
                line_time_us=line_time_us_of(section),
            )
        )
        previous_T_body = cam_T_body
    return cameras


def line_time_us_of(section: Section) -> float:
    """Read the line time of a rolling shutter, microseconds, from ``line_delay`` (seconds); 0 where it is missing."""
    return 1e6 * section.number(LINE_DELAY_KEY, 0.0)


def imu_of(path: Path) -> Imu:
    """Read the IMU from Kalibr's ``imu.yaml``, flat or under ``imu0``; the file has no time offset.

    Raises:
        RigError: if a noise value is missing, or body is not the IMU's frame.
    """
    section = read_yaml(path)
    if isinstance(section.values.get("imu0"), dict):
        section = section.section("imu0")
    if section.values.get("T_i_b") is not None and np.abs(section.matrix("T_i_b") - np.eye(4)).max() > 1e-9:
        raise RigError(f"{section.where('T_i_b')}: is not the identity; calibrate with this IMU as the only one")
    with named(path):
        noise = section.noise("update_rate", IMU_KEYS)
        return Imu(**noise, **_imu_matrices(section))


def _imu_matrices(section: Section) -> dict[str, Any]:
    """Read scale and misalignment from the keys of Kalibr's model ``scale-misalignment`` or of OpenVINS.

    Both model a reading as ``M R value + bias``, where ``R`` rotates from the IMU's frame to the sensor's; graphvio
    multiplies the reading by the inverse of ``M R``. The effect of accelerations on the gyro (``A``, ``Tg``) is left
    out.
    """
    if section.values.get("gyroscopes") is not None:
        gyro, accel = section.section("gyroscopes"), section.section("accelerometers")
        matrices = {"gyro_matrix": [(gyro, "M"), (gyro, "C_gyro_i")], "accel_matrix": [(accel, "M")]}
    else:
        matrices = {
            "gyro_matrix": [(section, "Tw"), (section, "R_IMUtoGYRO")],
            "accel_matrix": [(section, "Ta"), (section, "R_IMUtoACC")],
        }
    found = {}
    for name, factors in matrices.items():
        product = np.eye(3)
        for part, key in factors:
            if part.values.get(key) is not None:
                product = product @ part.array(key, (3, 3))
        if not np.abs(np.linalg.det(product)) > _MIN_DETERMINANT:
            where = " and ".join(part.where(key) for part, key in factors)
            raise RigError(f"{where}: cannot be inverted; write matrices that are nearly the identity")
        found[name] = tuple(np.linalg.inv(product).ravel().tolist())
    return found


def time_shifts_of(document: Section) -> dict[str, float | None]:
    """Read ``timeshift_cam_imu`` of all cameras, seconds, by the camera's name; None where it is missing."""
    sections = {name: document.section(name) for name in camera_names(document)}
    is_given = {name: section.values.get(_TIME_SHIFT_KEY) is not None for name, section in sections.items()}
    return {name: each.number(_TIME_SHIFT_KEY) if is_given[name] else None for name, each in sections.items()}


def find_imu_file(camchain: Path) -> Path:
    """Find the IMU's file next to a camera chain.

    Raises:
        RigError: if there is none, or there are several candidates.
    """
    stem = camchain.name
    likely = [stem.replace(*names) for names in (("camchain-imucam", "imu"), ("camchain", "imu"), ("imucam", "imu"))]
    for name in [*likely, "imu.yaml", "imu_config.yaml", "imu0.yaml"]:
        file = camchain.parent / name
        if name != stem and file.is_file() and not camera_names(read_yaml(file)):
            return file
    named_so = sorted(camchain.parent.glob("*imu*.y*ml"))  # camera chains and their copies may match, too
    others = [file for file in named_so if file != camchain and not camera_names(read_yaml(file))]
    if len(others) == 1:
        return others[0]
    defaults = ", ".join(f"{IMU_KEYS[name]}: {getattr(Imu(), name)}" for name in NOISE_KEYS)
    found = f"more than one IMU file ({listed(p.name for p in others)})" if others else "no imu.yaml"
    raise RigError(
        f"{camchain}: has an IMU, and {found} next to it; write one with the IMU's noise, such as  "
        f"{defaults}, update_rate: {Imu().rate_hz}"
    )


class Lens(NamedTuple):
    """Lens model, intrinsics and distortion as `graphvio.rig.Camera` takes them."""

    model: str  # graphvio's name
    intrinsics: Float  # (4,), pixels
    distortion: Float


class WrittenLens(NamedTuple):
    """Lens models and values as Kalibr's files have them."""

    camera_model: str
    intrinsics: list[float]
    distortion_model: str
    coefficients: list[float]


def lens_of(section: Section, coefficients_key: str) -> Lens:
    """Read a camera's lens.

    Args:
        section: the camera's section.
        coefficients_key: key of the distortion coefficients.

    Raises:
        RigError: if its model is missing or not supported, or a value is missing.
    """
    camera_model = section.text("camera_model") if section.values.get("camera_model") is not None else PINHOLE
    if camera_model != PINHOLE and camera_model not in SPHERES:
        raise RigError(
            f"{section.where('camera_model')}: is {camera_model!r}; calibrate with pinhole and the distortion model "
            f"radial-tangential (radtan) or equidistant (equi), or with one of {', '.join(SPHERES)}"
        )
    if camera_model == PINHOLE or section.values.get("distortion_model") is not None:
        name = section.model("distortion_model", _MODELS)
    else:
        name = "none"
    coefficients = np.zeros(0) if name == "none" else section.array(coefficients_key)
    if camera_model == PINHOLE:
        return Lens(_MODELS[name], section.array("intrinsics", (4,)), coefficients)
    model = SPHERES[camera_model]
    if name != "none" and (model != "omnidirectional" or _MODELS[name] != "radial-tangential"):
        wanted = "radtan or none" if model == "omnidirectional" else "none"
        raise RigError(
            f"{section.where('distortion_model')}: is {name!r}; with camera_model {camera_model} it must be {wanted}"
        )
    n_sphere = _n_sphere(model)
    intrinsics = section.array("intrinsics", (n_sphere + 4,))
    return Lens(model, intrinsics[n_sphere:], np.concatenate([intrinsics[:n_sphere], coefficients]))


def written_lens(camera: Camera) -> WrittenLens:
    """Return a camera's lens as `lens_of` reads it; coefficients after the fourth are left out if all are zero."""
    names, values = COEFFICIENTS[camera.model], camera.distortion.tolist()
    pinhole = camera.intrinsics.tolist()
    if camera.model not in SPHERES.values():
        n = 4 if not any(values[4:]) else len(names)
        return WrittenLens(PINHOLE, pinhole, camera.model, values[:n])
    camera_model = next(key for key, model in SPHERES.items() if model == camera.model)
    n_sphere = _n_sphere(camera.model)
    coefficients = values[n_sphere : len(names)]
    distortion_model = "radial-tangential" if coefficients else "none"
    return WrittenLens(camera_model, [*values[:n_sphere], *pinhole], distortion_model, coefficients)


def _n_sphere(model: str) -> int:
    """Return how many coefficients of a sphere model come first in Kalibr's ``intrinsics``."""
    return len([name for name in COEFFICIENTS[model] if name in ("xi", "alpha", "beta")])


def _cam_T_body(section: Section, previous_T_body: Float, first: bool) -> Float:
    if section.values.get("T_cam_imu") is not None:
        return checked_transform(section.matrix("T_cam_imu"), section.where("T_cam_imu"))
    if section.values.get("T_imu_cam") is not None:
        return se3_inverse(checked_transform(section.matrix("T_imu_cam"), section.where("T_imu_cam")))
    if first:
        return np.eye(4)
    return checked_transform(section.matrix("T_cn_cnm1"), section.where("T_cn_cnm1")) @ previous_T_body
