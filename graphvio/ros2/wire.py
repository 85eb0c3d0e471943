"""ROS 2 in DDS: names of topics, types of topics made from rosbags' definitions, and qualities of service."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from graphvio.errors import importing
from graphvio.ros2 import interfaces
from graphvio.sessions import cdr


def require_dds() -> None:
    """Check that ``cyclonedds`` can be imported."""
    with importing("cyclonedds", "ros2", "ROS 2 topics"):
        import cyclonedds  # noqa: F401


def dds_type_name(type_name: str) -> str:
    """Convert a type such as ``sensor_msgs/msg/Image`` to its name in DDS, ``sensor_msgs::msg::dds_::Image_``."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type_name(dds_name: str) -> str | None:
    """Convert a type's name in DDS to its name in ROS, or to None if it is no ROS type."""
    parts = dds_name.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return None
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


def dds_topic(topic: str, prefix: str = "rt") -> str:
    """Convert a topic such as ``/imu`` to its name in DDS, ``rt/imu``; services have the prefixes ``rq`` and ``rr``."""
    return f"{prefix}/{topic.lstrip('/')}" if prefix else topic


def ros_topic(dds_name: str) -> str | None:
    """Convert a topic's name in DDS to its name in ROS, or to None if it is no ROS topic."""
    return dds_name[2:] if dds_name.startswith("rt/") else None


@dataclass(frozen=True, slots=True)
class Profile:
    """A quality of service, as in ROS 2 (`rmw_qos_profiles.h`)."""

    depth: int = 10  # how many of the newest samples are kept
    is_reliable: bool = True  # whether lost samples are sent again
    is_latched: bool = False  # whether late readers receive the kept samples, too (transient local)

    def dds(self, type_name: str, user_data: str = "") -> Any:
        """Return the DDS policies of an endpoint; with them, a writer never waits for slow readers.

        From Iron on ROS 2 expects the type's hash in the user data, after the entries of services; older versions
        ignore it.
        """
        from cyclonedds.qos import Policy, Qos

        return Qos(
            Policy.Reliability.Reliable(max_blocking_time=0) if self.is_reliable else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if self.is_latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(self.depth),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Userdata(f"{user_data}typehash={interfaces.types().hash_rihs01(type_name)};".encode()),
        )


DEFAULT = Profile()
SENSOR_DATA = Profile(depth=5, is_reliable=False)
TF = Profile(depth=100)
TF_STATIC = Profile(depth=1, is_latched=True)
"""Quality of service of publishers of static transforms, and of the discovery message of nodes."""
TF_STATIC_READER = Profile(depth=100, is_latched=True)
"""Quality of service of subscribers to static transforms, of which there may be several publishers."""


@cache
def idl_struct(type_name: str) -> Any:
    """Return cyclonedds' class for messages of a type, whose fields are Python lists and numbers."""
    return _make_type(type_name, ())


@cache
def wire_type(type_name: str) -> Any:
    """Return a topic's type whose samples are not decoded: ``wire_type(name)(data)`` is a sample with the CDR ``data``.

    cyclonedds would decode sequences element by element in Python, which takes 20 ms for an image of 640x480; rosbags'
    decoder returns views of the data, and its encoder gives the same bytes.
    """
    return _make_type(type_name, (_raw(),))


@cache
def _raw() -> Any:
    require_dds()
    from cyclonedds.idl import IdlStruct

    class Raw(IdlStruct):  # type: ignore[misc]
        """A sample that is not decoded."""

        def __init__(self, data: bytes) -> None:
            self.data = data

        def serialize(self, *_: Any, **__: Any) -> bytes:
            """Return the CDR bytes for the writer."""
            return self.data

        @classmethod
        def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Any:
            """Wrap the CDR bytes that the reader received."""
            return cls(data)

        @classmethod
        def deserialize_key(cls, data: bytes, *_: Any, **__: Any) -> Any:
            """Return None, since ROS's topics have no keys."""
            return None

    return Raw


def _make_type(type_name: str, bases: tuple[Any, ...]) -> Any:
    require_dds()
    from cyclonedds.idl import make_idl_struct, types

    _, fields = interfaces.types().fielddefs[type_name]
    header = {"guid": types.uint64, "seq": types.int64} if "/srv/" in type_name else {}
    return make_idl_struct(
        type_name.rpartition("/")[2],
        dds_type_name(type_name).replace("::", "."),
        {**header, **{field: _field(kind) for field, kind in fields}},
        dataclassify=not bases,
        bases=bases,
    )


def _field(kind: Any) -> Any:
    """Convert the description of a field's type from rosbags to cyclonedds."""
    from cyclonedds.idl import types

    kinds = cdr.node_types()
    node, what = kind
    if node == kinds.NAME:
        return idl_struct(what)
    if node == kinds.BASE:
        name, bound = what
        if name == "string":
            return types.bounded_str[bound] if bound else str
        return bool if name == "bool" else getattr(types, "uint8" if name in ("byte", "char") else name)
    of, count = what
    if node == kinds.ARRAY:
        return types.array[_field(of), count]
    return types.sequence[_field(of), count] if count else types.sequence[_field(of)]
