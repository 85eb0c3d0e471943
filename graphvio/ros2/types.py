"""ROS 2 message types as DDS has them, made from the definitions that rosbags carries."""

from __future__ import annotations

from functools import cache
from typing import Any

from graphvio.errors import MissingExtraError
from graphvio.sessions import cdr

_PURPOSE = "ROS 2 topics"


def dds() -> Any:
    """The package ``cyclonedds``.

    Raises:
        MissingExtraError: if the extra ``ros2`` is not installed.
    """
    try:
        import cyclonedds
    except ImportError:
        raise MissingExtraError("cyclonedds", "ros2", _PURPOSE) from None
    return cyclonedds


def dds_type_name(type_name: str) -> str:
    """What ROS 2 calls a type such as ``sensor_msgs/msg/Image`` on the wire: ``sensor_msgs::msg::dds_::Image_``."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type_name(dds_name: str) -> str | None:
    """The type that a name on the wire means, or None if it is not ROS's."""
    parts = dds_name.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return None
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


def dds_topic(topic: str) -> str:
    """What ROS 2 calls a topic such as ``/imu`` on the wire: ``rt/imu``."""
    return f"rt/{topic.lstrip('/')}"


def ros_topic(dds_name: str) -> str | None:
    """The topic that a name on the wire means, or None if it is none of ROS's topics."""
    return dds_name[2:] if dds_name.startswith("rt/") else None


@cache
def idl_struct(type_name: str) -> Any:
    """The type as cyclonedds has types: a class of messages whose fields are Python's lists and numbers."""
    return _made(type_name, ())


@cache
def wire_type(type_name: str) -> Any:
    """The type of a topic whose samples stay CDR: ``wire_type(name)(data)`` is one, and its ``data`` what came.

    cyclonedds takes sequences apart element by element in Python, 20 ms for an image of 640x480; rosbags' decoder makes
    arrays that are views of the data, and it makes the same bytes (a test).
    """
    return _made(type_name, (_raw(),))


@cache
def _raw() -> Any:
    dds()
    from cyclonedds.idl import IdlStruct

    class Raw(IdlStruct):  # type: ignore[misc]
        """A sample that is handed over as it is on the wire."""

        def __init__(self, data: bytes) -> None:
            self.data = data

        def serialize(self, *_: Any, **__: Any) -> bytes:
            """What the writer sends."""
            return self.data

        @classmethod
        def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Any:
            """What the reader makes of what came."""
            return cls(data)

        @classmethod
        def deserialize_key(cls, data: bytes, *_: Any, **__: Any) -> Any:
            """ROS's topics have no keys."""
            return None

    return Raw


def _made(type_name: str, bases: tuple[Any, ...]) -> Any:
    dds()
    from cyclonedds.idl import make_idl_struct

    _, fields = cdr.types().fielddefs[type_name]
    name = dds_type_name(type_name)
    return make_idl_struct(
        type_name.rpartition("/")[2],
        name.replace("::", "."),
        {field: _field(kind) for field, kind in fields},
        dataclassify=not bases,
        bases=bases,
    )


def _field(kind: Any) -> Any:
    """The type of a field, from rosbags' to cyclonedds'."""
    from cyclonedds.idl import types
    from rosbags.interfaces import Nodetype

    node, what = kind
    if node == Nodetype.NAME:
        return idl_struct(what)
    if node == Nodetype.BASE:
        name, bound = what
        if name == "string":
            return types.bounded_str[bound] if bound else str
        return bool if name == "bool" else getattr(types, "uint8" if name == "byte" else name)
    of, count = what
    if node == Nodetype.ARRAY:
        return types.array[_field(of), count]
    return types.sequence[_field(of), count] if count else types.sequence[_field(of)]
