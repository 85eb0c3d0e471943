"""Security of the service: tokens, certificates and checks of requests."""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import ssl
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

from google.protobuf.message import DecodeError

from graphvio.errors import ServiceError
from graphvio.slam.service import grpc
from graphvio.slam.service.options import ServiceOptions

TOKEN_KEY = "authorization"
_MALFORMED = object()
_TOKEN = re.compile(r"[!-~]{16,4096}")


def bearer(token: str) -> tuple[str, str]:
    """Return the metadata that a client sends with its calls, as key and value."""
    return (TOKEN_KEY, f"Bearer {token}")


def read_token(path: str | Path) -> str:
    """Read the token in a file.

    Raises:
        ServiceError: If the file cannot be read, is readable by others than its owner, or holds no token.
    """
    text = _read_private(Path(path), "token", stat.S_IRWXG | stat.S_IRWXO).decode("utf-8", "replace").strip()
    if not _TOKEN.fullmatch(text):
        raise ServiceError(
            f"{path}: is no token: one line of 16 to 4096 printable ASCII characters without spaces; make one with  "
            f"(umask 077; openssl rand -hex 32 > {path})"
        )
    return text


def server_credentials(options: ServiceOptions) -> Any | None:
    """Return gRPC's credentials for a server with TLS, or None without TLS.

    Raises:
        ServiceError: If certificate or key cannot be read, do not match, or the key is readable by all.
    """
    if options.certificate is None or options.key is None:
        return None
    key = _read_private(options.key, "TLS key", stat.S_IRWXO)
    try:
        certificate = options.certificate.read_bytes()
        # gRPC accepts anything here, and fails at each client. Without a password OpenSSL asks at the terminal.
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(options.certificate, options.key, password="")
    except (OSError, ssl.SSLError) as error:
        raise ServiceError(
            f"{options.certificate}, {options.key}: are no TLS certificate and key ({_reason(error)}); give PEM files "
            "that belong to each other, the key without a password"
        ) from None
    return grpc.ssl_server_credentials([(key, certificate)])


def token_interceptor(token: str) -> Any:
    """Return an interceptor that refuses every call without the token, even of methods that do not exist."""

    def refuse(_: Any, context: Any) -> Any:
        return context.abort(grpc.StatusCode.UNAUTHENTICATED, "the token is missing or wrong")

    # A stream of requests: for a single request, a thread would wait until the client sends it.
    refusal = grpc.stream_stream_rpc_method_handler(refuse)
    expected = _digest(bearer(token)[1])

    class TokenInterceptor(grpc.ServerInterceptor):  # type: ignore[misc]
        def intercept_service(self, continuation: Callable[[Any], Any], details: Any) -> Any:
            given = [value for name, value in details.invocation_metadata if name == TOKEN_KEY]
            is_known = len(given) == 1 and hmac.compare_digest(_digest(given[0]), expected)
            return continuation(details) if is_known else refusal

    return TokenInterceptor()


class MalformedInterceptor(grpc.ServerInterceptor):  # type: ignore[misc]
    """Answers INVALID_ARGUMENT to requests that cannot be parsed.

    When a deserializer raises, grpcio answers, but keeps the stream open (seen with 1.85): after a dozen such requests,
    the connection accepts no more calls. So the deserializers do not raise here.
    """

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
            context.abort(grpc.StatusCode.INVALID_ARGUMENT, "the request is not a message of this call; see the proto")
        return answer(request, context)

    return guarded


def _digest(text: str | bytes) -> bytes:
    """Return a digest, so that the time of a comparison does not depend on the token's length."""
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).digest()


def _read_private(path: Path, what: str, forbidden: int) -> bytes:
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            if mode & forbidden:
                raise ServiceError(
                    f"{path}: the {what} can be read or changed by other users (mode {stat.S_IMODE(mode):03o}); "
                    f"run  chmod 600 {path}"
                )
            return file.read(2**20)
    except OSError as error:
        raise ServiceError(f"{path}: the {what} cannot be read ({error.strerror}); check the path") from None


def _reason(error: OSError | ssl.SSLError) -> str:
    if isinstance(error, ssl.SSLError):
        return (error.reason or "not PEM").lower().replace("_", " ")
    return error.strerror or type(error).__name__
