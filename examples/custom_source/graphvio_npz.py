"""A layout of recordings as a plug-in of graphvio: all images of an instant in one ``.npz`` file.

frames/STAMP_NS.npz    an array for each camera, by its name
imu.npz                arrays stamps_ns, and values: angular velocity in degrees per second, specific force in g
rig.yaml               graphvio's own rig file
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

import graphvio
from graphvio.arrays import Image, Int
from graphvio.image_decoding import ImageError
from graphvio.measurements.events import EventKind
from graphvio.sources import FaultLog, ImuTable, Index

LAYOUT = "NPZ: frames/STAMP_NS.npz, imu.npz, rig.yaml"
UNITS = np.repeat([np.pi / 180.0, 9.80665], 3)  # of the file, in rad/s and m/s^2


@dataclass(frozen=True)
class Frames:
    """Images of one camera, read when they are due; `read` is called from several threads."""

    folder: Path  # that holds them
    camera: str  # name of the array
    stamps_ns: Int  # (N,) increasing

    def read(self, row: int) -> Image:
        """Return the image of a row."""
        path = self.folder / f"{self.stamps_ns[row]}.npz"
        try:
            with np.load(path) as arrays:
                image: Image = arrays[self.camera]
        except (OSError, ValueError, KeyError) as error:
            raise ImageError(EventKind.IMAGE_UNDECODABLE, f"{path}: {error}") from None
        return image


def matches(path: Path) -> bool:
    """Return whether a path has this layout."""
    return (path / "frames").is_dir() and (path / "imu.npz").is_file()


def read_index(path: Path, rig: graphvio.Rig, faults: FaultLog) -> Index:
    """Index the cameras of a rig, and the IMU."""
    stamps = np.array(sorted(int(file.stem) for file in (path / "frames").glob("*.npz")), dtype=np.int64)
    if not len(stamps):
        raise graphvio.SourceError(f"{path / 'frames'}: holds no .npz file; copy the recording again")
    images = {camera.name: Frames(path / "frames", camera.name, stamps) for camera in rig.cameras}
    with np.load(path / "imu.npz") as samples:
        imu = ImuTable(samples["stamps_ns"], samples["values"] * UNITS)
    return Index(faults.name, images, imu)
