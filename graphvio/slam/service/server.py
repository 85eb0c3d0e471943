"""The gRPC server of a running odometry."""

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
from graphvio.slam.service import grpc
from graphvio.slam.service.calls import handlers
from graphvio.slam.service.options import ServiceOptions
from graphvio.slam.service.security import MalformedInterceptor, read_token, server_credentials, token_interceptor
from graphvio.slam.service.servicer import STREAMS_OF_A_CLIENT, Servicer, StreamLimit

_CALL_THREADS = 8  # threads for calls other than streams
_MAX_WAITING_CALLS = 64
_MAX_REQUEST_BYTES = 64 * 2**10
_MAX_METADATA_BYTES = 16 * 2**10
_HANDSHAKE_MS = 5_000
_MAX_IDLE_MS = 300_000
_MIN_PING_MS = 4_000
READ_S = 60.0  # time for clients to read the last messages of an odometry that has ended
_STALLED_S = 5.0  # if no message is read for this time, the streams count as stalled
_CUT_S = 0.5  # time for streams and calls to notice that the server stops
_POLL_S = 0.05


def check(options: ServiceOptions) -> None:
    """Check that a server could be started, without starting one.

    Raises:
        ServiceError: If the address is in use or not this machine's, or token, certificate or key are unusable.
    """
    _check_address(options)
    server_credentials(options)
    if options.token_file is not None:
        read_token(options.token_file)


class GrpcServer:
    """Server of a running odometry, from which it only reads, and to which it passes corrections; a context manager.

    Raises:
        MissingExtraError: On import of the module, if grpcio is not installed.
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
        """``HOST:PORT`` of the server, with the port that was chosen for port 0."""
        return f"{self._options.address.rpartition(':')[0]}:{self._port or self._options.port}"

    @property
    def open_streams(self) -> int:
        """Number of open streams of all clients."""
        return self._limit.open_streams

    def start(self) -> None:
        """Start to listen and to serve clients, in threads of the server.

        Raises:
            ServiceError: If the address is in use or not this machine's, or token, certificate or key are unusable.
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
            maximum_concurrent_rpcs=threads + _MAX_WAITING_CALLS,
        )
        self._stopping = threading.Event()
        servicer = Servicer(self._served, self._run_id, self._limit, self._stopping)
        server.add_generic_rpc_handlers((handlers(servicer),))
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

    def drain(self, timeout_s: float = READ_S) -> bool:
        """Wait until clients have read the streams of an odometry that has ended, as long as messages are read.

        The wait ends early if no message is read for 5 s.

        Returns:
            Whether all streams have been read to their end.
        """
        begun_s = time.monotonic()
        while self.open_streams and (now_s := time.monotonic()) - begun_s < timeout_s:
            if now_s - begun_s > _STALLED_S and not self._limit.is_read_since(now_s - _STALLED_S):
                break
            time.sleep(_POLL_S)
        return not self.open_streams

    def stop(self, grace_s: float = READ_S) -> None:
        """Stop the server and end all streams; idempotent."""
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
        ("grpc.so_reuseport", 0),  # otherwise a second server on the port would get half of the clients
        ("grpc.max_receive_message_length", _MAX_REQUEST_BYTES),
        ("grpc.max_send_message_length", -1),
        ("grpc.max_metadata_size", _MAX_METADATA_BYTES),
        ("grpc.max_concurrent_streams", STREAMS_OF_A_CLIENT + _CALL_THREADS),
        # Connections without calls must not keep others out.
        ("grpc.max_allowed_incoming_connections", 4 * options.max_clients + 32),
        ("grpc.server_handshake_timeout_ms", _HANDSHAKE_MS),
        ("grpc.max_connection_idle_ms", _MAX_IDLE_MS),
        ("grpc.keepalive_time_ms", keepalive_ms),
        ("grpc.keepalive_timeout_ms", keepalive_ms // 2),
        ("grpc.http2.ping_timeout_ms", keepalive_ms // 2),  # else any other ping in flight delays this to a minute
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.max_pings_without_data", 0),
        ("grpc.http2.min_recv_ping_interval_without_data_ms", _MIN_PING_MS),
    ]


def _check_address(options: ServiceOptions) -> None:
    """Check that the address can be bound: gRPC would write lines of its own to the terminal if not."""
    try:
        found = socket.getaddrinfo(options.bare_host, options.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, kind, protocol, _, address in found:
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port that was just closed is free
                probe.bind(address)
    except OSError as error:
        raise _cannot_listen(options, error.strerror or type(error).__name__) from None
    except ValueError:
        raise _cannot_listen(options, "not a host name") from None


def _cannot_listen(options: ServiceOptions, reason: str) -> ServiceError:
    return ServiceError(
        f"{options.address}: cannot be listened on ({reason}); choose a free port, and an address of this machine"
    )


class DaemonPool(Executor):
    """A thread pool like `concurrent.futures.ThreadPoolExecutor`, but with daemon threads.

    A program waits for the threads of the standard pool when it ends; with an open stream it would wait forever.
    """

    def __init__(self, max_threads: int) -> None:
        self._max_threads = max_threads
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._idle = 0
        self._work: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._is_shut = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call a function in one of the threads; see `concurrent.futures.Executor.submit`."""
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
            elif len(self._threads) < self._max_threads:
                thread = threading.Thread(target=self._serve, name=f"grpc-{len(self._threads)}", daemon=True)
                self._threads.append(thread)
                thread.start()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Accept no more work; submitted work is still done. See `concurrent.futures.Executor.shutdown`."""
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
