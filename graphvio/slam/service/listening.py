"""Whether an address can be listened on. gRPC would write lines of its own to the terminal if not."""

from __future__ import annotations

import socket

from graphvio.errors import ServiceError
from graphvio.slam.service.options import ServiceOptions


def check_address(options: ServiceOptions) -> None:
    """Find out by trying.

    Raises:
        ServiceError: if the address is taken or not this machine's.
    """
    try:
        found = socket.getaddrinfo(options.bare_host, options.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, kind, protocol, _, address in found:
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # one that has just been closed is free
                probe.bind(address)
    except OSError as error:
        raise cannot_listen(options, error.strerror or type(error).__name__) from None
    except ValueError:  # what cannot be a name
        raise cannot_listen(options, "no host's name") from None


def cannot_listen(options: ServiceOptions, reason: str) -> ServiceError:
    """What is raised."""
    return ServiceError(
        f"{options.address}: cannot be listened on ({reason}); choose a port that nobody uses, and an address of this "
        "machine"
    )
