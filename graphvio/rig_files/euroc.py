"""Reader of an EuRoC/ASL folder's calibration: ``cam0/sensor.yaml``, ``cam1/sensor.yaml`` ..., ``imu0/sensor.yaml``.

``T_BS`` is the pose of the sensor in the file's body frame. If the IMU's ``T_BS`` is not the identity, all extrinsics
are transformed to the IMU's frame, which is graphvio's body. TUM-VI exports have the same folders but may have the
calibration in ``dso/camchain.yaml`` and ``dso/imu_config.yaml`` next to ``mav0``.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError
from graphvio.geometry import se3_inverse
from graphvio.rig import Camera, Imu, Rig, checked_transform
from graphvio.rig_files import kalibr
from graphvio.rig_files.grouping import grouped_rig
from graphvio.rig_files.reading import Section, named, read_yaml
from graphvio.rig_files.time_shifts import with_time_shifts

_CHAIN = Path("dso/camchain.yaml")
"""TUM-VI's calibration, next to ``mav0``."""
_CAMERA_KEYS = ("T_BS", "resolution", "intrinsics", "distortion_model", "distortion_coefficients")


def load(path: Path) -> Rig:
    """Read the calibration of a recording.

    Cameras are grouped into pairs by `grouped_rig`. Without a folder ``imu0`` the rig has no IMU.

    Args:
        path: ``mav0``, or the folder that contains it.

    Raises:
        RigError: if a file or value is missing, or they do not describe a usable rig.
    """
    root = sensors_folder(path)
    if root is None:
        raise RigError(f"{path}: holds no cam0, cam1, ...; give the folder mav0 of an EuRoC/ASL recording")
    folders = camera_folders(root)
    sections = {folder.name: _sensor(folder) for folder in folders}
    imu_folder = root / "imu0"
    chain = root.parent / _CHAIN
    if chain.is_file() and any(not _is_complete(section) for section in sections.values()):
        return _from_chain(chain, [folder.name for folder in folders], has_imu=imu_folder.is_dir(), name=_name(root))
    imu_T_body = np.eye(4)
    imu = None
    if imu_folder.is_dir():
        section = _sensor(imu_folder)
        with named(section.file):
            imu = Imu(**section.noise("rate_hz", kalibr.IMU_KEYS))
            if section.values.get("T_BS") is not None:
                body_T_imu = checked_transform(section.matrix("T_BS"), section.where("T_BS"))
                imu_T_body = se3_inverse(body_T_imu)
    cameras = [_camera(name, section, imu_T_body) for name, section in sections.items()]
    with named(root):
        return grouped_rig(cameras, imu, _name(root), root)


def sensors_folder(path: Path) -> Path | None:
    """Find the folder with ``cam0``: ``path`` or its ``mav0``; None if neither is."""
    for folder in (path / "mav0", path):
        if camera_folders(folder):
            return folder
    return None


def has_calibration(sensors: Path) -> bool:
    """Return whether a folder of sensors holds a calibration: any ``sensor.yaml``, or TUM-VI's chain next to it."""
    return any(sensors.glob("*/sensor.yaml")) or (sensors.parent / _CHAIN).is_file()


def camera_folders(root: Path) -> list[Path]:
    """List the folders ``cam0``, ``cam1`` ... in the order of their numbers."""
    if not root.is_dir():
        return []
    folders = [p for p in root.iterdir() if re.fullmatch(r"cam\d+", p.name) and p.is_dir()]
    return sorted(folders, key=lambda p: int(p.name[3:]))


def _camera(name: str, section: Section, imu_T_body: Float) -> Camera:
    lens = kalibr.lens_of(section, "distortion_coefficients")
    with named(section.file):
        body_T_cam = checked_transform(section.matrix("T_BS"), section.where("T_BS"))
        return Camera(
            name=name,
            model=lens.model,
            size_px=section.size("resolution"),
            intrinsics=lens.intrinsics,
            distortion=lens.distortion,
            body_T_cam=imu_T_body @ body_T_cam,
            line_time_us=kalibr.line_time_us_of(section),
        )


def _from_chain(chain: Path, names: list[str], has_imu: bool, name: str) -> Rig:
    document = read_yaml(chain)
    with named(chain):
        cameras = {camera.name: camera for camera in kalibr.cameras_of(document)}
        for camera in names:
            if camera not in cameras:
                raise RigError(f"{camera} is missing; the recording has it: add its calibration")
        imu = kalibr.imu_of(kalibr.find_imu_file(chain)) if has_imu else None
        rig = grouped_rig([cameras[camera] for camera in names], imu, name, chain)
        return with_time_shifts(rig, kalibr.time_shifts_of(document), chain)


def _sensor(folder: Path) -> Section:
    file = folder / "sensor.yaml"
    if not file.is_file():  # the first value that is read then raises an error with its name
        return Section({}, file)
    return read_yaml(file)


def _is_complete(section: Section) -> bool:
    has_sphere = section.values.get("camera_model") in kalibr.SPHERES  # these models may have no distortion
    required = _CAMERA_KEYS[:3] if has_sphere else _CAMERA_KEYS
    return all(section.values.get(key) not in (None, [], "") for key in required)


def _name(root: Path) -> str:
    folder = root.resolve()
    return folder.parent.name if folder.name == "mav0" else folder.name
