"""Reader of EuRoC/ASL folders with any number of cameras, and of TUM-VI's and Monado's in the same layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphvio.arrays import Int
from graphvio.errors import SourceError
from graphvio.measurements.events import EventKind
from graphvio.rig import Rig
from graphvio.rig_files.euroc import camera_folders, sensors_folder
from graphvio.sessions.euroc_layout import MASKS_FOLDER
from graphvio.sources.faults import FaultLog
from graphvio.sources.index import ImageFiles, Index
from graphvio.sources.tables import read_frame_csv, read_imu_csv

LAYOUT = "EuRoC/ASL and TUM-VI: mav0/cam0/data.csv"
_TRUTHS = ("state_groundtruth_estimate0", "gt", "mocap0")  # folders of the true trajectory: EuRoC, Monado, TUM-VI


def matches(path: Path) -> bool:
    """Return whether a folder has this layout."""
    return sensors_folder(path) is not None


def read_index(path: Path, rig: Rig, faults: FaultLog) -> Index:
    """Index the cameras of a rig, and the IMU if it has one."""
    root = sensors_folder(path)
    if root is None:
        raise SourceError(f"{path}: holds no cam0, cam1, ...; give an EuRoC/ASL recording")
    images = {camera.name: _images(root, camera.name, faults) for camera in rig.cameras}
    imu_csv = root / "imu0" / "data.csv"
    imu = read_imu_csv(imu_csv, faults) if rig.imu is not None and imu_csv.is_file() else None
    truths = [root / name / "data.csv" for name in _TRUTHS]
    truth = next((file for file in truths if file.is_file()), None)
    masks = {camera.name: _masks(root / camera.name / MASKS_FOLDER) for camera in rig.cameras}
    return Index(faults.name, images, imu, truth, {name: found for name, found in masks.items() if found.names})


def _masks(folder: Path) -> ImageFiles:
    """Index the mask files in a folder, whose names are their images' stamps."""
    stamps, files = _named_by_stamp(folder)
    return ImageFiles(folder, stamps, files)


def _named_by_stamp(folder: Path) -> tuple[Int, list[str]]:
    files = sorted((p for p in folder.glob("*.png") if p.stem.isdecimal()), key=lambda p: int(p.stem))
    return np.array([int(p.stem) for p in files], dtype=np.int64), [p.name for p in files]


def _images(root: Path, camera: str, faults: FaultLog) -> ImageFiles:
    folder = root / camera
    if not folder.is_dir():
        has = ", ".join(p.name for p in camera_folders(root))
        raise SourceError(f"{root}: has no camera {camera}, which the rig names; it has {has}: give the rig of these")
    images = folder / "data"
    csv = folder / "data.csv"
    if csv.is_file():
        stamps, names = read_frame_csv(csv, faults)
    else:
        stamps, names = _named_by_stamp(images)
        faults.add(EventKind.CSV_MISSING, 0, f"{csv} does not exist; stamps are taken from the names of the images")
    if not names:
        raise SourceError(f"{folder}: has no data.csv, and no image in data/ that is named by its stamp")
    return ImageFiles(images, stamps, names)
