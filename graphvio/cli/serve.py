"""``graphvio serve``: runs the odometry on live sensors and serves its results to other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from graphvio.cli import options


def serve(
    source: options.LiveSource,
    asked: options.LiveOptions,
    host: Annotated[str, typer.Option("--host", help="Address of gRPC; others need TLS and a token.")] = "127.0.0.1",
    port: Annotated[
        int | None, typer.Option("--port", help="Port of gRPC; 0 takes any.  [default: 50551]", min=0, max=65535)
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option("--tls-cert", help="PEM file of the server's certificate.", metavar="FILE")
    ] = None,
    key: Annotated[Path | None, typer.Option("--tls-key", help="PEM file of its private key.", metavar="FILE")] = None,
    token_file: Annotated[
        Path | None,
        typer.Option("--token-file", help="Secret of the clients, in a file only you can read.", metavar="FILE"),
    ] = None,
    ros2: options.Ros2Domain = None,
    web: options.WebPort = None,
) -> None:
    """Run the odometry on live sensors and serve estimates and keyframes by gRPC, by ROS 2 topics and to browsers.

    Clients can send corrections back. Without TLS and a token, only clients on this machine are served.

    Examples:

        graphvio serve simulator

        graphvio serve realsense --ros2 0 --web 9090

        graphvio serve oak --host 0.0.0.0 --tls-cert cert.pem --tls-key key.pem --token-file token
    """
    from graphvio.cli.live_run import run_live
    from graphvio.cli.services import Services
    from graphvio.slam.service.options import DEFAULT_PORT, ServiceOptions

    grpc = ServiceOptions(host, DEFAULT_PORT if port is None else port, certificate, key, token_file)
    run_live(source, asked, Services(grpc, ros2, web))
