"""Reader and writer of graphvio's own ``rig.yaml``: any number of pairs and single cameras, and at most one IMU.

Version 2 of the format adds ``single_cameras``, and the keys ``line_time_us`` and ``stamp_offset_s`` of cameras. A rig
that needs none of these is written in version 1.

The format is documented with a full example in ``docs/reference/data-contract.md``.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from graphvio.calibration_sigmas import FACTORY, LEVELS, CalibrationSigmas
from graphvio.cameras import COEFFICIENTS
from graphvio.errors import RigError, writing
from graphvio.rig import Camera, Imu, Rig, SingleCamera, StereoPair, as_written, checked_views
from graphvio.rig_files.reading import NOISE_KEYS, Section, named, parse_yaml, read_text

VERSIONS = (1, 2)
VERSION_KEY = "graphvio_rig"
FILE_NAME = "rig.yaml"

_RIG_KEYS = (VERSION_KEY, "name", "calibration_sigmas", "imu", "pairs")
_SINGLES_KEY = "single_cameras"
_ESTIMATED_KEY = "estimated"
_IMU_MATRICES = ("gyro_matrix", "accel_matrix")
_IMU_KEYS = ("rate_hz", *NOISE_KEYS, "time_offset_s", *_IMU_MATRICES)
_PAIR_KEYS = ("name", "left", "right")
_LINE_TIME_KEY = "line_time_us"
_STAMP_OFFSET_KEY = "stamp_offset_s"
_CAMERA_KEYS_OF_VERSION_2 = (_LINE_TIME_KEY, _STAMP_OFFSET_KEY)
_CAMERA_KEYS = (
    "name", "model", "size_px", "intrinsics", "distortion", "body_T_cam", "mask", *_CAMERA_KEYS_OF_VERSION_2
)  # fmt: skip


def load(path: Path) -> Rig:
    """Read a ``rig.yaml``.

    Raises:
        RigError: if the file cannot be read, lacks a value, or has an unknown key or an invalid value.
    """
    return parse(read_text(path), path)


def parse(text: str, path: Path) -> Rig:
    """Read a rig from the text of a ``rig.yaml``.

    Args:
        text: contents of the ``rig.yaml``.
        path: path of the file, or of another file in which the text is embedded; masks are relative to its folder.

    Raises:
        RigError: if the text lacks a value, or has an unknown key or an invalid value.
    """
    document = parse_yaml(text, path)
    version = document.values.get(VERSION_KEY)
    if version is None:
        raise RigError(f"{path}: {VERSION_KEY} is missing; begin the file with  {VERSION_KEY}: {VERSIONS[-1]}")
    if version not in VERSIONS:
        raise RigError(
            f"{path}: {VERSION_KEY} is {version!r}; this graphvio reads versions 1 and 2: update graphvio or the file"
        )
    if version == 1 and _SINGLES_KEY in document.values:
        raise RigError(f"{document.where(_SINGLES_KEY)}: is of version 2; write  {VERSION_KEY}: 2")
    document.only((*_RIG_KEYS, _SINGLES_KEY))
    given = document.values.get("pairs", []) if _SINGLES_KEY in document.values else document.get("pairs")
    if not isinstance(given, list) or not (given or _SINGLES_KEY in document.values):
        raise RigError(f"{path}: pairs must be a list of at least one pair, each with left and right")
    with named(path):
        pairs = tuple(_pair(document.nested(value, f"pairs[{i}]"), i) for i, value in enumerate(given))
        singles = _singles(document)
        imu = _imu(document.section("imu")) if document.values.get("imu") is not None else None
        name = document.text("name") if document.values.get("name") is not None else path.stem
        rig = checked_views(Rig(pairs, imu, name, _sigmas(document), singles))
    newer = _keys_of_version_2(rig)
    if version == 1 and newer:
        raise RigError(f"{path}: {newer[0]} is of version 2; write  {VERSION_KEY}: 2")
    return rig


def save_rig(rig: Rig, path: str | Path) -> None:
    """Write a ``rig.yaml`` from which the same values are read back, to the last digit.

    Args:
        rig: the rig to be written.
        path: path of the file, which is replaced; paths of masks in its folder are written relative to it.

    Raises:
        RigError: if the file cannot be written.
    """
    path = Path(path)
    with writing(path, RigError, "choose another place"):
        path.write_text(to_text(rig, path.parent), encoding="utf-8")


def to_text(rig: Rig, folder: Path) -> str:
    """Return the text of a ``rig.yaml`` in a folder; paths of masks inside the folder are relative to it."""
    lines = [
        "# Cameras of a rig, and its IMU. Metres, radians, seconds, pixels; body is the frame of the IMU.",
        f"{VERSION_KEY}: {VERSIONS[1] if rig.singles or _keys_of_version_2(rig) else VERSIONS[0]}",
        f"name: {_quoted(rig.name)}",
    ]
    if rig.calibration_sigmas != FACTORY:
        lines.append("calibration_sigmas:")
        lines += [f"  {name}: {_number(value)}" for name, value in rig.calibration_sigmas.values.items()]
        if rig.calibration_sigmas.estimated:
            lines.append(f"  {_ESTIMATED_KEY}: true")
    if rig.imu is not None:
        lines += [
            "imu:",
            f"  rate_hz: {_number(rig.imu.rate_hz)}",
            f"  gyro_noise_density: {_number(rig.imu.gyro_noise_density)}  # rad/s/sqrt(Hz)",
            f"  gyro_random_walk: {_number(rig.imu.gyro_random_walk)}  # rad/s^2/sqrt(Hz)",
            f"  accel_noise_density: {_number(rig.imu.accel_noise_density)}  # m/s^2/sqrt(Hz)",
            f"  accel_random_walk: {_number(rig.imu.accel_random_walk)}  # m/s^3/sqrt(Hz)",
            f"  time_offset_s: {_number(rig.imu.time_offset_s)}  # t_imu = t_cam + time_offset_s",
        ]
        if rig.imu.has_matrices:
            for key, matrix in zip(_IMU_MATRICES, rig.imu.matrices, strict=True):
                lines += [f"  {key}:", *(f"    - {_numbers(row)}" for row in matrix)]
    if rig.pairs:
        lines.append("pairs:")
    for pair in rig.pairs:
        lines.append(f"  - name: {_quoted(pair.name)}")
        for side, camera in (("left", pair.left), ("right", pair.right)):
            lines.append(f"    {side}:")
            lines += [f"      {line}" for line in _camera_lines(camera, folder)]
    if rig.singles:
        lines.append(f"{_SINGLES_KEY}:")
        for single in rig.singles:
            first, *others = _camera_lines(single.left, folder)
            lines += [f"  - {first}", *(f"    {line}" for line in others)]
    return "\n".join(lines) + "\n"


def _keys_of_version_2(rig: Rig) -> list[str]:
    """Return the keys of version 2 that any of the rig's cameras needs."""
    return [key for key in _CAMERA_KEYS_OF_VERSION_2 if any(getattr(camera, key) for camera in rig.cameras)]


def _sigmas(document: Section) -> CalibrationSigmas:
    """Read the standard deviations of the calibration, given as the name of a level or as a mapping of values."""
    if "calibration_sigmas" not in document.values:
        return FACTORY
    given = document.values["calibration_sigmas"]
    if given is None or isinstance(given, str):
        if given not in LEVELS:
            fault = "there is no level given" if given is None else f"there is no level {given!r}"
            where, levels = document.where("calibration_sigmas"), ", ".join(LEVELS)
            raise RigError(f"{where}: {fault}; use one of {levels}, or a mapping of values")
        return LEVELS[given]
    section = document.section("calibration_sigmas")
    section.only([*FACTORY.values, _ESTIMATED_KEY])
    values = {name: section.number(name, default) for name, default in FACTORY.values.items()}
    return CalibrationSigmas(**values, estimated=section.flag(_ESTIMATED_KEY))


def _singles(document: Section) -> tuple[SingleCamera, ...]:
    given = document.values.get(_SINGLES_KEY, [])
    if not isinstance(given, list):
        raise RigError(f"{document.where(_SINGLES_KEY)}: must be a list of cameras")
    return tuple(SingleCamera(_camera(document.nested(value, f"{_SINGLES_KEY}[{i}]"))) for i, value in enumerate(given))


def _pair(section: Section, index: int) -> StereoPair:
    section.only(_PAIR_KEYS)
    name = section.text("name") if section.values.get("name") is not None else f"pair{index}"
    return StereoPair(name, _camera(section.section("left")), _camera(section.section("right")))


def _camera(section: Section) -> Camera:
    section.only(_CAMERA_KEYS)
    mask = None
    if section.values.get("mask") is not None:
        mask = (section.file.parent / section.text("mask")).resolve()
        if not mask.is_file():
            raise RigError(f"{section.where('mask')}: there is no image {mask}; correct the path or remove the key")
    body_T_cam = section.matrix("body_T_cam")
    camera = Camera(
        name=section.text("name"),
        model=section.text("model"),
        size_px=section.size("size_px"),
        intrinsics=section.array("intrinsics", (4,)),
        distortion=section.array("distortion"),
        body_T_cam=body_T_cam,
        mask=mask,
        line_time_us=section.number(_LINE_TIME_KEY, 0.0),
        stamp_offset_s=section.number(_STAMP_OFFSET_KEY, 0.0),
    )
    return as_written(camera, body_T_cam)


def _imu(section: Section) -> Imu:
    section.only(_IMU_KEYS)
    noise = section.noise("rate_hz", {key: key for key in NOISE_KEYS})
    for key in _IMU_MATRICES:
        if section.values.get(key) is not None:
            noise[key] = tuple(section.array(key, (3, 3)).ravel().tolist())
    return Imu(**noise, time_offset_s=section.number("time_offset_s", 0.0))


def _camera_lines(camera: Camera, folder: Path) -> Iterable[str]:
    yield f"name: {_quoted(camera.name)}"
    yield f"model: {camera.model}"
    yield f"size_px: [{camera.size_px[0]}, {camera.size_px[1]}]"
    yield f"intrinsics: {_numbers(camera.intrinsics)}  # fx, fy, cx, cy"
    yield f"distortion: {_numbers(camera.distortion[: len(COEFFICIENTS[camera.model])])}"
    yield "body_T_cam:"
    for row in camera.body_T_cam:
        yield f"  - {_numbers(row)}"
    if camera.line_time_us:
        yield f"{_LINE_TIME_KEY}: {_number(camera.line_time_us)}  # rolling shutter"
    if camera.stamp_offset_s:
        yield f"{_STAMP_OFFSET_KEY}: {_number(camera.stamp_offset_s)}  # is added to the stamps of its images"
    if camera.mask is not None:
        mask, home = camera.mask.resolve(), folder.resolve()
        yield f"mask: {_quoted(str(mask.relative_to(home) if mask.is_relative_to(home) else mask))}"


def _numbers(values: Iterable[float]) -> str:
    return "[" + ", ".join(_number(value) for value in values) + "]"


def _number(value: float) -> str:
    text = repr(float(value) + 0.0)  # the shortest text that reads back exactly; -0.0 is 0.0
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")  # YAML 1.1 reads 1e-05 as a string
    return text


def _quoted(text: str) -> str:
    """Quote a YAML string; characters that are not printable are escaped."""
    shown = [c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in text]
    return f'"{"".join(shown)}"'
