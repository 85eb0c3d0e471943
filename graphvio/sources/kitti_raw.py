"""A synchronised, rectified drive of KITTI's raw data: ``image_00/data/*.png``, ``image_00/timestamps.txt``.

In a synchronised drive the i-th images of all cameras belong together though their stamps differ a little, so
both cameras of a pair take the stamps of the left one.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from graphvio.errors import SourceError
from graphvio.rig import Rig
from graphvio.sources.faults import FaultLog
from graphvio.sources.recording import ImageFiles, Index
from graphvio.sources.tables import clean_stamps, decimal_ns, read_lines

LAYOUT = "KITTI raw: image_00/data/*.png, image_00/timestamps.txt (and 01, or 02 and 03)"


def matches(path: Path) -> bool:
    """Whether a folder has this layout."""
    return any((path / f"image_{i:02d}" / "data").is_dir() for i in (0, 2))


def read_index(path: Path, rig: Rig, faults: FaultLog) -> Index:
    """Index the cameras of a rig.

    Raises:
        SourceError: if the stamps or the images of a camera of the rig are missing.
    """
    tracks = {}
    for pair in rig.pairs:
        file = path / pair.left.name / "timestamps.txt"
        rows, stamps = [], []
        for row, line in enumerate(read_lines(file)):
            stamp = utc_ns(line)
            if stamp is not None:
                rows.append(row)
                stamps.append(stamp)
            elif line.strip():
                detail = f"{file}: line {row + 1} is no date and time; it is dropped"
                faults.add("frame_garbage", stamps[-1] if stamps else 0, detail)
        stamps_ns = np.array(stamps, dtype=np.int64)
        kept = clean_stamps(stamps_ns, "frame", file, faults)
        names = [f"{row:010d}.png" for row, keep in zip(rows, kept, strict=True) if keep]
        for camera in (pair.left, pair.right):
            folder = path / camera.name / "data"
            if not folder.is_dir():
                raise SourceError(
                    f"{folder}: is missing, and the rig names {camera.name}; give KITTI's own calibration"
                )
            tracks[camera.name] = ImageFiles(folder, stamps_ns[kept], names)
    return Index(faults.name, tracks)


def utc_ns(text: str) -> int | None:
    """Nanoseconds since 1970, exactly, of ``2011-09-26 13:02:25.951199337``; None if it is no time."""
    whole, _, fraction = text.strip().partition(".")
    try:
        moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return None
    fraction_ns = decimal_ns(f"0.{fraction or 0}", 1_000_000_000)
    return None if fraction_ns is None else int(moment.timestamp()) * 1_000_000_000 + fraction_ns
