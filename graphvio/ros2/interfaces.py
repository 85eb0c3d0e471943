"""ROS 2 types: messages, the parameter services, and the discovery message by which nodes are announced."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cache
from typing import Any, Final

import numpy as np

from graphvio.sessions import cdr

DISCOVERY: Final = "rmw_dds_common/msg/ParticipantEntitiesInfo"
DISCOVERY_TOPIC: Final = "ros_discovery_info"
"""Name of the topic in DDS, which has no prefix."""

_LONG_GIDS: Final = ("foxy", "galactic", "humble")
_SERVICES: Final = {
    "ListParameters": ("string[] prefixes\nuint64 depth", "rcl_interfaces/ListParametersResult result"),
    "GetParameters": ("string[] names", "rcl_interfaces/ParameterValue[] values"),
    "GetParameterTypes": ("string[] names", "uint8[] types"),
    "DescribeParameters": ("string[] names", "rcl_interfaces/ParameterDescriptor[] descriptors"),
    "SetParameters": (
        "rcl_interfaces/Parameter[] parameters",
        "rcl_interfaces/SetParametersResult[] results",
    ),
    "SetParametersAtomically": (
        "rcl_interfaces/Parameter[] parameters",
        "rcl_interfaces/SetParametersResult result",
    ),
}


def request_type(service: str) -> str:
    """Return the type of a service's requests, such as ``rcl_interfaces/srv/ListParameters_Request``."""
    return f"rcl_interfaces/srv/{service}_Request"


def response_type(service: str) -> str:
    """Return the type of a service's responses."""
    return f"rcl_interfaces/srv/{service}_Response"


@cache
def types() -> Any:
    """Return the type store of rosbags for the distribution in ``ROS_DISTRO``.

    Sensor messages are the same in all distributions; identifiers of endpoints (Gid) have 24 bytes until Humble, and 16
    after it.
    """
    is_long = os.environ.get("ROS_DISTRO", "") in _LONG_GIDS
    store = cdr.typestore("ROS2_HUMBLE" if is_long else "ROS2_JAZZY")
    for service, (request, response) in _SERVICES.items():
        cdr.add_type(store, request_type(service), request)
        cdr.add_type(store, response_type(service), response)
    return store


def make(type_name: str, **fields: Any) -> Any:
    """Create a message, a request or a response of a type from its fields."""
    return types().types[type_name](**fields)


def encode(message: Any) -> bytes:
    """Encode a message as CDR."""
    return bytes(types().serialize_cdr(message, message.__msgtype__))


def entities(participant: bytes, name: str, readers: Sequence[bytes], writers: Sequence[bytes]) -> Any:
    """Make the discovery message of a participant with one node.

    Args:
        participant: identifier of the participant, 16 bytes.
        name: name of the node, such as ``/robot/graphvio``.
        readers: identifiers of the node's readers, 16 bytes each.
        writers: identifiers of the node's writers, 16 bytes each.
    """
    namespace, _, base = name.rpartition("/")
    node = make(
        "rmw_dds_common/msg/NodeEntitiesInfo",
        node_namespace=namespace or "/",
        node_name=base,
        reader_gid_seq=[_gid(each) for each in readers],
        writer_gid_seq=[_gid(each) for each in writers],
    )
    return make(DISCOVERY, gid=_gid(participant), node_entities_info_seq=[node])


def _gid(identifier: bytes) -> Any:
    _, ((_, (_, (_, size))),) = types().fielddefs["rmw_dds_common/msg/Gid"]
    return make("rmw_dds_common/msg/Gid", data=np.frombuffer(identifier.ljust(size, b"\0"), np.uint8))
