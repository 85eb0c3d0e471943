"""A sequence of KITTI's odometry benchmark: ``image_0``, ``image_1``, ``times.txt``, ``calib.txt``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphvio.errors import SourceError
from graphvio.rig import Rig
from graphvio.sources.faults import FaultLog
from graphvio.sources.recording import ImageFiles, Index
from graphvio.sources.tables import clean_stamps, decimal_ns, read_lines

LAYOUT = "KITTI odometry: image_0/*.png, image_1/*.png (or image_2, image_3), times.txt, calib.txt"


def matches(path: Path) -> bool:
    """Whether a folder has this layout."""
    return any((path / f"image_{i}").is_dir() for i in (0, 2))


def read_index(path: Path, rig: Rig, faults: FaultLog) -> Index:
    """Index the cameras of a rig; the images of row i are the i-th of each folder.

    Raises:
        SourceError: if the times or the images of a camera of the rig are missing.
    """
    times = path / "times.txt"
    if not times.is_file():
        raise SourceError(f"{times}: is missing; it comes with KITTI's calibration files: put it there")
    rows, stamps = [], []
    for row, line in enumerate(read_lines(times)):
        stamp = decimal_ns(line, 1_000_000_000)
        if stamp is not None:
            rows.append(row)
            stamps.append(stamp)
        elif line.strip():
            faults.add("frame_garbage", stamps[-1] if stamps else 0, f"{times}: line {row + 1} is no time; dropped")
    stamps_ns = np.array(stamps, dtype=np.int64)
    kept = clean_stamps(stamps_ns, "frame", times, faults)
    names = [f"{row:06d}.png" for row, keep in zip(rows, kept, strict=True) if keep]
    tracks = {}
    for camera in rig.cameras:
        if not (path / camera.name).is_dir():
            raise SourceError(f"{path}: has no folder {camera.name}, which the rig names; give KITTI's own calib.txt")
        tracks[camera.name] = ImageFiles(path / camera.name, stamps_ns[kept], names)
    return Index(faults.name, tracks, None, _truth(path))


def _truth(path: Path) -> Path | None:
    path = path.resolve()
    places = (
        path / "poses.txt",
        path / f"{path.name}.txt",
        path.parent.parent / "poses" / f"{path.name}.txt",
    )
    return next((place for place in places if place.is_file()), None)
