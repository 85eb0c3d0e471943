"""The odometry as a gRPC service, described by ``graphvio.proto``; needs the extra ``serve``."""

from graphvio.errors import MissingExtraError

try:
    import google.protobuf  # noqa: F401
    import grpc
except ModuleNotFoundError as error:
    if (error.name or "").partition(".")[0] not in ("grpc", "google"):
        raise
    raise MissingExtraError("grpcio and protobuf", "serve", "serving keyframes, or using such a service") from None

from graphvio.slam.service import graphvio_pb2 as messages

__all__ = ["grpc", "messages"]
