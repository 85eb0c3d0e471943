"""A client's connection to a server: channel, token and calls; gRPC's failures are raised as `ServiceError`."""

from __future__ import annotations

import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from graphvio.errors import ServiceError
from graphvio.slam.service import grpc
from graphvio.slam.service.calls import Stub
from graphvio.slam.service.options import DEFAULT_PORT, RUN_KEY, is_loopback
from graphvio.slam.service.security import bearer

_MAX_MESSAGE_BYTES = 256 * 2**20
_WINDOW_BYTES = 4096
_KEEPALIVE_MS, _PONG_MS = 10_000, 5_000
_FIRST_WAIT_S, _MAX_WAIT_S = 0.1, 2.0
_DIAGNOSIS_S = 3.0
_TOO_LARGE = "larger than max"


class Connection:
    """A connection to a server, which reopens broken streams.

    Raises:
        ServiceError: If the address is invalid, the certificates cannot be read, or the token would be sent
            unencrypted.
    """

    def __init__(
        self, address: str, ca: str | Path | None, token: str | None, timeout_s: float, patience_s: float
    ) -> None:
        self._host, self._port = _split(address)
        host = f"[{self._host}]" if ":" in self._host else self._host
        self.address = f"{host}:{self._port}"
        self._ca = None if ca is None else _read_certificates(Path(ca))
        if token is not None and ca is None and not is_loopback(self._host):
            raise ServiceError(f"{self.address}: the token would go through the network unencrypted; give a ca")
        self._metadata = () if token is None else (bearer(token),)
        self._timeout_s = timeout_s
        self._patience_s = patience_s
        self._closing = threading.Event()
        self._lock = threading.Lock()
        self._calls: set[Any] = set()
        options = _transport()
        if self._ca is None:
            self._channel = grpc.insecure_channel(self.address, options)
        else:
            self._channel = grpc.secure_channel(self.address, grpc.ssl_channel_credentials(self._ca), options)
        self.stub: Any = Stub(self._channel)

    def call(self, name: str, request: Any) -> Any:
        """Make a call, such as ``GetInfo``, and return the server's answer.

        Raises:
            ServiceError: If the call fails.
        """
        self._check_open()
        try:
            return getattr(self.stub, name)(request, timeout=self._timeout_s, metadata=self._metadata)
        except grpc.RpcError as error:
            raise self._error(error) from None

    def follow(self, name: str, next_request: Callable[[], Any]) -> Iterator[Any]:
        """Yield the messages of a stream until the server ends it; reopen it when it breaks.

        Raises:
            ServiceError: If the server refuses, or does not return within ``patience_s``.
        """
        self._check_open()
        broken_at: float | None = None
        wait_s = _FIRST_WAIT_S
        has_begun = False
        while True:
            call = self._open(name, next_request())
            if call is None:
                return
            try:
                if any(key == RUN_KEY for key, _ in call.initial_metadata() or ()):
                    has_begun, broken_at, wait_s = True, None, _FIRST_WAIT_S
                yield from call
                return
            except grpc.RpcError as error:
                if self._closing.is_set():
                    return
                broken_at = broken_at or time.monotonic()
                is_over = time.monotonic() - broken_at > self._patience_s
                if is_over or not _may_pass(error, has_begun):
                    raise self._error(error) from None
            finally:
                call.cancel()
                with self._lock:
                    self._calls.discard(call)
            self._closing.wait(wait_s)
            wait_s = min(2.0 * wait_s, _MAX_WAIT_S)

    def close(self) -> None:
        """End all streams and close the connection; thread-safe, and idempotent."""
        with self._lock:
            self._closing.set()
            calls = list(self._calls)
        for call in calls:
            call.cancel()
        self._channel.close()

    def _open(self, name: str, request: Any) -> Any | None:
        with self._lock:
            if self._closing.is_set():
                return None
            call = getattr(self.stub, name)(request, metadata=self._metadata)
            self._calls.add(call)
            return call

    def _check_open(self) -> None:
        if self._closing.is_set():
            raise ServiceError(f"{self.address}: this client is closed; make a new one")

    def _error(self, error: Any) -> ServiceError:
        code, details = error.code(), error.details() or ""
        if code is grpc.StatusCode.UNAVAILABLE and not self._closing.is_set():
            text = _why_unreachable(self._host, self._port, self._ca)
        elif code is grpc.StatusCode.UNAUTHENTICATED:
            text = f"{details}; give the one in the server's token file"
        elif code is grpc.StatusCode.DEADLINE_EXCEEDED:
            text = f"did not answer within {self._timeout_s:g} s; is the machine or the network overloaded?"
        elif code is grpc.StatusCode.UNIMPLEMENTED:
            text = "does not know this call; is it graphvio's service, and of the same version?"
        elif code is grpc.StatusCode.RESOURCE_EXHAUSTED and _TOO_LARGE in details:
            text = f"sent a message of more than {_MAX_MESSAGE_BYTES >> 20} MB; ask for keyframes without images"
        else:
            text = details or code.name.lower().replace("_", " ")
        return ServiceError(f"{self.address}: {text}")


def _may_pass(error: Any, has_begun: bool) -> bool:
    """Return whether reopening the stream may succeed."""
    code, details = error.code(), error.details() or ""
    if code is grpc.StatusCode.RESOURCE_EXHAUSTED:  # the server may still count the stream that has just broken
        return has_begun and _TOO_LARGE not in details
    is_broken = code in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED)
    return has_begun and (is_broken or "RST_STREAM" in details)


def _transport() -> list[tuple[str, int]]:
    return [
        ("grpc.max_receive_message_length", _MAX_MESSAGE_BYTES),
        # With gRPC's default window, which grows, a slow client would read data that is half a minute old.
        ("grpc.http2.lookahead_bytes", _WINDOW_BYTES),
        ("grpc.http2.bdp_probe", 0),
        ("grpc.enable_http_proxy", 0),  # robots are reached directly
        ("grpc.use_local_subchannel_pool", 1),  # one connection per client, not per process
        ("grpc.enable_retries", 0),
        ("grpc.initial_reconnect_backoff_ms", 200),
        ("grpc.min_reconnect_backoff_ms", 3_000),
        ("grpc.max_reconnect_backoff_ms", 2_000),
        ("grpc.keepalive_time_ms", _KEEPALIVE_MS),
        ("grpc.keepalive_timeout_ms", _PONG_MS),
        ("grpc.http2.ping_timeout_ms", _PONG_MS),  # else any other ping in flight delays this to a minute
        ("grpc.http2.max_pings_without_data", 0),
    ]


def _split(address: str) -> tuple[str, int]:
    host, colon, port = address.rpartition(":")
    if not colon or address.endswith("]"):
        host, port = address, str(DEFAULT_PORT)
    elif ":" in host and not host.startswith("["):
        host, port = "", ""
    host = host.strip("[]")
    if not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 2**16:
        raise ServiceError(f"{address!r}: is not an address; give HOST:PORT, an IPv6 host in brackets")
    return host, int(port)


def _read_certificates(path: Path) -> bytes:
    try:
        content = path.read_bytes()
        ssl.create_default_context(cadata=content.decode("ascii"))
    except (ssl.SSLError, ValueError):  # before OSError, which SSLError is, too
        raise ServiceError(f"{path}: holds no certificates; give a PEM file of those to be trusted") from None
    except OSError as error:
        raise ServiceError(f"{path}: cannot be read ({error.strerror}); give a PEM file of certificates") from None
    return content


def _why_unreachable(host: str, port: int, ca: bytes | None) -> str:
    """Connect without gRPC, whose messages name no remedy, and return what is wrong and how to correct it."""
    try:
        with socket.create_connection((host, port), _DIAGNOSIS_S) as connection:
            return _why_no_service(connection, host, ca)
    except ConnectionRefusedError:
        return "nothing listens there; is the service running, and the port right?"
    except socket.gaierror:
        return "there is no such host; check the name"
    except TimeoutError:
        return "it does not answer; is it switched on, and does a firewall let the port through?"
    except OSError as error:
        return f"it cannot be reached ({error.strerror or type(error).__name__}); check the address and the network"


def _why_no_service(connection: socket.socket, host: str, ca: bytes | None) -> str:
    try:
        with _context(ca).wrap_socket(connection, server_hostname=host):
            pass
    except ssl.SSLCertVerificationError as error:
        return (
            f"its certificate is not trusted ({error.verify_message.rstrip('.')}); give the certificate of its "
            "issuer as ca, and the server by a name that the certificate has"
        )
    except OSError:
        if ca is None:
            return "it does not answer as graphvio's service; check the port, or it may have too many clients"
        return "it does not use TLS, or is no graphvio service; check the port, or leave ca out on the same machine"
    if ca is None:
        return "it demands TLS; give the certificate of its issuer as ca"
    return "it closed the connection; it may have too many clients"


def _context(ca: bytes | None) -> ssl.SSLContext:
    if ca is None:  # only find out whether the server uses TLS
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    else:
        context = ssl.create_default_context(cadata=ca.decode("ascii", "replace"))
    context.set_alpn_protocols(["h2"])
    return context
