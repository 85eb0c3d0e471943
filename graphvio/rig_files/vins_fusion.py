"""Reader of VINS-Fusion's configuration: extrinsics of the cameras, the IMU, and the name of a lens file per camera.

``body_T_cam0`` is graphvio's ``body_T_cam``, and ``td`` its ``time_offset_s``. Lens files have camodocal's models.
VINS-Fusion integrates the IMU sample by sample: ``gyr_n`` and the other noise values are standard deviations of one
sample, and the file has no rate. They are converted to densities at graphvio's default rate, and are at least
graphvio's default densities, since many files give densities instead of standard deviations of a sample.
"""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.rig import Camera, Imu, Rig, checked_transform
from graphvio.rig_files.grouping import grouped_rig
from graphvio.rig_files.reading import NOISE_KEYS, Section, named, read_yaml

_CAMERA_KEY = "cam{}_calib"
_NOISE = dict(zip(NOISE_KEYS, ("gyr_n", "gyr_w", "acc_n", "acc_w"), strict=True))
_PINHOLE = ("fx", "fy", "cx", "cy")
_BROWN = ("k1", "k2", "p1", "p2")
_PARAMETERS = ("projection_parameters", "distortion_parameters", "mirror_parameters")
_LENSES: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "PINHOLE": ("radial-tangential", _PINHOLE, _BROWN),
    "PINHOLE_FULL": ("rational", _PINHOLE, (*_BROWN, "k3", "k4", "k5", "k6")),
    "KANNALA_BRANDT": ("equidistant", ("mu", "mv", "u0", "v0"), ("k2", "k3", "k4", "k5")),
    "MEI": ("omnidirectional", ("gamma1", "gamma2", "u0", "v0"), ("xi", *_BROWN)),
}
"""``model_type`` -> graphvio's name of the lens model, keys of the intrinsics, and keys of the coefficients."""


def is_config(document: Section) -> bool:
    """Return whether a YAML document is a configuration of VINS-Fusion."""
    return _CAMERA_KEY.format(0) in document.values


def load(document: Section) -> Rig:
    """Read a rig of one or two cameras from a configuration and the lens files that it names.

    Raises:
        RigError: if a file cannot be read or lacks a value, or the files do not describe a usable rig.
    """
    path = document.file
    n_cameras = int(document.number("num_of_cam", 1.0))
    with named(path):
        cameras = [_camera(document, i) for i in range(n_cameras)]
        return grouped_rig(cameras, _imu(document) if document.number("imu", 1.0) else None, path.stem, path)


def _camera(document: Section, i: int) -> Camera:
    section = read_yaml(document.file.parent / document.text(_CAMERA_KEY.format(i)))
    model, intrinsics, coefficients = _LENSES[section.model("model_type", _LENSES)]
    values = {key: value for name in _PARAMETERS for key, value in _mapping(section, name).items()}
    parameters = Section(values, section.file)
    where = f"body_T_cam{i}"
    return Camera(
        name=f"cam{i}",
        model=model,
        size_px=(int(section.number("image_width")), int(section.number("image_height"))),
        intrinsics=_numbers(parameters, intrinsics),
        distortion=_numbers(parameters, coefficients),
        body_T_cam=checked_transform(document.matrix(where), document.where(where)),
    )


def _mapping(section: Section, key: str) -> dict[str, object]:
    return dict(section.section(key).values) if section.values.get(key) is not None else {}


def _numbers(section: Section, keys: tuple[str, ...]) -> Float:
    return np.array([section.number(key) for key in keys])


def _imu(document: Section) -> Imu:
    default = Imu()
    sample_s = 1.0 / default.rate_hz
    densities = {
        name: max(getattr(default, name), sample_s**0.5 * document.number(key)) for name, key in _NOISE.items()
    }
    return Imu(**densities, time_offset_s=document.number("td", 0.0))
