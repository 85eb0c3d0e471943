"""Requests that are no messages: answered as what they are.

When a deserializer raises, grpcio tells the client, but keeps the stream (seen with 1.85): after a dozen such requests
the connection takes no more calls. So none raises here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from google.protobuf.message import DecodeError

from graphvio.slam.service.libraries import grpc

_MALFORMED = object()


class MalformedInterceptor(grpc.ServerInterceptor):  # type: ignore[misc]
    """Answers INVALID_ARGUMENT to what the proto does not describe."""

    def intercept_service(self, continuation: Callable[[Any], Any], details: Any) -> Any:
        """See `grpc.ServerInterceptor`."""
        handler = continuation(details)
        if handler is None or handler.request_streaming:
            return handler
        make = (
            grpc.unary_stream_rpc_method_handler if handler.response_streaming else grpc.unary_unary_rpc_method_handler
        )
        return make(
            _guarded(handler.unary_stream or handler.unary_unary),
            request_deserializer=_tolerant(handler.request_deserializer),
            response_serializer=handler.response_serializer,
        )


def _tolerant(deserialize: Callable[[bytes], Any]) -> Callable[[bytes], Any]:
    def deserialized(data: bytes) -> Any:
        try:
            return deserialize(data)
        except DecodeError:
            return _MALFORMED

    return deserialized


def _guarded(answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    def guarded(request: Any, context: Any) -> Any:
        if request is _MALFORMED:
            context.abort(grpc.StatusCode.INVALID_ARGUMENT, "the request is no message of this call; see the proto")
        return answer(request, context)

    return guarded
