"""ROS 2 services as in `rmw_cyclonedds`: a topic for requests and one for responses, whose messages have a header."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from typing import Any, Final

from graphvio.errors import SessionError
from graphvio.ros2 import interfaces
from graphvio.ros2.node import Node, Reader, Writer
from graphvio.ros2.wire import Profile
from graphvio.sessions import cdr

PARAMETERS: Final = Profile(depth=1000)
"""Quality of service of the parameter services."""

_ENCAPSULATION_BYTES: Final = 4
_HEADER_BYTES: Final = 16
"""Size of the header after the encapsulation: the client's identity (uint64) and the number of the request (int64)."""
_MATCH_S: Final = 0.1
_POLL_S: Final = 0.005


class Service:
    """A service of a node; requests are answered in the thread that calls `take`.

    Args:
        node: node that provides the service.
        name: name of the service, such as ``/graphvio/list_parameters``.
        service: name of its type in ``rcl_interfaces/srv``.
        answer: returns the response to a request, both of rosbags' types.
    """

    def __init__(self, node: Node, name: str, service: str, answer: Callable[[Any], Any]) -> None:
        self._request_type, self._answer = interfaces.request_type(service), answer
        identity = f"serviceid={node.next_service_id()};"
        self.reader = Reader(node, f"{name}Request", self._request_type, PARAMETERS, prefix="rq", user_data=identity)
        self._writer = Writer(
            node, f"{name}Reply", interfaces.response_type(service), PARAMETERS, prefix="rr", user_data=identity
        )

    def take(self) -> None:
        """Answer the requests received since the last call; damaged ones are left out."""
        for data, writer in self.reader.take_with_writers():
            try:
                header, request = split_header(data)
                message = cdr.decode(request, self._request_type, self.reader.topic, interfaces.types())
            except SessionError:
                continue
            response = self._answer(message)
            self._wait_for_client(writer)
            self._writer.write_bytes(with_header(header, interfaces.encode(response)))

    def _wait_for_client(self, writer: int) -> None:
        """Wait until the client's reader is matched, at most 0.1 s; a response before that would be lost."""
        client = self.reader.user_data_of(writer).get("clientid")
        end_s = time.monotonic() + _MATCH_S
        while client is not None and time.monotonic() < end_s:
            if any(each.get("clientid") == client for each in self._writer.user_data_of_readers()):
                return
            time.sleep(_POLL_S)


def split_header(data: bytes) -> tuple[tuple[int, int], bytes]:
    """Split a request into its header (client's identity and number of the request) and the CDR message.

    Raises:
        SessionError: if the request is too short to have a header.
    """
    end = _ENCAPSULATION_BYTES + _HEADER_BYTES
    if len(data) < end:
        raise SessionError(f"a request of {len(data)} bytes has no header")
    client, number = struct.unpack("<Qq" if data[1] & 1 else ">Qq", data[_ENCAPSULATION_BYTES:end])
    return (client, number), data[:_ENCAPSULATION_BYTES] + data[end:]


def with_header(header: tuple[int, int], message: bytes) -> bytes:
    """Insert a header into a CDR message; its length of 16 bytes does not change the alignment of the fields."""
    packed = struct.pack("<Qq" if message[1] & 1 else ">Qq", *header)
    return message[:_ENCAPSULATION_BYTES] + packed + message[_ENCAPSULATION_BYTES:]
