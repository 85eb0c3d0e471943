"""ROS 2 message types and their encoding (CDR), without ROS."""

from __future__ import annotations

from functools import cache
from typing import Any

from graphvio.errors import SessionError, importing


def typestore(name: str) -> Any:
    """Return the types of a ROS distribution, by its name in rosbags' ``Stores``."""
    with importing("rosbags", "sessions", "reading or writing a session"):
        from rosbags.typesys import Stores, get_typestore
    return get_typestore(Stores[name])


@cache
def types() -> Any:
    """Return the types of ROS 2 (Humble)."""
    return typestore("ROS2_HUMBLE")


def add_type(store: Any, name: str, text: str) -> None:
    """Add a type, such as a service's request, to those of a distribution, given the text of its definition."""
    from rosbags.typesys import get_types_from_msg

    (fields,) = get_types_from_msg(text, name).values()  # the key, the library's own name, always has "msg" in it
    store.register({name: fields})


def node_types() -> Any:
    """Return rosbags' kinds of fields: ``BASE``, ``NAME``, ``ARRAY`` and ``SEQUENCE``."""
    from rosbags.interfaces import Nodetype

    return Nodetype


def make(type_name: str, **fields: Any) -> Any:
    """Create a message of a type such as ``sensor_msgs/msg/Image``."""
    return types().types[type_name](**fields)


def encode(message: Any) -> bytes:
    """Encode a message as CDR."""
    return bytes(types().serialize_cdr(message, message.__msgtype__))


def decode(data: bytes, type_name: str, where: object = "a message", known: Any = None) -> Any:
    """Decode a message from CDR; its arrays are views of the data.

    ``where`` names the message's origin for errors; ``known`` are rosbags' types, those of `types` by default.

    Raises:
        SessionError: if the message is damaged.
    """
    known = types() if known is None else known
    try:
        return known.deserialize_cdr(data, type_name)
    except Exception as error:  # the library raises errors of many types for damaged bytes
        why = str(error) or type(error).__name__
        raise SessionError(f"{where}: holds a damaged {type_name} ({why}); copy the file again") from None


def definition(type_name: str) -> bytes:
    """Return the text of a type and of the types of its fields, as in MCAP's ``ros2msg`` schemas."""
    text, _ = types().generate_msgdef(type_name, ros_version=2)
    return str(text).encode()


def stamp_ns(data: bytes) -> int:
    """Return the stamp of a message that begins with a header, without decoding the other fields.

    Raises:
        SessionError: if the message is too short to have a header.
    """
    if len(data) < 12:
        raise SessionError(f"a message of {len(data)} bytes has no header; copy the file again")
    order: Any = "little" if data[1] & 1 else "big"
    return int.from_bytes(data[4:8], order, signed=True) * 1_000_000_000 + int.from_bytes(data[8:12], order)
