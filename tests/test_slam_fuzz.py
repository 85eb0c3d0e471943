"""Invalid input at the port: the server still answers valid requests, and leaks no resources."""

import random
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import served

from graphvio.errors import ServiceError

pytest.importorskip("grpc")

import grpc

from graphvio.slam.client import Client
from graphvio.slam.service import messages
from graphvio.slam.service import server as service
from graphvio.slam.service.options import ServiceOptions
from graphvio.slam.service.server import GrpcServer

METHODS = ("GetInfo", "GetStatus", "StreamEstimates", "StreamKeyframes", "StreamEvents", "Correct")
PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
MB = 2**20


@pytest.fixture(scope="module")
def odometry() -> served.SyntheticOdometry:
    synthetic = served.SyntheticOdometry()
    synthetic.keyframe_log.add(served.keyframe(0))
    synthetic.end()  # so that streams end
    return synthetic


@pytest.fixture
def server(odometry: served.SyntheticOdometry) -> Iterator[GrpcServer]:
    odometry.corrections.clear()
    with GrpcServer(odometry, ServiceOptions(port=0)) as running:
        yield running
        with Client(running.address) as client:  # after all of it
            assert [keyframe.id for keyframe in client.keyframes()] == [0]
            assert client.correct(0, np.eye(4), np.eye(6)).accepted
        assert running.open_streams == 0


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096


def mutated(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        place = rng.randrange(len(changed) + 1)
        match rng.randrange(4):
            case 0:
                changed[place : place + 1] = bytes([rng.randrange(256)])
            case 1:
                del changed[place : place + rng.randrange(20)]
            case 2:
                changed[place:place] = rng.randbytes(rng.randrange(20))
            case _:
                changed[place:place] = changed[: rng.randrange(40)]
    return bytes(changed)


def test_random_and_mutated_requests_are_answered(server: GrpcServer, odometry: served.SyntheticOdometry) -> None:
    rng = random.Random(4)
    whole = {
        "Correct": messages.CorrectRequest(
            keyframe_id=1, map_T_body=np.eye(4).ravel(), covariance=np.eye(6).ravel()
        ).SerializeToString(),
        "StreamKeyframes": messages.StreamKeyframesRequest(from_id=0, with_images=True, run_id="x").SerializeToString(),
        "StreamEstimates": messages.StreamEstimatesRequest(rate=2).SerializeToString(),
    }
    codes = set()
    with grpc.insecure_channel(server.address) as channel:
        for _ in range(1500):
            name = rng.choice(METHODS)
            data = rng.randbytes(rng.randrange(200)) if rng.random() < 0.4 else mutated(whole.get(name, b""), rng)
            try:
                list(channel.unary_stream(f"/graphvio.v1.FrontEnd/{name}")(data, timeout=20.0))
                codes.add(grpc.StatusCode.OK)
            except grpc.RpcError as error:
                codes.add(error.code())
    assert codes == {
        grpc.StatusCode.OK,
        grpc.StatusCode.INVALID_ARGUMENT,
        grpc.StatusCode.FAILED_PRECONDITION,
    }
    for _, map_T_body, covariance in odometry.corrections:  # mutations that are still sound
        np.testing.assert_allclose(map_T_body[:3, :3] @ map_T_body[:3, :3].T, np.eye(3), atol=2e-6)
        assert np.isfinite(np.linalg.cholesky(covariance)).all()


def test_requests_that_are_too_large_are_refused_unread(server: GrpcServer) -> None:
    options = [("grpc.max_send_message_length", -1)]
    huge = bytes(8 * MB)
    with grpc.insecure_channel(server.address, options) as channel:
        call = channel.unary_unary("/graphvio.v1.FrontEnd/Correct")
        for size in (64 * 2**10 + 1, len(huge)):
            with pytest.raises(grpc.RpcError) as caught:
                call(huge[:size], timeout=20.0)
            assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        for count in (10, 15):  # the first fill the buffers of both sides
            before = resident_bytes()
            for _ in range(count):
                with pytest.raises(grpc.RpcError):
                    call(huge, timeout=20.0)
        assert resident_bytes() - before < 40 * MB  # of 120 that came


def test_metadata_that_is_too_large_is_refused(server: GrpcServer) -> None:
    with grpc.insecure_channel(server.address) as channel:
        with pytest.raises(grpc.RpcError) as caught:
            channel.unary_unary("/graphvio.v1.FrontEnd/GetInfo")(b"", metadata=(("x", "y" * 100_000),), timeout=20.0)
        assert caught.value.code() in (grpc.StatusCode.RESOURCE_EXHAUSTED, grpc.StatusCode.UNAVAILABLE)


def test_garbage_at_the_port_is_ignored(server: GrpcServer) -> None:
    rng = random.Random(5)
    port = int(server.address.rpartition(":")[2])
    before = resident_bytes()
    for number in range(300):
        with socket.create_connection(("127.0.0.1", port), timeout=5.0) as connection:
            data = rng.randbytes(rng.randrange(1, 20_000))
            if number % 3 == 1:
                data = PREFACE + data
            elif number % 3 == 2:  # frames of HTTP/2 with random content
                kind, flags = rng.randrange(12), rng.randrange(256)
                stream = rng.randrange(5).to_bytes(4, "big")
                data = PREFACE + bytes(9) + len(data).to_bytes(3, "big") + bytes([kind, flags]) + stream + data
            try:
                connection.sendall(data)
                if number % 2:
                    connection.settimeout(0.05)
                    connection.recv(1000)
            except OSError:
                pass  # refused: as it should be
    assert resident_bytes() - before < 100 * MB


def test_silent_connections_do_not_keep_others_out(server: GrpcServer) -> None:
    port = int(server.address.rpartition(":")[2])
    silent = [socket.create_connection(("127.0.0.1", port), timeout=5.0) for _ in range(40)]
    with Client(server.address) as client:
        assert client.info().next_keyframe_id == 1
    for connection in silent:
        connection.close()


@pytest.fixture
def short_handshake(monkeypatch: pytest.MonkeyPatch) -> None:
    """A silent connection is closed after a fifth of the usual time."""
    assert service._HANDSHAKE_MS == 5_000
    monkeypatch.setattr(service, "_HANDSHAKE_MS", 1_000)


@pytest.mark.usefixtures("short_handshake")  # the server comes after it
def test_idle_connections_are_closed_within_seconds(server: GrpcServer) -> None:
    port = int(server.address.rpartition(":")[2])
    silent = [socket.create_connection(("127.0.0.1", port), timeout=5.0) for _ in range(150)]
    with pytest.raises(ServiceError, match="it may have too many clients"):
        Client(server.address)
    deadline = time.monotonic() + 30.0
    while time.monotonic() < deadline:
        time.sleep(0.5)
        with suppress(ServiceError), Client(server.address) as client:
            assert client.info().next_keyframe_id == 1
            break
    else:
        pytest.fail("nobody else is let in")
    for connection in silent:
        connection.close()


def test_many_short_clients_leave_no_resources(server: GrpcServer) -> None:
    def come_and_go() -> None:
        for _ in range(15):
            with Client(server.address) as client:
                next(iter(client.keyframes()))

    come_and_go()
    threads, before = threading.active_count(), resident_bytes()
    crowd = [threading.Thread(target=come_and_go) for _ in range(6)]
    for each in crowd:
        each.start()
    for each in crowd:
        each.join(60.0)
    assert resident_bytes() - before < 60 * MB
    assert threading.active_count() <= threads + 4 * 8 + 8  # the server's pool
