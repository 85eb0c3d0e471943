"""Reader of COLMAP's ``rig_config.json`` with the ``cameras.txt`` next to it.

The configuration has the extrinsics ``cam_from_rig`` of each camera: a quaternion w x y z, and a translation (metres).
Image sizes are only in ``cameras.txt``, a part of COLMAP's text model; so are the lenses, unless the configuration has
them. In COLMAP the centre of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError
from graphvio.geometry import se3, se3_inverse
from graphvio.rig import Camera, Rig
from graphvio.rig_files.grouping import grouped_rig
from graphvio.rig_files.reading import Section, named, read_text

CAMERAS_FILE = "cameras.txt"
_MODELS: dict[str, tuple[str, int, tuple[int, ...]]] = {  # graphvio's name, number of focal lengths, coefficients
    "SIMPLE_PINHOLE": ("radial-tangential", 1, ()),
    "PINHOLE": ("radial-tangential", 2, ()),
    "SIMPLE_RADIAL": ("radial-tangential", 1, (0,)),
    "RADIAL": ("radial-tangential", 1, (0, 1)),
    "OPENCV": ("radial-tangential", 2, (0, 1, 2, 3)),
    "FULL_OPENCV": ("rational", 2, (0, 1, 2, 3, 4, 5, 6, 7)),
    "SIMPLE_RADIAL_FISHEYE": ("equidistant", 1, (0,)),
    "RADIAL_FISHEYE": ("equidistant", 1, (0, 1)),
    "SIMPLE_FISHEYE": ("equidistant", 1, ()),
    "FISHEYE": ("equidistant", 2, ()),
    "OPENCV_FISHEYE": ("equidistant", 2, (0, 1, 2, 3)),
    "EUCM": ("extended-unified", 2, (0, 1)),
}
_CENTRE_PX = 0.5


class _Lens(NamedTuple):
    """A line of ``cameras.txt``."""

    model: str
    size_px: tuple[int, int]
    parameters: list[float]


def load(path: Path) -> Rig:
    """Read the only rig of a configuration; it has no IMU, and body is the reference camera.

    A camera without a ``camera_id`` is the one of ``cameras.txt`` whose number is its position in the list, from 1.

    Args:
        path: configuration for which `is_config` is true.

    Raises:
        RigError: if a file cannot be read or lacks a value, or does not describe a usable rig.
    """
    rigs = json.loads(read_text(path))
    if len(rigs) > 1:
        raise RigError(f"{path}: has {len(rigs)} rigs; write a file of the one that is wanted")
    document = Section(rigs[0], path, "[0]")
    lenses = _lenses(path.parent / CAMERAS_FILE)
    sections = [document.nested(value, f"cameras[{i}]") for i, value in enumerate(rigs[0]["cameras"])]
    with named(path):
        cameras = [_camera(section, lenses, i + 1) for i, section in enumerate(sections)]
        return grouped_rig(cameras, None, path.stem, path)


def is_config(path: Path) -> bool:
    """Return whether a file has the keys of a rig configuration."""
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):
        return False
    return (
        isinstance(values, list)
        and bool(values)
        and all(isinstance(rig, dict) and isinstance(rig.get("cameras"), list) for rig in values)
    )


def _camera(section: Section, lenses: Mapping[int, _Lens], number: int) -> Camera:
    number = int(section.number("camera_id", float(number)))
    if number not in lenses:
        has = ", ".join(map(str, lenses)) or "none"
        raise RigError(f"{section.where('camera_id')}: {CAMERAS_FILE} has no camera {number}; it has {has}")
    model, size_px, parameters = lenses[number]
    if section.values.get("camera_model_name") is not None:
        model, parameters = section.text("camera_model_name"), section.array("camera_params").tolist()
    if model not in _MODELS:
        raise RigError(f"{section.file}: camera {number}: unknown model {model!r}; use one of {', '.join(_MODELS)}")
    name, n_focal, places = _MODELS[model]
    if len(parameters) != n_focal + 2 + len(places):
        raise RigError(
            f"{section.file}: camera {number} has {len(parameters)} parameters; {model} has {n_focal + 2 + len(places)}"
        )
    fx, fy = parameters[0], parameters[n_focal - 1]
    cx, cy, *coefficients = parameters[n_focal:]
    return Camera(
        name=_name(section, number),
        model=name,
        size_px=size_px,
        intrinsics=np.array([fx, fy, cx - _CENTRE_PX, cy - _CENTRE_PX]),
        distortion=np.array(coefficients, dtype=np.float64),
        body_T_cam=_rig_T_cam(section),
    )


def _name(section: Section, number: int) -> str:
    """Return a camera's name: the last folder of ``image_prefix``, ``data`` aside, or ``cam0``, ``cam1`` ..."""
    prefix = str(section.values.get("image_prefix") or "")
    parts = [part for part in prefix.split("/") if part and part != "data"]
    return parts[-1] if parts else f"cam{number - 1}"


def _rig_T_cam(section: Section) -> Float:
    if section.values.get("ref_sensor"):
        return np.eye(4)
    quat_wxyz = section.array("cam_from_rig_rotation", (4,))
    rotation = section.rotation(quat_wxyz, "cam_from_rig_rotation")
    return se3_inverse(se3(rotation, section.array("cam_from_rig_translation", (3,))))


def _lenses(path: Path) -> dict[int, _Lens]:
    """Read ``cameras.txt``, with number, model, width, height and parameters in each line; keys are the numbers."""
    if not path.is_file():
        raise RigError(
            f"{path}: does not exist; COLMAP's rig configuration has no image sizes: write the text model's "
            f"{CAMERAS_FILE} next to it (colmap model_converter --output_type TXT)"
        )
    lenses = {}
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        fields: list[Any] = line.split()
        if not fields or line.startswith("#"):
            continue
        try:
            size_px = int(fields[2]), int(fields[3])
            lenses[int(fields[0])] = _Lens(fields[1], size_px, [float(value) for value in fields[4:]])
        except (ValueError, IndexError):
            raise RigError(
                f"{path}: line {number} is no camera; it must be: id, model, width, height, parameters"
            ) from None
    return lenses
