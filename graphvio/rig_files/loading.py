"""Reads a rig from a calibration file or folder of any supported format."""

from __future__ import annotations

from pathlib import Path

from graphvio.errors import RigError, reading
from graphvio.rig import Rig
from graphvio.rig_files import basalt, colmap, euroc, kalibr, kitti, native, orb_slam3, vins_fusion
from graphvio.rig_files.reading import read_yaml

_FORMATS = (
    "rig.yaml, Kalibr's camchain-imucam.yaml, Basalt's calibration.json, COLMAP's rig_config.json, an EuRoC/ASL folder "
    "(mav0), KITTI's calib.txt or calib_cam_to_cam.txt, a configuration of OpenVINS, VINS-Fusion or ORB-SLAM3"
)
_OPENVINS_CHAIN_KEY = "relative_config_imucam"
"""Key of the camera chain's file name in OpenVINS's ``estimator_config.yaml``."""


def load_rig(path: str | Path) -> Rig:
    """Read a rig from a calibration file, or from the folder of a recording that holds one.

    Args:
        path: ``rig.yaml``, a Kalibr camera chain, Basalt's ``calibration.json``, COLMAP's ``rig_config.json`` with its
            ``cameras.txt``, a ``sensor.yaml`` of an EuRoC/ASL folder, KITTI's ``calib.txt`` or
            ``calib_cam_to_cam.txt``, a configuration of OpenVINS, VINS-Fusion or ORB-SLAM3; or a folder, in which
            ``rig.yaml`` takes precedence.

    Returns:
        The rig.

    Raises:
        RigError: if there is no such file, it cannot be read, or it does not describe a usable rig.
    """
    path = Path(path)
    with reading(path, RigError, "check the path"):
        return _load(path)


def _load(path: Path) -> Rig:
    if path.is_dir():
        rig = find_rig(path)
        if rig is None:
            raise RigError(f"{path}: holds no calibration that graphvio knows; give one of: {_FORMATS}")
        return rig
    if not path.exists():
        raise RigError(f"{path}: does not exist; give one of: {_FORMATS}")
    if path.name == kitti.RAW_FILE:
        return kitti.load_raw(path)
    if path.suffix == ".txt":
        return kitti.load_odometry(path)
    if path.name == "sensor.yaml":
        return euroc.load(path.parent.parent)
    if path.suffix == ".json":
        return colmap.load(path) if colmap.is_config(path) else basalt.load(path)
    if path.suffix not in (".yaml", ".yml"):
        raise RigError(f"{path}: is no calibration file that graphvio knows; give one of: {_FORMATS}")
    document = read_yaml(path)
    if native.VERSION_KEY in document.values:
        return native.load(path)
    if kalibr.camera_names(document):
        return kalibr.load(path)
    if _OPENVINS_CHAIN_KEY in document.values:
        return kalibr.load(path.parent / document.text(_OPENVINS_CHAIN_KEY))
    if vins_fusion.is_config(document):
        return vins_fusion.load(document)
    if orb_slam3.is_settings(document):
        return orb_slam3.load(document)
    if path.name == native.FILE_NAME:
        return native.load(path)  # raises an error that names the missing key
    raise RigError(
        f"{path}: holds no calibration that graphvio knows; give one of: {_FORMATS}; a rig.yaml begins with  "
        f"{native.VERSION_KEY}: {native.VERSIONS[-1]}"
    )


def find_rig(folder: Path) -> Rig | None:
    """Read the rig in the folder of a recording; None if there is none.

    Raises:
        RigError: if there is a calibration that is not usable, or there are several camera chains.
    """
    sensors = euroc.sensors_folder(folder)
    places = [folder] if sensors is None else [folder, sensors]
    if folder.resolve().name == "mav0":
        places.append(folder.resolve().parent)
    for place in places:
        if (place / native.FILE_NAME).is_file():
            return native.load(place / native.FILE_NAME)
    if sensors is not None and euroc.has_calibration(sensors):
        return euroc.load(folder)
    if (folder / kitti.ODOMETRY_FILE).is_file():
        return kitti.load_odometry(folder / kitti.ODOMETRY_FILE)
    raw = kitti.raw_calibration_of(folder)
    if raw is not None:
        has_images = any(folder.glob("image_0[0-3]"))
        return kitti.load_raw(raw, folder if has_images else None)
    chains = sorted([*folder.glob("*camchain*.yaml"), *folder.glob("*imucam_chain.yaml")])
    with_imu = [chain for chain in chains if "imucam" in chain.name]
    if len(with_imu or chains) > 1:
        names = ", ".join(chain.name for chain in with_imu or chains)
        raise RigError(f"{folder}: holds several camera chains ({names}); give the path of one of them")
    if chains:
        return kalibr.load((with_imu or chains)[0])
    calibration = folder / basalt.FILE_NAME
    return basalt.load(calibration) if basalt.is_calibration(calibration) else None
