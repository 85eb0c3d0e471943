"""Options of the service: its address, and the clients that it accepts."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from pathlib import Path

from graphvio.errors import ServiceError

DEFAULT_PORT = 50551
RUN_KEY = "graphvio-run"  # key of a stream's initial metadata


@dataclass(frozen=True)
class ServiceOptions:
    """Options of the service.

    Raises:
        ServiceError: If a value is invalid, or a public address lacks TLS or a token.
    """

    # address to listen on: 127.0.0.1, or with TLS and a token another one, such as 0.0.0.0 for all
    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT  # TCP port; 0 for any free one
    certificate: Path | None = None  # PEM file with the server's certificate, followed by those that signed it
    key: Path | None = None  # PEM file with its private key, not encrypted
    token_file: Path | None = None  # file with the token that clients must send, readable by its owner only
    max_clients: int = 8  # maximal number of connections with open streams, of which each may have four
    keepalive_s: float = 10.0  # a client that does not answer for one and a half times as long is disconnected

    def __post_init__(self) -> None:
        if not 0 <= self.port < 2**16:
            raise ServiceError(f"serving: port {self.port} does not exist; choose from 1 to 65535, or 0 for any")
        if not 1 <= self.max_clients <= 256:
            raise ServiceError(f"serving: max_clients is {self.max_clients}; choose from 1 to 256")
        if not 1.0 <= self.keepalive_s <= 3600.0:
            raise ServiceError(f"serving: keepalive_s is {self.keepalive_s}; choose from 1 to 3600 seconds")
        if (self.certificate is None) != (self.key is None):
            given, missing = ("key", "certificate") if self.certificate is None else ("certificate", "key")
            raise ServiceError(f"serving: a TLS {given} is given without its {missing}; give both or neither")
        if not is_loopback(self.host) and (self.certificate is None or self.token_file is None):
            raise ServiceError(
                f"serving: {self.host} can be reached from other machines, so it needs a TLS certificate with its "
                "key and a token file; give all three, or listen on 127.0.0.1 and use an SSH tunnel"
            )

    @property
    def bare_host(self) -> str:
        """Host to listen on; ``localhost`` is 127.0.0.1 only."""
        return "127.0.0.1" if self.host == "localhost" else self.host

    @property
    def address(self) -> str:
        """``HOST:PORT`` as gRPC expects it; IPv6 in brackets."""
        host = self.bare_host
        return f"[{host}]:{self.port}" if ":" in host else f"{host}:{self.port}"


def is_loopback(host: str) -> bool:
    """Return whether a host is a loopback address; of names only ``localhost`` is, as others may be redefined."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
