"""Services of a live run for other programs: gRPC, ROS 2 topics and a page for browsers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from contextlib import ExitStack

    from graphvio.config import Config
    from graphvio.live.running import LiveOdometry
    from graphvio.slam.service.options import ServiceOptions
    from graphvio.slam.service.server import GrpcServer

_SOON_S = 0.5  # if clients have read everything by then, no message is printed


@dataclass(frozen=True)
class Started:
    """Services that have been started."""

    address: str  # address of gRPC
    lines: Sequence[str]  # lines to print, one for each service
    check: Callable[[], None] = lambda: None  # raises the error of a service that failed
    # waits for services that continue after the odometry, and returns whether they completed
    finish: Callable[[], bool] = lambda: True


@dataclass(frozen=True)
class Services:
    """The choice of services, and the options of gRPC, such as who may connect."""

    grpc: ServiceOptions
    ros2_domain: int | None = None  # domain of the ROS 2 topics, or None for none
    web_port: int | None = None  # port of the page for browsers, or None for none

    def settings(self, config: Config) -> Config:
        """Return the configuration with images in keyframes; each client chooses what is sent to it."""
        return replace(config, keyframes=replace(config.keyframes, images=True))

    def check(self) -> None:
        """Raise the error of a service that cannot run, before sensors are started."""
        from graphvio.slam.service.server import check

        check(self.grpc)
        if self.ros2_domain is not None:
            from graphvio.ros2.publisher import Publisher  # noqa: F401

    def start(self, running: LiveOdometry, stack: ExitStack, is_stopped: Callable[[], bool] = lambda: False) -> Started:
        """Start the services of an odometry, which run until the stack closes.

        A subclass that has to wait for a service raises `KeyboardInterrupt` if ``is_stopped`` returns True meanwhile.
        """
        from graphvio.slam.service.server import GrpcServer

        address = stack.enter_context(_until_read(GrpcServer(running, self.grpc))).address
        lines = [f"gRPC: {address}" + (" (TLS)" if self.grpc.certificate else "")]
        if self.ros2_domain is None:
            return Started(address, lines)
        from graphvio.ros2.parameters import flatten
        from graphvio.ros2.publisher import NODE, Publisher

        parameters = flatten(asdict(running.config))
        publisher = stack.enter_context(Publisher(running, self.ros2_domain, parameters=parameters))
        lines.append(f"ROS 2: node {NODE} in domain {self.ros2_domain}")
        return Started(address, lines, publisher.check)


@contextmanager
def _until_read(server: GrpcServer) -> Iterator[GrpcServer]:
    """Run a server within the block, and then wait for clients that have not read everything."""
    from graphvio.slam.service.server import READ_S

    with server:
        yield server
        if not server.drain(_SOON_S):
            typer.echo(f"waiting for gRPC clients that have not read everything, {READ_S:g} s at most", err=True)
