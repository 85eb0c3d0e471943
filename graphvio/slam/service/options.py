"""Where the service listens, and whom it lets in."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from pathlib import Path

from graphvio.errors import ServiceError

DEFAULT_PORT = 50551
RUN_KEY = "graphvio-run"  # metadata that a stream begins with: it is open, though its first message may come late


@dataclass(frozen=True)
class ServiceOptions:
    """How the service is offered.

    Attributes:
        host: address to listen on: 127.0.0.1, or another one, such as 0.0.0.0 for all, with TLS and a token.
        port: 0 takes any that is free.
        certificate: PEM file with the server's certificate, followed by those that signed it.
        key: PEM file with its private key, not encrypted.
        token_file: what clients have to know, in a file that only its owner can read.
        max_clients: connections that may have streams at a time; each has room for four.
        keepalive_s: a client that does not answer for so long, and half of it again, is taken for gone.

    Raises:
        ServiceError: if a value is not valid, or an address that others reach would be open to all.
    """

    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    certificate: Path | None = None
    key: Path | None = None
    token_file: Path | None = None
    max_clients: int = 8
    keepalive_s: float = 10.0

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
        """Where to listen; ``localhost`` is 127.0.0.1 only."""
        return "127.0.0.1" if self.host == "localhost" else self.host

    @property
    def address(self) -> str:
        """As gRPC takes it; IPv6 in brackets."""
        host = self.bare_host
        return f"[{host}]:{self.port}" if ":" in host else f"{host}:{self.port}"


def is_loopback(host: str) -> bool:
    """Whether only this machine is meant. Names but ``localhost`` are not: what they mean can change."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
