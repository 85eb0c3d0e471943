"""Conversion of ROS 1 messages from and to those of ROS 2: headers have a sequence number, and some names differ."""

from __future__ import annotations

from functools import cache
from typing import Any

from graphvio.sessions import cdr
from graphvio.sessions.messages import CAMERA_INFO, LOG, TRANSFORMS

_HEADER, _OLD_LOG = "std_msgs/msg/Header", "rosgraph_msgs/msg/Log"
_OLD_LEVELS = {10: 1, 20: 2, 30: 4, 40: 8, 50: 16}


@cache
def types() -> Any:
    """Return the types of ROS 1 (Noetic), with that of ``tf_static``."""
    made = cdr.typestore("ROS1_NOETIC")
    from rosbags.typesys import get_types_from_msg

    made.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    return made


def type_name(name: str) -> str:
    """Return the type of ROS 1 that corresponds to one of ROS 2."""
    return _OLD_LOG if name == LOG else name


def modern(message: Any) -> Any:
    """Convert a ROS 1 message to that of ROS 2, whose fields have lower-case names."""
    if isinstance(message, list):
        return [modern(each) for each in message]
    name = getattr(message, "__msgtype__", None)
    if name is None:
        return message
    fields = {key.lower(): value for key, value in vars(message).items() if key != "__msgtype__"}
    if name == _HEADER:
        fields.pop("seq", None)
    return cdr.make(name, **{key: modern(value) for key, value in fields.items()})


def encode(message: Any, number: int) -> bytes:
    """Serialise a ROS 2 message as that of ROS 1; headers get ``number``, the message's number in its topic."""
    old = _old_log(message, number) if message.__msgtype__ == LOG else _old(message, number)
    return bytes(types().serialize_ros1(old, old.__msgtype__))


def stamp_ns(data: bytes) -> int:
    """Return the stamp of a message that begins with a header, without decoding the other fields."""
    return int.from_bytes(data[4:8], "little") * 1_000_000_000 + int.from_bytes(data[8:12], "little")


def _old(message: Any, number: int) -> Any:
    if isinstance(message, list):
        return [_old(each, number) for each in message]
    name = getattr(message, "__msgtype__", None)
    if name is None:
        return message
    fields = {key: _old(value, number) for key, value in vars(message).items() if key != "__msgtype__"}
    if name == _HEADER:
        fields["seq"] = number
    if name == CAMERA_INFO:
        fields = {key.upper() if len(key) == 1 else key: value for key, value in fields.items()}
    return types().types[name](**fields)


def _old_log(message: Any, number: int) -> Any:
    made = types().types
    return made[_OLD_LOG](
        header=made[_HEADER](seq=number, stamp=_old(message.stamp, number), frame_id=""),
        level=_OLD_LEVELS[message.level],
        name=message.name,
        msg=message.msg,
        file=message.file,
        function=message.function,
        line=message.line,
        topics=[],
    )
