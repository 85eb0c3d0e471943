"""Reader of KITTI's ``calib.txt`` (P0 to P3) of the odometry benchmark and ``calib_cam_to_cam.txt`` of raw drives.

Both describe rectified images, ``P_i = K_i [1 | t_i]`` with ``X_cam_i = X_cam0 + t_i``. Body is the rectified
grey left camera, which is also the frame of the benchmark's poses. The grey pair (0, 1) is used, or the colour pair
(2, 3) where a recording has only that.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError
from graphvio.rig import Camera, Rig, StereoPair, checked_views
from graphvio.rig_files.reading import named, read_text

ODOMETRY_FILE = "calib.txt"
RAW_FILE = "calib_cam_to_cam.txt"
_PAIRS = (("grey", 0, 1), ("colour", 2, 3))


def load_odometry(file: Path) -> Rig:
    """Read ``calib.txt``; the image size, which it lacks, is read from the images next to it.

    Raises:
        RigError: if a projection or the images are missing, or they do not describe a usable rig.
    """
    entries = _entries(file)
    if not any(key.startswith("P") for key in entries):
        raise RigError(
            f"{file}: is no calibration that graphvio knows: no YAML or JSON by its name, and none of KITTI's P0 to P3"
        )
    folder = file.parent
    name, left, right = pair_of([p.name for p in folder.iterdir() if p.is_dir()] if folder.is_dir() else [], "image_{}")
    size = _png_size(folder / f"image_{left}")
    if size is None:
        raise RigError(
            f"{file}: has no image size, and {folder / f'image_{left}'} holds no PNG to take it from; put it next "
            "to the image folders, or write a rig.yaml"
        )
    with named(file):
        cameras = [_camera(f"image_{i}", _projection(entries, f"P{i}", file), size) for i in (left, right)]
        return checked_views(Rig((StereoPair(name, *cameras),), None, folder.resolve().name))


def load_raw(file: Path, drive: Path | None = None) -> Rig:
    """Read ``calib_cam_to_cam.txt`` for a synchronised, rectified drive.

    Args:
        file: ``calib_cam_to_cam.txt``.
        drive: folder with ``image_00`` ...; the pair whose images it holds is chosen. None for the grey pair.

    Raises:
        RigError: if a projection or size is missing, or they do not describe a usable rig.
    """
    folders = [p.name for p in drive.iterdir() if p.is_dir()] if drive is not None else []
    name, left, right = pair_of(folders, "image_{:02d}")
    entries = _entries(file)
    with named(file):
        cameras = []
        for i in (left, right):
            size = _floats(entries, f"S_rect_{i:02d}", 2, file)
            projection = _projection(entries, f"P_rect_{i:02d}", file)
            cameras.append(_camera(f"image_{i:02d}", projection, (int(size[0]), int(size[1]))))
        return checked_views(Rig((StereoPair(name, *cameras),), None, (drive or file.parent).resolve().name))


def pair_of(folders: list[str], pattern: str) -> tuple[str, int, int]:
    """Choose the pair ``(name, left, right)``: the first whose two image folders exist, or else the grey pair."""
    for pair in _PAIRS:
        if pattern.format(pair[1]) in folders and pattern.format(pair[2]) in folders:
            return pair
    return _PAIRS[0]


def raw_calibration_of(drive: Path) -> Path | None:
    """Find ``calib_cam_to_cam.txt`` in a drive's folder or in the folder of its date; None if neither holds it."""
    drive = drive.resolve()
    for folder in (drive, drive.parent):
        if (folder / RAW_FILE).is_file():
            return folder / RAW_FILE
    return None


def _camera(name: str, projection: Float, size_px: tuple[int, int]) -> Camera:
    K = projection[:, :3]
    if abs(K[0, 1]) > 1e-6 or abs(np.linalg.det(K)) < 1e-9:
        raise RigError(f"camera {name}: projection is not of a rectified camera; check its 12 numbers")
    body_T_cam = np.eye(4)
    body_T_cam[:3, 3] = -np.linalg.solve(K, projection[:, 3])
    return Camera(
        name=name,
        model="radial-tangential",
        size_px=size_px,
        intrinsics=np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]),
        distortion=np.zeros(5),
        body_T_cam=body_T_cam,
    )


def _entries(file: Path) -> dict[str, str]:
    entries = {}
    for line in read_text(file).splitlines():
        key, colon, values = line.partition(":")
        if colon:
            entries[key.strip()] = values
    return entries


def _projection(entries: dict[str, str], key: str, file: Path) -> Float:
    return _floats(entries, key, 12, file).reshape(3, 4)


def _floats(entries: dict[str, str], key: str, count: int, file: Path) -> Float:
    if key not in entries:
        raise RigError(f"{file}: {key} is missing; give KITTI's own calibration file of this recording")
    try:
        values = np.array(entries[key].split(), dtype=np.float64)
    except ValueError:
        raise RigError(f"{file}: {key}: is not numeric; it must be {count} numbers") from None
    if values.shape != (count,) or not np.isfinite(values).all():
        raise RigError(f"{file}: {key}: holds {len(values)} numbers; it must be {count} finite ones")
    return values


def _png_size(folder: Path) -> tuple[int, int] | None:
    for file in sorted(folder.glob("*.png"))[:20]:  # a few, in case the first is broken
        with file.open("rb") as stream:
            head = stream.read(24)
        if len(head) == 24 and head[12:16] == b"IHDR":
            width, height = struct.unpack(">II", head[16:24])
            return int(width), int(height)
    return None
