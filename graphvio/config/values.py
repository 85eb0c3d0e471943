"""Checks of the types and ranges of configuration values, and construction of dataclasses from mappings."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_type_hints

from graphvio.errors import ConfigError
from graphvio.wording import nearest

_MAX_VALUE = 1e12
_MAY_BE_ZERO = frozenset(
    ("seed", "border_px", "keyframe_overlap", "min_inlier_share", "min_response",
     "scarce_share", "min_correlation", "max_gated_s", "simultaneous_ms", "max_imu_wait_ms", "max_imu_start_wait_s",
     "shared_error_share", "calibration_error_share")
)  # fmt: skip
_RANGES = {"cells_across": (2, 100), "window_px": (5, 63), "levels": (1, 8), "min_inliers": (3, 1000)}
_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")
_SHARES = ("_share", "_overlap", "_probability", "_correlation", "confidence")


class StageConfig:
    """Base class of a stage's configuration: a frozen dataclass whose values are checked when it is constructed."""

    def __post_init__(self) -> None:
        """Check all values.

        Raises:
            ConfigError: if a value is not valid; the message names it.
        """
        for name, hint in get_type_hints(type(self)).items():
            value = checked(hint, getattr(self, name), f"{type(self).__name__}: {name}")
            object.__setattr__(self, name, value)  # 12.0 is stored as 12: equal configurations have equal digests


def build(kind: type[Any], data: object, where: str) -> Any:
    """Build a dataclass from a mapping of names to values; missing values keep their default.

    Args:
        kind: the dataclass.
        data: the mapping, as read from a file.
        where: where the mapping was read, such as a file's path; for error messages.

    Raises:
        ConfigError: if ``data`` is no mapping, or a key or value is not valid.
    """
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where}: must be a mapping of names to values, not {type(data).__name__}")
    hints = get_type_hints(kind)
    names = [f.name for f in fields(kind)]
    values = {}
    for key, value in data.items():
        if key not in names:
            hint = nearest(str(key), names) or "; graphvio dump-config shows all"
            raise ConfigError(f"{where}: unknown key {key!r}{hint}")
        hint, here = hints[key], f"{where}: {key}"
        if is_dataclass(hint):
            values[key] = build(hint, {} if value is None else value, here)  # type: ignore[arg-type]
        else:
            values[key] = checked(hint, _number_of_text(value), here)
    return kind(**values)


def checked(hint: Any, value: object, where: str) -> object:
    """Check a value's type and range, and convert it to its type.

    Args:
        hint: the type: bool, int, float, a ``Literal``, or one of these or None.
        value: the value, as read from a file or passed to the constructor.
        where: where the value was read, for error messages; the last word is the value's name, which determines the
            range.

    Returns:
        The value, of the type ``hint``.

    Raises:
        ConfigError: if the value is of another type, or out of the range that its name implies.
    """
    choices = get_args(hint)
    if type(None) in choices:
        if value is None:
            return None
        (hint,) = (each for each in choices if each is not type(None))
        choices = get_args(hint)
    if choices:
        if value not in choices:
            raise ConfigError(f"{where}: is {value!r}; choose one of {', '.join(map(str, choices))}")
        return value
    if hint is bool:
        if not isinstance(value, bool):
            raise ConfigError(f"{where}: is {value!r}; it must be true or false")
        return value
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ConfigError(f"{where}: is {value!r}; it must be a number")
    if not 0 <= value <= _MAX_VALUE:  # also rejects NaN
        raise ConfigError(f"{where}: is {value!r}; it must be finite and not negative")
    name = where.rsplit(" ", 1)[-1]
    if value == 0 and name not in _MAY_BE_ZERO:
        raise ConfigError(f"{where}: is 0; it must be positive")
    lowest, highest = _RANGES.get(name, (0, _MAX_VALUE))
    if not lowest <= value <= highest:
        raise ConfigError(f"{where}: is {value!r}; choose from {lowest} to {highest}")
    if name.endswith(_SHARES) and value > 1:
        raise ConfigError(f"{where}: is {value!r}; a share or probability is at most 1")
    if hint is float:
        return float(value)
    if value != int(value):
        raise ConfigError(f"{where}: is {value!r}; it must be a whole number")
    return int(value)


def _number_of_text(value: object) -> object:
    """Convert text such as 1e-9, which YAML does not read as a number; other text, such as "12", stays text."""
    return float(value) if isinstance(value, str) and _EXPONENT.fullmatch(value) else value
