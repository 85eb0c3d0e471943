"""A node's read-only parameters, and the responses of its parameter services."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any, Final

import numpy as np

from graphvio.ros2.interfaces import make, response_type

Value = bool | int | float | str | Sequence[float]

SERVICES: Final = {
    "list_parameters": "ListParameters",
    "get_parameters": "GetParameters",
    "get_parameter_types": "GetParameterTypes",
    "describe_parameters": "DescribeParameters",
    "set_parameters": "SetParameters",
    "set_parameters_atomically": "SetParametersAtomically",
}
"""Name of each parameter service below the node's name -> its type in ``rcl_interfaces/srv``."""

_SEPARATOR: Final = "."


class _Kind(IntEnum):
    """Types of parameters, with the numbers of ``rcl_interfaces/ParameterType``."""

    NOT_SET = 0
    BOOL = 1
    INTEGER = 2
    DOUBLE = 3
    STRING = 4
    DOUBLE_ARRAY = 8


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Value]:
    """Flatten nested values to parameters of ROS 2, whose names have dots; values that are None are left out."""
    flat: dict[str, Value] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{prefix}{name}{_SEPARATOR}"))
        elif value is not None:
            flat[prefix + name] = value
    return flat


class Parameters:
    """Answers the requests of parameter services; requests to set a parameter are refused."""

    def __init__(self, values: Mapping[str, Value]) -> None:
        self._values = dict(sorted(values.items()))

    def answer(self, service: str, request: Any) -> Any:
        """Return the response to a request; ``service`` is its type, such as ``ListParameters``."""
        values = self._values
        match service:
            case "ListParameters":
                fields: dict[str, Any] = {"result": self._list(request.prefixes, request.depth)}
            case "GetParameters":
                fields = {"values": [_message(values.get(name)) for name in request.names]}
            case "GetParameterTypes":
                fields = {"types": np.array([_kind(values.get(name)) for name in request.names], dtype=np.uint8)}
            case "DescribeParameters":
                fields = {"descriptors": [_descriptor(name, values.get(name)) for name in request.names]}
            case "SetParameters":
                fields = {"results": [self._refusal([each.name]) for each in request.parameters]}
            case _:
                fields = {"result": self._refusal([each.name for each in request.parameters])}
        return make(response_type(service), **fields)

    def _list(self, prefixes: Sequence[str], depth: int) -> Any:
        """List the names that equal a prefix, or are at most ``depth`` levels below one; 0 is any number of levels."""
        names = []
        for name in self._values:
            below = [name[len(each) + 1 :] for each in prefixes if name.startswith(each + _SEPARATOR)]
            below += [] if prefixes else [name]
            if name in prefixes or any(depth == 0 or each.count(_SEPARATOR) < depth for each in below):
                names.append(name)
        parents = {name.rpartition(_SEPARATOR)[0] for name in names} - {""}
        return make("rcl_interfaces/msg/ListParametersResult", names=names, prefixes=sorted(parents))

    def _refusal(self, names: Sequence[str]) -> Any:
        unknown = [name for name in names if name not in self._values]
        reason = f"{unknown[0]}: no such parameter" if unknown else f"{', '.join(names)}: read-only while the node runs"
        return make("rcl_interfaces/msg/SetParametersResult", successful=False, reason=reason)


def _kind(value: Value | None) -> _Kind:
    if value is None:
        return _Kind.NOT_SET
    for of, kind in ((bool, _Kind.BOOL), (int, _Kind.INTEGER), (float, _Kind.DOUBLE), (str, _Kind.STRING)):
        if isinstance(value, of):
            return kind
    return _Kind.DOUBLE_ARRAY


def _message(value: Value | None) -> Any:
    """Make a ``rcl_interfaces/ParameterValue``."""
    kind = _kind(value)
    return make(
        "rcl_interfaces/msg/ParameterValue",
        type=int(kind),
        bool_value=value if kind == _Kind.BOOL else False,
        integer_value=value if kind == _Kind.INTEGER else 0,
        double_value=value if kind == _Kind.DOUBLE else 0.0,
        string_value=value if kind == _Kind.STRING else "",
        byte_array_value=np.zeros(0, np.uint8),
        bool_array_value=np.zeros(0, np.bool_),
        integer_array_value=np.zeros(0, np.int64),
        double_array_value=np.array(value if kind == _Kind.DOUBLE_ARRAY else [], dtype=np.float64),
        string_array_value=[],
    )


def _descriptor(name: str, value: Value | None) -> Any:
    """Make a ``rcl_interfaces/ParameterDescriptor``."""
    return make(
        "rcl_interfaces/msg/ParameterDescriptor",
        name=name,
        type=int(_kind(value)),
        description="",
        additional_constraints="",
        read_only=value is not None,
        dynamic_typing=False,
        floating_point_range=[],
        integer_range=[],
    )
