"""Readers of calibration files: YAML mappings as sections, whose errors name the file and the key."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from graphvio.arrays import Float
from graphvio.errors import RigError
from graphvio.geometry import rotation_from_quat_wxyz
from graphvio.rig import Imu
from graphvio.wording import nearest

NOISE_KEYS = ("gyro_noise_density", "gyro_random_walk", "accel_noise_density", "accel_random_walk")
_MAX_NORM_ERROR = 1e-3
_DEFAULTS = {f.name: f.default for f in fields(Imu)}


@dataclass(frozen=True)
class Section:
    """A mapping in a YAML or JSON file."""

    values: Mapping[str, Any]  # the mapping
    file: Path  # the file that contains it
    key: str = ""  # full key of the mapping in the file, empty at the top level

    def where(self, key: str) -> str:
        """Return the file and the full key, for messages."""
        return f"{self.file}: {self.key}.{key}" if self.key else f"{self.file}: {key}"

    def only(self, known: Iterable[str]) -> None:
        """Raise an error if a key is not in ``known``; its message has a similar key that is, or all of them."""
        known = list(known)
        for key in self.values:
            if key not in known:
                hint = nearest(str(key), known) or f"; known here: {', '.join(known)}"
                raise RigError(f"{self.where(str(key))}: unknown key{hint}")

    def get(self, key: str) -> Any:
        """Get a required value."""
        if self.values.get(key) is None:
            raise RigError(f"{self.where(key)} is missing; add it")
        return self.values[key]

    def section(self, key: str) -> Section:
        """Get a required mapping."""
        return self.nested(self.get(key), key)

    def nested(self, value: object, key: str) -> Section:
        """Convert a value of this mapping to a section; ``key`` is the value's key, for messages."""
        if not isinstance(value, dict):
            raise RigError(f"{self.where(key)}: is {_shown(value)}; it must be a mapping of keys to values")
        return Section(value, self.file, f"{self.key}.{key}" if self.key else key)

    def text(self, key: str) -> str:
        """Get a required string."""
        value = self.get(key)
        if isinstance(value, dict | list):
            raise RigError(f"{self.where(key)}: is {_shown(value)}; it must be a text")
        if isinstance(value, bool):
            raise RigError(f"{self.where(key)}: is {value}, which YAML makes of yes, on, no and off; put it in quotes")
        return str(value)

    def model(self, key: str, known: Iterable[str]) -> str:
        """Get a required name of a camera or distortion model; it must be in ``known``."""
        name = self.text(key)
        if name not in known:
            raise RigError(f"{self.where(key)}: unknown model {name!r}; use one of {', '.join(known)}")
        return name

    def flag(self, key: str) -> bool:
        """Get a value that is true or false; false if it is not given."""
        value = self.values.get(key, False)
        if not isinstance(value, bool):
            raise RigError(f"{self.where(key)}: is {_shown(value)}; it must be true or false")
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """Get a number, which is required if there is no default."""
        if default is not None and self.values.get(key) is None:
            return default
        return float(self.array(key, ()))

    def array(self, key: str, shape: tuple[int, ...] | None = None) -> Float:
        """Get a required array of finite numbers; with ``shape`` None, of one dimension and any length."""
        value = self.get(key)
        if isinstance(value, bool):  # numpy would convert it to 1 or 0
            raise RigError(f"{self.where(key)}: is {_shown(value)}; it must hold numbers only")
        try:
            array = np.array(value, dtype=np.float64)  # converts '1e-5', which YAML 1.1 reads as a string
        except (TypeError, ValueError):
            raise RigError(f"{self.where(key)}: is {_shown(value)}; it must hold numbers only") from None
        if array.ndim != 1 if shape is None else array.shape != shape:
            wanted = "a list" if shape is None else f"of shape {shape}" if shape else "one number"
            raise RigError(f"{self.where(key)}: has shape {array.shape}; it must be {wanted}")
        if not np.isfinite(array).all():
            raise RigError(f"{self.where(key)}: holds NaN or infinity; write the calibrated value")
        return array

    def size(self, key: str) -> tuple[int, int]:
        """Get a required image size (width, height), pixels."""
        width, height = self.array(key, (2,))
        if width != int(width) or height != int(height):
            raise RigError(f"{self.where(key)}: is {_shown(self.get(key))}; it must be two whole numbers")
        return int(width), int(height)

    def matrix(self, key: str) -> Float:
        """Get a required (4, 4) matrix: four rows, 16 numbers by rows, or ``data`` of an OpenCV matrix."""
        value = self.get(key)
        if isinstance(value, dict):
            return self.section(key).matrix("data")
        if isinstance(value, list) and len(value) == 16:
            return self.array(key, (16,)).reshape(4, 4)
        return self.array(key, (4, 4))

    def rotation(self, quat_wxyz: Float, key: str) -> Float:
        """Convert a quaternion (4,) of this mapping to a rotation (3, 3); ``key`` is the quaternion's, for messages."""
        norm = float(np.linalg.norm(quat_wxyz))
        if abs(norm - 1.0) > _MAX_NORM_ERROR:
            raise RigError(f"{self.where(key)}: the quaternion's norm is {norm:.4g}; it must be 1")
        return rotation_from_quat_wxyz(quat_wxyz / norm)

    def noise(self, rate_key: str, keys: Mapping[str, str]) -> dict[str, Any]:
        """Get the rate and the noise densities of an IMU by the names that `graphvio.rig.Imu` has for them.

        Args:
            rate_key: key of the rate in the file.
            keys: name in `graphvio.rig.Imu` -> key in the file, of each density.

        Raises:
            RigError: if a value is missing; the message has graphvio's defaults, ready to be pasted.
        """
        names = {"rate_hz": rate_key, **keys}
        missing = [name for name, key in names.items() if self.values.get(key) is None]
        if missing:
            lines = ", ".join(f"{names[name]}: {_DEFAULTS[name]}" for name in missing)
            raise RigError(
                f"{self.where(names[missing[0]])} is missing"
                + (f" (and {len(missing) - 1} more)" if len(missing) > 1 else "")
                + f"; write what the IMU's data sheet says, or graphvio's default:  {lines}"
            )
        return {name: self.number(key) for name, key in names.items()}


class _UniqueKeys(yaml.SafeLoader):
    """YAML loader that raises an error if a mapping has a key twice; PyYAML would silently use the last one."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value} is there twice", key.start_mark)
            seen.add(key.value if isinstance(key, yaml.ScalarNode) else id(key))
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Section:
    """Read a YAML file, also in the dialects of Kalibr and OpenCV; an empty file gives an empty mapping.

    Raises:
        RigError: if the file cannot be read or is no mapping.
    """
    return parse_yaml(read_text(path), path)


def parse_yaml(text: str, path: Path) -> Section:
    """Parse the text of a YAML file, see `read_yaml`."""
    text = re.sub(r"^%.*$", "", text, flags=re.MULTILINE)  # OpenCV's `%YAML:1.0` is no valid directive
    text = text.replace("!!opencv-matrix", "")
    try:
        values = yaml.load(text, _UniqueKeys)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or str(error).split("\n")[0]
        raise RigError(f"{path}:{line} is not valid YAML ({problem}); correct it there") from None
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise RigError(f"{path}: holds {_shown(values)}; a calibration file must be a mapping of keys to values")
    return Section(values, path)


def read_text(path: Path) -> str:
    """Read a text file."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise RigError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except UnicodeDecodeError:
        raise RigError(
            f"{path}: is no text file; give a calibration file (rig.yaml, Kalibr, Basalt, EuRoC, KITTI)"
        ) from None


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Prefix a `RigError` that is raised in the context with the file's path."""
    try:
        yield
    except RigError as error:
        if str(error).startswith(str(path)):
            raise
        raise RigError(f"{path}: {error}") from None


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
