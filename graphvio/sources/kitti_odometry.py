"""Reader of sequences of KITTI's odometry benchmark: ``image_0``, ``image_1``, ``times.txt``, ``calib.txt``."""

from __future__ import annotations

from pathlib import Path

from graphvio.errors import SourceError
from graphvio.rig import Rig
from graphvio.sources.faults import FaultLog
from graphvio.sources.index import ImageFiles, Index
from graphvio.sources.tables import decimal_ns, read_times

LAYOUT = "KITTI odometry: image_0/*.png, times.txt"


def matches(path: Path) -> bool:
    """Return whether a folder has this layout."""
    return any((path / f"image_{i}").is_dir() for i in (0, 2))


def read_index(path: Path, rig: Rig, faults: FaultLog) -> Index:
    """Index the cameras of a rig; the images with the time in line i of ``times.txt`` are named by i."""
    times = path / "times.txt"
    if not times.is_file():
        raise SourceError(f"{times}: is missing; it comes with KITTI's calibration files: put it there")
    stamps_ns, rows = read_times(times, lambda line: decimal_ns(line, 1_000_000_000), faults)
    names = [f"{row:06d}.png" for row in rows]
    images = {}
    for camera in rig.cameras:
        if not (path / camera.name).is_dir():
            raise SourceError(f"{path}: has no folder {camera.name}, which the rig names; give KITTI's own calib.txt")
        images[camera.name] = ImageFiles(path / camera.name, stamps_ns, names)
    return Index(faults.name, images, None, _truth(path))


def _truth(path: Path) -> Path | None:
    path = path.resolve()
    places = (
        path / "poses.txt",
        path / f"{path.name}.txt",
        path.parent.parent / "poses" / f"{path.name}.txt",
    )
    return next((place for place in places if place.is_file()), None)
