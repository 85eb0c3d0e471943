"""Description of the recording in a folder: its rig, its cameras and IMU, their regularity, and faults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphvio.errors import RigError, SourceError, reading
from graphvio.image_decoding import ImageError
from graphvio.measurements.events import EventKind
from graphvio.rig import Camera, Rig
from graphvio.rig_files import load_rig
from graphvio.sources.description import Regularity, regularity, rig_line
from graphvio.sources.faults import FaultLog
from graphvio.sources.index import ImageFiles, ImageSequence
from graphvio.sources.opening import layout_of, read_index
from graphvio.sources.recording import Source


@dataclass(frozen=True)
class SensorDescription:
    """Description of a camera's images, or of the IMU's samples."""

    name: str  # name of the camera, or ``imu``
    count: int  # number of images or samples
    regularity: Regularity | None  # regularity of their stamps, or None if there are too few
    size_px: tuple[int, int] | None = None  # width and height of the first image, or None if it cannot be read


@dataclass(frozen=True)
class FolderDescription:
    """Description of a recording in a folder."""

    path: Path  # path of the folder
    layout: str  # name of its layout, such as ``EuRoC/ASL and TUM-VI``
    duration_s: float  # time from the first to the last frameset
    framesets: int  # number of framesets
    rate_hz: float | None  # rate of the framesets from their median interval, or None if there are too few
    rig: str  # one line about the calibration
    sensors: tuple[SensorDescription, ...]  # the rig's cameras, then the IMU
    truth: Path | None  # file of the true trajectory, or None
    faults: Mapping[str, int]  # kind of event -> count; only the first image of each camera is decoded


def describe_folder(path: Path, rig: Path | None = None) -> FolderDescription:
    """Describe a recording in a folder; of each camera one image is decoded.

    Args:
        path: path of the folder.
        rig: calibration file, or None for the recording's own calibration.

    Raises:
        SourceError: if the folder has no known layout, cannot be read, or holds nothing.
        RigError: if the calibration is not usable, is for images of another size, or there is none.
    """
    used = None if rig is None else load_rig(rig)
    with reading(path, SourceError, "check its permissions"):
        return _described(path, used)


def _described(path: Path, rig: Rig | None) -> FolderDescription:
    index, used, faults = read_index(path, rig, {})
    recording = Source(index, used, faults)
    sensors = [_camera(camera, index.images[camera.name], path, faults) for camera in used.cameras]
    if index.imu is not None:
        sensors.append(SensorDescription("imu", len(index.imu.stamps_ns), regularity(index.imu.stamps_ns)))
    found = regularity(recording.stamps_ns)
    return FolderDescription(
        path=path,
        layout=layout_of(path).LAYOUT.partition(":")[0],
        duration_s=float(np.ptp(recording.stamps_ns)) / 1e9,
        framesets=recording.frameset_count,
        rate_hz=None if found is None else found.rate_hz,
        rig=rig_line(used),
        sensors=tuple(sensors),
        truth=index.truth,
        faults=dict(faults.counts),
    )


def _camera(camera: Camera, images: ImageSequence, path: Path, faults: FaultLog) -> SensorDescription:
    """Describe the images of a camera; images that are listed but do not exist are added to the faults."""
    if isinstance(images, ImageFiles):
        absent = [row for row, name in enumerate(images.names) if not (images.folder / name).is_file()]
        if absent:
            detail = f"{images.folder / images.names[absent[0]]} does not exist"
            faults.add(EventKind.IMAGE_MISSING, int(images.stamps_ns[absent[0]]), detail, len(absent))
    try:
        height, width = images.read(0).shape
    except ImageError:
        return SensorDescription(camera.name, len(images.stamps_ns), regularity(images.stamps_ns))
    if (width, height) != camera.size_px:
        raise RigError(
            f"{path}: {camera.name}: image is {width}x{height}, the rig says {camera.size_px[0]}x{camera.size_px[1]}; "
            "calibrate at the recording's size, or give the rig that belongs to it"
        )
    return SensorDescription(camera.name, len(images.stamps_ns), regularity(images.stamps_ns), (width, height))
