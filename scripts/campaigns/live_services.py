"""All services of a live odometry: recording, gRPC, ROS 2 and metrics; and a gRPC client in another process."""

from __future__ import annotations

import subprocess
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from graphvio.live.health import HealthServer
from graphvio.live.running import LiveOdometry
from graphvio.live.session_recorder import SessionRecorder
from graphvio.ros2.publisher import Publisher
from graphvio.slam.client import Client
from graphvio.slam.service.options import ServiceOptions
from graphvio.slam.service.server import GrpcServer

_DOMAIN = 97
_CLIENT = "from campaigns.live_services import listen; import sys; listen(sys.argv[1])"
_END_S = 60.0


@dataclass(frozen=True)
class Services:
    """The running services.

    Attributes:
        recorder: recorder of a session.
        client: process of a client that receives all keyframes by gRPC.
        publisher: publisher of ROS 2 topics.
    """

    recorder: SessionRecorder
    client: subprocess.Popen[str]
    publisher: Publisher

    @classmethod
    def start(cls, running: LiveOdometry, path: Path, waits: bool, stack: ExitStack) -> Services:
        """Start all services, which run until the stack is closed; to be called before the odometry's start."""
        recorder = SessionRecorder(path, running.rig, waits=waits)
        stack.callback(recorder.close)
        running.add_output(recorder)
        stack.callback(HealthServer(running.status).close)
        server = stack.enter_context(GrpcServer(running, ServiceOptions(port=0)))
        publisher = stack.enter_context(Publisher(running, _DOMAIN))
        client = subprocess.Popen([sys.executable, "-c", _CLIENT, server.address], stdout=subprocess.PIPE, text=True)
        stack.callback(client.kill)
        assert client.stdout is not None
        client.stdout.readline()  # a line means that the client is connected
        return cls(recorder, client, publisher)

    def summary(self) -> str:
        """Return a sentence on what recorder and client have received; to be called after the end of the run."""
        self.publisher.check()
        received, _ = self.client.communicate(timeout=_END_S)
        self.recorder.close()
        recorded = self.recorder.status()
        return (
            f"Recorded: {recorded['recorded_framesets']} framesets, {recorded['framesets_not_recorded']} left out. "
            f"The client by gRPC: {received.strip()}."
        )


def listen(address: str) -> None:
    """Receive all keyframes with their images; called in the client's process."""
    with Client(address) as client:
        print("connected", flush=True)
        ids = [keyframe.id for keyframe in client.keyframes(with_images=True)]
    missing = len(set(range(ids[0], ids[-1] + 1)) - set(ids)) if ids else 0
    print(f"{len(ids)} keyframes with their images, {missing} missing", flush=True)
