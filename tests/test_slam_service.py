"""A real server and real clients over sockets of the loopback, with a synthetic odometry."""

import inspect
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import served
from test_slam_messages import assert_same

from graphvio.errors import ServiceError
from graphvio.measurements.events import Event
from graphvio.queues import Broadcast
from graphvio.slam import FrontEnd
from graphvio.slam.interface import SlamFrontEnd
from graphvio.slam.keyframe import Keyframe

pytest.importorskip("grpc")

from graphvio.slam.client import Client, Update
from graphvio.slam.service.options import ServiceOptions
from graphvio.slam.service.server import DaemonPool, GrpcServer

ANY_PORT = ServiceOptions(port=0)


@pytest.fixture
def odometry() -> Iterator[served.SyntheticOdometry]:
    synthetic = served.SyntheticOdometry()
    yield synthetic
    synthetic.end()


@pytest.fixture
def server(odometry: served.SyntheticOdometry) -> Iterator[GrpcServer]:
    with GrpcServer(odometry, ANY_PORT) as running:
        yield running


@pytest.fixture
def client(server: GrpcServer) -> Iterator[Client]:
    with Client(server.address) as connected:
        yield connected


def until(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


def listeners(broadcast: Broadcast[Any]) -> int:
    return sum(not queue.is_closed for queue in broadcast._queues)


def in_thread(function: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=function, daemon=True)
    thread.start()
    return thread


def test_front_end_and_client_have_the_interface_of_the_protocol() -> None:
    names = [name for name in vars(SlamFrontEnd) if not name.startswith("_")]
    assert sorted(names) == ["correct", "keyframes", "rig"]
    for kind in (FrontEnd, Client):
        assert isinstance(inspect.getattr_static(kind, "rig"), property)
        for name in ("keyframes", "correct"):
            expected = inspect.signature(getattr(SlamFrontEnd, name))
            found = inspect.signature(getattr(kind, name))
            options = [each for each in found.parameters.values() if each.kind is inspect.Parameter.KEYWORD_ONLY]
            assert all(option.default is not inspect.Parameter.empty for option in options)
            common = [each for each in found.parameters.values() if each not in options]
            assert found.replace(parameters=common) == expected


def test_client_has_the_rig_of_the_server(client: Client) -> None:
    front_end: SlamFrontEnd = client
    assert front_end.rig.name == "synthetic"
    for camera, same in zip(served.rig().cameras, front_end.rig.cameras, strict=True):
        np.testing.assert_array_equal(camera.body_T_cam, same.body_T_cam)


def test_info_has_the_ids_of_the_kept_keyframes(odometry: served.SyntheticOdometry, client: Client) -> None:
    info = client.info()
    assert (info.epoch, info.oldest_keyframe_id, info.next_keyframe_id, info.has_ended) == (None, 0, 0, False)
    for number in range(3):
        odometry.keyframe_log.add(served.keyframe(number, epoch=number))
    odometry.end()
    info = client.info()
    assert (info.epoch, info.oldest_keyframe_id, info.next_keyframe_id, info.has_ended) == (2, 0, 3, True)
    assert info.version
    assert len(info.run_id) == 32


def test_keyframes_are_complete_and_end_with_the_odometry(odometry: served.SyntheticOdometry, client: Client) -> None:
    for number in range(3):
        odometry.keyframe_log.add(served.keyframe(number))
    stream = client.keyframes(1, with_images=True)
    assert_same(next(stream), served.keyframe(1))
    assert_same(next(stream), served.keyframe(2))

    def go_on() -> None:
        time.sleep(0.1)
        odometry.keyframe_log.add(served.keyframe(3))
        odometry.end()

    in_thread(go_on)
    assert_same(next(stream), served.keyframe(3))
    assert list(stream) == []
    (bare, *_), (undescribed, *_) = client.keyframes(), client.keyframes(with_descriptors=False)
    assert bare.images == {}
    assert_same(bare.landmarks, served.keyframe(0).landmarks)
    assert undescribed.landmarks.descriptors.shape == (7, 0)


def test_keyframes_no_longer_kept_are_skipped_and_counted() -> None:
    odometry = served.SyntheticOdometry(max_bytes=100_000)  # some eight of them
    for number in range(50):
        odometry.keyframe_log.add(served.keyframe(number))
    odometry.end()
    oldest = odometry.keyframe_log.oldest_id
    assert 30 < oldest < 49
    with GrpcServer(odometry, ANY_PORT) as server, Client(server.address) as client:
        assert client.info().oldest_keyframe_id == oldest
        assert [keyframe.id for keyframe in client.keyframes(10)] == list(range(oldest, 50))
        from graphvio.slam.service import messages

        stub = client._connection.stub
        updates = list(stub.StreamKeyframes(messages.StreamKeyframesRequest(from_id=10)))
        assert [update.gone for update in updates] == [oldest - 10] + [0] * (49 - oldest)


def test_estimates_and_predictions_have_the_correction_in_force(
    odometry: served.SyntheticOdometry, client: Client
) -> None:
    odometry.keyframe_log.add(served.keyframe(0, epoch=4))
    estimates, predictions = client.estimates(), client.estimates("imu")
    got: list[object] = []
    reader = in_thread(lambda: got.extend((next(estimates), next(predictions))))
    until(lambda: listeners(odometry.estimates), "nobody listens")
    odometry.estimates.publish(served.estimate(1, epoch=4))
    until(lambda: listeners(odometry.predictions), "nobody listens")
    odometry.predictions.publish(served.prediction(1, epoch=4))
    reader.join(10.0)
    estimate, prediction = got
    assert isinstance(estimate, Update)
    assert isinstance(prediction, Update)
    assert_same(estimate.state, served.estimate(1, epoch=4))
    for name in ("stamp_ns", "nav_T_body", "velocity_nav", "angular_velocity", "epoch"):
        assert_same(getattr(prediction.state, name), getattr(served.prediction(1, epoch=4), name), name)
    assert (estimate.map_T_odom, estimate.missed, prediction.map_T_odom) == (None, 0, None)

    odometry.map_T_odom = served.pose(np.random.default_rng(9))
    odometry.estimates.publish(served.estimate(2, epoch=4))
    odometry.estimates.publish(served.estimate(3, epoch=3))  # of an epoch that the correction is not for
    odometry.end()
    with_map, without = estimates
    assert_same(with_map.map_T_odom, odometry.map_T_odom)
    assert (without.state.epoch, without.map_T_odom) == (3, None)


def test_events_and_figures_arrive(odometry: served.SyntheticOdometry, client: Client) -> None:
    event = Event(served.START_NS, "vision_gated", "χ² = 31")
    got: list[Event] = []
    reader = in_thread(lambda: got.extend(client.events()))
    until(lambda: listeners(odometry.events), "nobody listens")
    odometry.events.publish(event)
    odometry.end()
    reader.join(10.0)
    assert got == [event]
    odometry.figures = {"rate_hz": 19.9, "framesets": 7, "status": "tracking", "battery": None}
    assert client.status() == dict(sorted(odometry.figures.items()))


def test_corrections_arrive_bit_by_bit_and_are_answered(odometry: served.SyntheticOdometry, client: Client) -> None:
    rng = np.random.default_rng(3)
    near, covariance = served.pose(rng), served.covariance(rng)
    result = client.correct(5, near, covariance)
    assert (result.accepted, result.reason, result.statistic, result.threshold) == (True, "", None, 22.46)
    far = near.copy()
    far[:3, 3] += 100.0
    refused = client.correct(6, far, covariance)
    assert (refused.accepted, refused.reason, refused.statistic) == (False, "off by 9 sigma", 81.25)
    assert_same(refused.map_T_odom, near)
    for got, sent in zip(odometry.corrections, ((5, near, covariance), (6, far, covariance)), strict=True):
        assert got[0] == sent[0]
        assert_same(got[1], sent[1])
        assert_same(got[2], sent[2])


def test_malformed_corrections_never_reach_the_odometry(odometry: served.SyntheticOdometry, client: Client) -> None:
    pose, covariance = np.eye(4), np.eye(6)
    nan, bent, negative = pose.copy(), pose.copy(), -covariance
    nan[0, 3], bent[0, 0] = np.nan, 1.1
    for arguments, text in (
        ((-1, pose, covariance), "keyframe_id is -1"),
        ((0, nan, covariance), "map_T_body: holds NaN"),
        ((0, bent, covariance), "map_T_body: holds no rotation"),
        ((0, pose[:3], covariance), "map_T_body: has 12 values; it must have 16"),
        ((0, pose, covariance[:3]), "covariance: has 18 values"),
        ((0, pose, negative), "covariance: is not positive definite"),
        ((0, pose, np.triu(np.ones((6, 6)))), "covariance: is not symmetric"),
    ):
        with pytest.raises(ServiceError, match=text):
            client.correct(*arguments)
    with pytest.raises(ServiceError, match="from_id is -1"):
        next(client.keyframes(-1))
    assert not odometry.corrections


def test_failing_odometry_is_reported_and_the_server_continues(
    odometry: served.SyntheticOdometry, client: Client, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("secret")

    odometry.correct = fail  # type: ignore[method-assign,assignment]
    with pytest.raises(ServiceError, match=r"the server failed \(ZeroDivisionError\)") as caught:
        client.correct(0, np.eye(4), np.eye(6))
    assert "secret" not in str(caught.value)
    assert "secret" in caplog.text

    def refuse(*_: object) -> None:
        raise ServiceError("keyframe 0 is of a past epoch")

    odometry.correct = refuse  # type: ignore[method-assign,assignment]
    with pytest.raises(ServiceError, match=r"127\.0\.0\.1:\d+: keyframe 0 is of a past epoch"):
        client.correct(0, np.eye(4), np.eye(6))
    assert client.status() == {}


def test_slow_client_gets_new_estimates_and_the_number_of_missed_ones(
    odometry: served.SyntheticOdometry, client: Client
) -> None:
    stream = client.estimates()
    got: list[tuple[int, int]] = []
    may_go_on = threading.Event()

    def read() -> None:
        for update in stream:
            got.append((update.state.epoch, update.missed))  # the epoch numbers the estimates here
            may_go_on.wait()

    reader = in_thread(read)
    until(lambda: listeners(odometry.estimates), "nobody listens")
    published = 20_000
    estimate = served.estimate(1)
    for number in range(published):
        odometry.estimates.publish(replace(estimate, epoch=number))
    until(lambda: got, "nothing came")
    may_go_on.set()
    odometry.end()
    reader.join(20.0)
    numbers = [number for number, _ in got]
    assert numbers == sorted(numbers)
    assert numbers[-1] == published - 1
    assert sum(missed for _, missed in got) + len(got) == published
    assert len(got) < 50  # what is on its way, not what was published


def test_publishing_never_waits_for_a_client_that_does_not_read(
    odometry: served.SyntheticOdometry, server: GrpcServer
) -> None:
    """A whole run is published while the thread of the client's stream is blocked in sending."""
    with Client(server.address) as stalled:
        stream = stalled.keyframes(with_images=True)
        odometry.keyframe_log.add(served.keyframe(0))
        next(stream)  # and no more from here on
        updates = stalled.estimates()
        reader = in_thread(lambda: next(updates))
        until(lambda: listeners(odometry.estimates), "nobody listens")
        estimate = served.estimate(1)

        def publish() -> None:
            for number in range(1, 300):
                odometry.keyframe_log.add(served.keyframe(number, points=50))
            for _ in range(20_000):
                odometry.estimates.publish(estimate)

        publisher = in_thread(publish)
        publisher.join(30.0)
        assert not publisher.is_alive()
        reader.join(10.0)
        with Client(server.address) as other:  # and others are served
            assert other.info().next_keyframe_id == 300
            assert next(other.keyframes(299)).id == 299


def test_streams_end_with_their_client_and_iterator(odometry: served.SyntheticOdometry, server: GrpcServer) -> None:
    odometry.keyframe_log.add(served.keyframe(0))
    with Client(server.address) as client:
        stream = client.keyframes()
        next(stream)
        assert server.open_streams == 1
        stream.close()  # type: ignore[attr-defined]
        until(lambda: server.open_streams == 0, "the stream is still open")
        other = client.keyframes()
        next(other)
    assert list(other) == []
    until(lambda: server.open_streams == 0, "the stream is still open")
    with pytest.raises(ServiceError, match="this client is closed"):
        client.info()


def test_close_from_another_thread_ends_a_waiting_iterator(client: Client, server: GrpcServer) -> None:
    reader = in_thread(lambda: list(client.keyframes()))
    until(lambda: server.open_streams, "no stream was opened")
    client.close()
    reader.join(10.0)
    assert not reader.is_alive()


def test_clients_beyond_the_limit_get_no_streams_but_answers(odometry: served.SyntheticOdometry) -> None:
    odometry.keyframe_log.add(served.keyframe(0))
    with GrpcServer(odometry, replace(ANY_PORT, max_clients=2)) as server:
        clients = [Client(server.address) for _ in range(3)]
        streams = [client.keyframes() for client in clients for _ in range(4)]
        for stream in streams[:8]:
            next(stream)
        with pytest.raises(ServiceError, match="2 clients have streams already"):
            next(streams[8])
        with pytest.raises(ServiceError, match="may have 4 streams"):
            next(clients[0].keyframes())
        assert clients[2].info().next_keyframe_id == 1
        clients[0].close()
        until(lambda: server.open_streams == 4, "the streams are still open")
        assert next(clients[2].keyframes()).id == 0
        for client in clients:
            client.close()


def test_keyframes_continue_after_an_absence_of_the_server(odometry: served.SyntheticOdometry) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = GrpcServer(odometry, ServiceOptions(port=port))
    server.start()
    with Client(server.address) as client:
        got: list[int] = []
        reader = in_thread(lambda: got.extend(keyframe.id for keyframe in client.keyframes()))
        for number in range(60):
            odometry.keyframe_log.add(served.keyframe(number))
            if number in (20, 40):
                server.stop(grace_s=0.0)
                time.sleep(0.3)
                server.start()
            time.sleep(0.005)
        odometry.end()
        reader.join(20.0)
        assert got == list(range(60))
    server.stop()
    server.stop()


class CuttingProxy:
    """A proxy that cuts each connection after a number of bytes."""

    def __init__(self, port: int, cut_after: Iterator[int]) -> None:
        self._port = port
        self._cut_after = cut_after
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self.cuts = 0
        in_thread(self._accept)

    def _accept(self) -> None:
        while True:
            client, _ = self._listener.accept()
            server = socket.create_connection(("127.0.0.1", self._port))
            in_thread(partial(self._pass_on, client, server, 2**60))
            in_thread(partial(self._pass_on, server, client, next(self._cut_after, 2**60)))

    def _pass_on(self, one: socket.socket, other: socket.socket, most: int) -> None:
        with suppress(OSError):
            while most > 0 and (data := one.recv(min(most, 4096))):
                other.sendall(data)
                most -= len(data)
            self.cuts += most == 0
        for each in (one, other):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)


def test_connections_cut_within_messages_lose_and_repeat_no_keyframe(
    odometry: served.SyntheticOdometry, server: GrpcServer
) -> None:
    for number in range(80):
        odometry.keyframe_log.add(served.keyframe(number))
    odometry.end()
    rng = np.random.default_rng(6)
    proxy = CuttingProxy(int(server.address.rpartition(":")[2]), iter(rng.integers(50_000, 200_000, 8).tolist()))
    with Client(proxy.address) as client:
        got = list(client.keyframes(with_images=True))
    assert proxy.cuts >= 5
    assert [keyframe.id for keyframe in got] == list(range(80))
    for number, keyframe in enumerate(got):
        assert_same(keyframe, served.keyframe(number))


def test_another_run_of_the_odometry_raises(odometry: served.SyntheticOdometry) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        options = ServiceOptions(port=free.getsockname()[1])
    odometry.keyframe_log.add(served.keyframe(0))
    first = GrpcServer(odometry, options)
    first.start()
    with Client(first.address) as client:
        stream = client.keyframes()
        next(stream)
        first.stop(grace_s=0.0)
        with GrpcServer(odometry, options):
            with pytest.raises(ServiceError, match="another run of the odometry is served now"):
                next(stream)
            with pytest.raises(ServiceError, match="another run"):
                client.correct(0, np.eye(4), np.eye(6))


def test_reconnecting_ends_after_the_patience(odometry: served.SyntheticOdometry) -> None:
    odometry.keyframe_log.add(served.keyframe(0))
    server = GrpcServer(odometry, ANY_PORT)
    server.start()
    with Client(server.address, patience_s=0.5) as client:
        stream = client.keyframes()
        next(stream)
        server.stop(grace_s=0.0)
        with pytest.raises(ServiceError, match="nothing listens there"):
            next(stream)


def test_keyframes_of_an_ended_odometry_are_read_to_the_end(odometry: served.SyntheticOdometry) -> None:
    for number in range(200):
        odometry.keyframe_log.add(served.keyframe(number))
    server = GrpcServer(odometry, ANY_PORT)
    server.start()
    with Client(server.address) as client:
        stream = client.keyframes(with_images=True)
        next(stream)
        odometry.end()
        stopper = in_thread(lambda: server.stop(grace_s=20.0))
        assert [keyframe.id for keyframe in stream] == list(range(1, 200))
        stopper.join(20.0)
        assert not stopper.is_alive()


def test_waiting_estimates_reach_a_slow_reader_after_the_end(odometry: served.SyntheticOdometry) -> None:
    got: list[tuple[int, int]] = []
    may_go_on = threading.Event()
    published = 0
    server = GrpcServer(odometry, ANY_PORT)
    server.start()
    with Client(server.address, patience_s=0.0) as client:

        def read() -> None:
            for update in client.estimates():
                got.append((update.state.epoch, update.missed))
                may_go_on.wait()

        reader = in_thread(read)
        until(lambda: listeners(odometry.estimates), "nobody listens")
        (queue,) = odometry.estimates._queues
        taken_s = time.monotonic()
        while time.monotonic() - taken_s < 1.0:  # until the buffers of the connection are full
            if len(queue):
                time.sleep(1e-4)
            else:
                odometry.estimates.publish(replace(served.estimate(1), epoch=published))
                published += 1
                taken_s = time.monotonic()
        assert got
        for _ in range(10):
            odometry.estimates.publish(replace(served.estimate(1), epoch=published))
            published += 1
        odometry.end()
        assert not server.drain(0.2)
        stopper = in_thread(server.stop)
        may_go_on.set()
        reader.join(20.0)
        stopper.join(20.0)
        assert not stopper.is_alive()
    assert got[-1][0] == published - 1
    assert sum(missed for _, missed in got) + len(got) == published


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGSTOP")
def test_stalled_reader_does_not_delay_the_end(
    odometry: served.SyntheticOdometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("graphvio.slam.service.server._STALLED_S", 1.0)
    for number in range(200):
        odometry.keyframe_log.add(served.keyframe(number))
    server = GrpcServer(odometry, replace(ANY_PORT, keepalive_s=3600.0))
    server.start()
    process = reader_process(server, 0)
    assert process.stdout is not None
    process.stdout.readline()
    os.kill(process.pid, signal.SIGSTOP)
    try:
        odometry.end()
        stopper = in_thread(lambda: server.stop(grace_s=3600.0))
        stopper.join(60.0)
        assert not stopper.is_alive()
    finally:
        process.kill()
        process.communicate()


READER = """
import sys
from graphvio.slam.client import Client

with Client(sys.argv[1]) as client:
    for keyframe in client.keyframes(int(sys.argv[2]), with_images=True):
        print(keyframe.id, float(keyframe.odom_T_body.sum()).hex(), flush=True)
"""


def reader_process(server: GrpcServer, from_id: int) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", READER, server.address, str(from_id)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[1])


def line_of(keyframe: Keyframe) -> str:
    return f"{keyframe.id} {float(keyframe.odom_T_body.sum()).hex()}"


def test_killed_client_resumes_without_a_missing_keyframe(
    odometry: served.SyntheticOdometry, server: GrpcServer
) -> None:
    count = 200

    def make() -> None:
        for number in range(count):
            odometry.keyframe_log.add(served.keyframe(number))
            time.sleep(0.005)

    maker = in_thread(make)
    got: list[str] = []
    for reads in (20, 50):
        process = reader_process(server, len(got))
        assert process.stdout is not None
        got += [process.stdout.readline().strip() for _ in range(reads)]
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        until(lambda: server.open_streams == 0, "the stream of the killed client is still open")
    maker.join(20.0)
    odometry.end()
    process = reader_process(server, len(got))
    remaining, _ = process.communicate(timeout=60)
    got += remaining.split("\n")[:-1]
    assert got == [line_of(served.keyframe(number)) for number in range(count)]


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGSTOP")
def test_client_that_no_longer_answers_is_disconnected(odometry: served.SyntheticOdometry) -> None:
    odometry.keyframe_log.add(served.keyframe(0))
    with GrpcServer(odometry, replace(ANY_PORT, keepalive_s=1.0)) as server:
        process = reader_process(server, 0)
        assert process.stdout is not None
        process.stdout.readline()
        os.kill(process.pid, signal.SIGSTOP)
        try:
            until(lambda: server.open_streams == 0, "the stream of the stopped client is still open")
        finally:
            process.kill()
            process.communicate()


def test_port_in_use_and_second_start_raise(
    server: GrpcServer, odometry: served.SyntheticOdometry, capfd: pytest.CaptureFixture[str]
) -> None:
    port = int(server.address.rpartition(":")[2])
    with pytest.raises(ServiceError, match=f"127.0.0.1:{port}: cannot be listened on .Address already in use"):
        GrpcServer(odometry, ServiceOptions(port=port)).start()
    assert capfd.readouterr().err == ""  # gRPC has nothing to add
    with pytest.raises(ServiceError, match=r"cannot be listened on .not a host name"):
        GrpcServer(odometry, ServiceOptions("a..b", 0, Path("absent"), Path("absent"), Path("absent"))).start()
    with pytest.raises(ServiceError, match="is served already"):
        server.start()


def test_program_with_open_streams_ends_without_stopping_the_server() -> None:
    code = """
import served
from graphvio.slam.client import Client
from graphvio.slam.service.options import ServiceOptions
from graphvio.slam.service.server import GrpcServer

odometry = served.SyntheticOdometry()
odometry.keyframe_log.add(served.keyframe(0))
server = GrpcServer(odometry, ServiceOptions(port=0))
server.start()
client = Client(server.address)
stream = client.keyframes()
print(next(stream).id)
raise ValueError("the program's own failure")
"""
    folder = Path(__file__).parent
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
        env={**os.environ, "PYTHONPATH": f"{folder.parent}{os.pathsep}{folder}"},
    )
    assert (done.returncode, done.stdout) == (1, "0\n"), done.stderr
    assert "the program's own failure" in done.stderr


def test_pool_limits_threads_and_finishes_all_calls() -> None:
    pool = DaemonPool(3)
    may_end = threading.Event()
    begun = threading.Semaphore(0)

    def work(number: int) -> int:
        begun.release()
        may_end.wait()
        return number

    futures = [pool.submit(work, number) for number in range(10)]
    assert all(begun.acquire(timeout=10.0) for _ in range(3))
    assert not begun.acquire(timeout=0.05)
    may_end.set()
    failed = pool.submit(lambda: 1 // 0)
    pool.shutdown()
    assert [future.result(0.0) for future in futures] == list(range(10))
    with pytest.raises(ZeroDivisionError):
        failed.result(0.0)
    with pytest.raises(RuntimeError):
        pool.submit(work, 0)


def test_import_without_grpcio_names_the_extra() -> None:
    code = """
import sys
sys.modules["grpc"] = None
try:
    import graphvio.slam.client
except Exception as error:
    print(type(error).__name__, error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.startswith("MissingExtraError ")
    assert "pip install 'graphvio[serve]'" in done.stdout
