"""Why a server cannot be reached: gRPC's own words name no remedy."""

from __future__ import annotations

import socket
import ssl

_TIMEOUT_S = 3.0


def why_unreachable(host: str, port: int, ca: bytes | None) -> str:
    """Try again by hand, and tell what is wrong and what to do.

    Args:
        host: of the server.
        port: of the server.
        ca: certificates in PEM that the client trusts, or None if it uses no TLS.
    """
    try:
        with socket.create_connection((host, port), _TIMEOUT_S) as connection:
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
            f"its certificate is not trusted ({error.verify_message.rstrip('.')}); give the certificate of whoever "
            "signed it as ca, and the server by a name that the certificate has"
        )
    except OSError:
        if ca is None:
            return "it does not answer as graphvio's service; check the port, or it may have too many clients"
        return "it does not use TLS, or is no graphvio service; check the port, or leave ca out on the same machine"
    if ca is None:
        return "it demands TLS; give the certificate of whoever signed its own as ca"
    return "it closed the connection; it may have too many clients"


def _context(ca: bytes | None) -> ssl.SSLContext:
    if ca is None:  # whether there is TLS at all is asked; nothing is sent
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    else:
        context = ssl.create_default_context(cadata=ca.decode("ascii", "replace"))
    context.set_alpn_protocols(["h2"])
    return context
