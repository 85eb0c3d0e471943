"""Reader of UZH-FPV's drone races: ``left_images.txt``, ``right_images.txt``, ``imu.txt``, ``img``.

Rows are ``id stamp_s path`` and ``id stamp_s wx wy wz ax ay az``. The calibration is a Kalibr chain in another folder,
whose ``cam0`` is the left camera.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphvio.errors import SourceError
from graphvio.measurements.events import EventKind
from graphvio.rig import Rig
from graphvio.sources.faults import FaultLog
from graphvio.sources.index import ImageFiles, Index
from graphvio.sources.tables import (
    ImuTable,
    clean_stamps,
    decimal_ns,
    imu_row,
    read_lines,
    read_rows,
    read_times,
    rows_in_lines,
)

LAYOUT = "UZH-FPV: left_images.txt"
_FILES = {"cam0": "left_images.txt", "cam1": "right_images.txt"}
_NS_PER_S = 1_000_000_000


def matches(path: Path) -> bool:
    """Return whether a folder has this layout."""
    return (path / _FILES["cam0"]).is_file()


def read_index(path: Path, rig: Rig, faults: FaultLog) -> Index:
    """Index the cameras of a rig, and the IMU if it has one."""
    images = {camera.name: _images(path, camera.name, faults) for camera in rig.cameras}
    imu_file = path / "imu.txt"
    imu = _read_imu(imu_file, faults) if rig.imu is not None and imu_file.is_file() else None
    truth = path / "groundtruth.txt"
    return Index(faults.name, images, imu, truth if truth.is_file() else None)


def _images(path: Path, camera: str, faults: FaultLog) -> ImageFiles:
    if camera not in _FILES:
        raise SourceError(f"{path}: has no camera {camera}, which the rig names; it has cam0 (left) and cam1 (right)")
    file = path / _FILES[camera]
    stamps_ns, rows = read_times(file, _image_stamp, faults)
    lines = read_lines(file)
    return ImageFiles(path, stamps_ns, [lines[row].split()[2] for row in rows])


def _image_stamp(line: str) -> int | None:
    cells = line.split()
    return decimal_ns(cells[1], _NS_PER_S) if len(cells) >= 3 else None


def _read_imu(path: Path, faults: FaultLog) -> ImuTable:
    stamps_ns, values = read_rows(path, rows_in_lines(path), _sample, EventKind.IMU_GARBAGE, faults)
    kept = clean_stamps(stamps_ns, "imu", path, faults)
    return ImuTable(stamps_ns[kept], np.array(values, dtype=np.float64).reshape(-1, 6)[kept])


def _sample(line: str) -> tuple[int, list[float]] | None:
    cells = line.split()
    row = imu_row(decimal_ns(cells[1], _NS_PER_S) if len(cells) > 1 else None, cells[2:8])
    return row if row is not None and np.isfinite(row[1]).all() else None
