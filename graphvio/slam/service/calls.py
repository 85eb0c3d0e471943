"""The calls of the proto's service, made from its descriptor: methods for clients, handlers for servers."""

from __future__ import annotations

from typing import Any

from google.protobuf.message_factory import GetMessageClass

from graphvio.slam.service import grpc, messages

_SERVICE = messages.DESCRIPTOR.services_by_name["FrontEnd"]


class Stub:
    """The service's calls through a channel as attributes, such as ``GetInfo``."""

    def __init__(self, channel: Any) -> None:
        for call in _SERVICE.methods:
            make = channel.unary_stream if call.server_streaming else channel.unary_unary
            method = make(
                f"/{_SERVICE.full_name}/{call.name}",
                request_serializer=GetMessageClass(call.input_type).SerializeToString,
                response_deserializer=GetMessageClass(call.output_type).FromString,
            )
            setattr(self, call.name, method)


def handlers(servicer: object) -> Any:
    """Return gRPC's handlers of all calls, which are answered by the servicer's methods of the same names."""
    made = {}
    for call in _SERVICE.methods:
        streaming = call.server_streaming
        make = grpc.unary_stream_rpc_method_handler if streaming else grpc.unary_unary_rpc_method_handler
        made[call.name] = make(
            getattr(servicer, call.name),
            request_deserializer=GetMessageClass(call.input_type).FromString,
            response_serializer=GetMessageClass(call.output_type).SerializeToString,
        )
    return grpc.method_handlers_generic_handler(_SERVICE.full_name, made)
