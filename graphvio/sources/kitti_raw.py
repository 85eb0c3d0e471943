"""Reader of synchronised, rectified drives of KITTI's raw data: ``image_00/data/*.png``, ``image_00/timestamps.txt``.

The i-th images of all cameras of such a drive belong together although their stamps differ a little, so both cameras of
a pair get the stamps of the left one.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from graphvio.errors import SourceError
from graphvio.rig import Rig
from graphvio.sources.faults import FaultLog
from graphvio.sources.index import ImageFiles, Index
from graphvio.sources.tables import decimal_ns, read_times

LAYOUT = "KITTI raw: image_00/data/*.png"


def matches(path: Path) -> bool:
    """Return whether a folder has this layout."""
    return any((path / f"image_{i:02d}" / "data").is_dir() for i in (0, 2))


def read_index(path: Path, rig: Rig, faults: FaultLog) -> Index:
    """Index the cameras of a rig."""
    images = {}
    for group in rig.groups:
        stamps_ns, rows = read_times(path / group.left.name / "timestamps.txt", _utc_ns, faults)
        names = [f"{row:010d}.png" for row in rows]
        for camera in group.cameras:
            folder = path / camera.name / "data"
            if not folder.is_dir():
                raise SourceError(
                    f"{folder}: is missing, and the rig names {camera.name}; give KITTI's own calibration"
                )
            images[camera.name] = ImageFiles(folder, stamps_ns, names)
    return Index(faults.name, images)


def _utc_ns(text: str) -> int | None:
    """Return exact nanoseconds since 1970 of a text like ``2011-09-26 13:02:25.951199337``; None if it is no time."""
    whole, _, fraction = text.strip().partition(".")
    try:
        moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return None
    fraction_ns = decimal_ns(f"0.{fraction or 0}", 1_000_000_000)
    return None if fraction_ns is None else int(moment.timestamp()) * 1_000_000_000 + fraction_ns
