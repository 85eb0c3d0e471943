"""The server: opens the port, lets clients in, and answers them beside the odometry."""

from __future__ import annotations

import socket
import threading
import time
import uuid
from collections.abc import Callable
from concurrent.futures import Executor, Future
from queue import SimpleQueue
from typing import Any, Self

from graphvio.errors import ServiceError
from graphvio.slam.interface import Served
from graphvio.slam.service import grpc, stubs
from graphvio.slam.service.options import ServiceOptions
from graphvio.slam.service.security import MalformedInterceptor, read_token, server_credentials, token_interceptor
from graphvio.slam.service.servicer import STREAMS_OF_A_CLIENT, Servicer, StreamLimit

_CALL_THREADS = 8  # for calls that are no streams, however many streams there are
_CALLS_WAITING = 64
_REQUEST_BYTES = 64 * 2**10
_METADATA_BYTES = 16 * 2**10
_HANDSHAKE_MS = 5_000
_IDLE_MS = 300_000
_LEAST_PING_MS = 4_000
READ_S = 60.0  # for those who read what is left of an odometry that has ended
_STALLED_S = 5.0  # a stream of which nothing is taken for so long is not read
_CUT_S = 0.5  # for streams and calls to see that the server stops
_LOOK_S = 0.05


def check(options: ServiceOptions) -> None:
    """Find out what would keep a server from starting, without starting one.

    Raises:
        ServiceError: if the address is taken or not this machine's, or token, certificate or key cannot be used.
    """
    _check_address(options)
    server_credentials(options)
    if options.token_file is not None:
        read_token(options.token_file)


class GrpcServer:
    """Serves a running odometry; a context manager.

    Args:
        served: the odometry. It is only read from, and told corrections.
        options: where, and for whom.

    Raises:
        MissingExtraError: when the module is imported, if grpcio is not installed.
    """

    def __init__(self, served: Served, options: ServiceOptions | None = None) -> None:
        self._options = options or ServiceOptions()
        self._served = served
        self._run_id = uuid.uuid4().hex
        self._limit = StreamLimit(self._options.max_clients)
        self._stopping = threading.Event()
        self._server: Any = None
        self._pool: DaemonPool | None = None
        self._port = 0

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.stop(READ_S if kind is None else _CUT_S)

    @property
    def address(self) -> str:
        """``HOST:PORT`` where it listens, with the port that was found if any was asked for."""
        return f"{self._options.address.rpartition(':')[0]}:{self._port or self._options.port}"

    @property
    def open_streams(self) -> int:
        """How many streams clients have open."""
        return self._limit.open_streams

    def start(self) -> None:
        """Listen; clients are served from here on, in threads of the server.

        Raises:
            ServiceError: if the address is taken or not this machine's, or token, certificate or key cannot be used.
        """
        if self._server is not None:
            raise ServiceError(f"{self.address}: is served already; stop it first")
        options = self._options
        _check_address(options)
        credentials = server_credentials(options)
        interceptors = [] if options.token_file is None else [token_interceptor(read_token(options.token_file))]
        interceptors.append(MalformedInterceptor())
        threads = STREAMS_OF_A_CLIENT * options.max_clients + _CALL_THREADS
        pool = DaemonPool(threads)
        server = grpc.server(
            pool,
            interceptors=interceptors,
            options=_transport(options),
            maximum_concurrent_rpcs=threads + _CALLS_WAITING,
        )
        self._stopping = threading.Event()
        stubs.add_FrontEndServicer_to_server(Servicer(self._served, self._run_id, self._limit, self._stopping), server)
        try:
            if credentials is None:
                self._port = server.add_insecure_port(options.address)
            else:
                self._port = server.add_secure_port(options.address, credentials)
        except RuntimeError:
            self._port = 0
        if not self._port:
            server.stop(None)
            pool.shutdown()
            raise _cannot_listen(options, "gRPC failed")
        server.start()
        self._server, self._pool = server, pool

    def drain(self, most_s: float = READ_S) -> bool:
        """Let streams of an odometry that has ended be read to their end; whether all have been.

        Args:
            most_s: how long. It is given up before when nothing is taken of any stream for 5 s.
        """
        begun_s = time.monotonic()
        while self.open_streams and (now_s := time.monotonic()) - begun_s < most_s:
            if now_s - begun_s > _STALLED_S and not self._limit.is_read_since(now_s - _STALLED_S):
                break
            time.sleep(_LOOK_S)
        return not self.open_streams

    def stop(self, grace_s: float = READ_S) -> None:
        """Listen no more, and end all streams; a second time does nothing.

        Args:
            grace_s: streams of an odometry that has ended may go on for so long, see `drain`.
        """
        if self._server is None or self._pool is None:
            return
        if self._served.keyframe_log.is_closed:
            self.drain(grace_s)
        self._stopping.set()
        self._server.stop(min(grace_s, _CUT_S)).wait()
        self._pool.shutdown()
        self._server = self._pool = None


def _transport(options: ServiceOptions) -> list[tuple[str, int]]:
    keepalive_ms = int(1e3 * options.keepalive_s)
    return [
        ("grpc.so_reuseport", 0),  # else a second server on the same port would take half of the clients
        ("grpc.max_receive_message_length", _REQUEST_BYTES),
        ("grpc.max_send_message_length", -1),
        ("grpc.max_metadata_size", _METADATA_BYTES),
        ("grpc.max_concurrent_streams", STREAMS_OF_A_CLIENT + _CALL_THREADS),
        # What takes a connection without ever asking for anything must not keep others out.
        ("grpc.max_allowed_incoming_connections", 4 * options.max_clients + 32),
        ("grpc.server_handshake_timeout_ms", _HANDSHAKE_MS),
        ("grpc.max_connection_idle_ms", _IDLE_MS),
        ("grpc.keepalive_time_ms", keepalive_ms),
        ("grpc.keepalive_timeout_ms", keepalive_ms // 2),
        ("grpc.http2.ping_timeout_ms", keepalive_ms // 2),  # else any other ping on its way puts it off to a minute
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.max_pings_without_data", 0),
        ("grpc.http2.min_recv_ping_interval_without_data_ms", _LEAST_PING_MS),
    ]


def _check_address(options: ServiceOptions) -> None:
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
        raise _cannot_listen(options, error.strerror or type(error).__name__) from None
    except ValueError:  # what cannot be a name
        raise _cannot_listen(options, "no host's name") from None


def _cannot_listen(options: ServiceOptions, reason: str) -> ServiceError:
    """What is raised."""
    return ServiceError(
        f"{options.address}: cannot be listened on ({reason}); choose a port that nobody uses, and an address of this "
        "machine"
    )


class DaemonPool(Executor):
    """As `concurrent.futures.ThreadPoolExecutor`, but of daemon threads.

    The standard one's are waited for when a program ends, and one with an open stream would never end.

    Args:
        most: threads at a time; they are started when they are needed.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._idle = 0
        self._work: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._is_shut = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call a function in one of the threads.

        Raises:
            RuntimeError: after `shutdown`, as the standard one.
        """
        future: Future[Any] = Future()

        def run() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(fn(*args, **kwargs))
            except BaseException as error:
                future.set_exception(error)

        with self._lock:
            if self._is_shut:
                raise RuntimeError("cannot schedule new futures after shutdown")
            self._work.put(run)
            if self._idle > 0:
                self._idle -= 1
            elif len(self._threads) < self._most:
                thread = threading.Thread(target=self._serve, name=f"grpc-{len(self._threads)}", daemon=True)
                self._threads.append(thread)
                thread.start()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more work; what was taken is done."""
        with self._lock:
            self._is_shut = True
            for _ in self._threads:
                self._work.put(None)
        if wait:
            for thread in self._threads:
                thread.join()

    def _serve(self) -> None:
        while (run := self._work.get()) is not None:
            run()
            with self._lock:
                self._idle += self._work.empty()
