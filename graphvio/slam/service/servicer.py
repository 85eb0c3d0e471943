"""The service's implementation of the calls, which run in threads of the server's pool, never in the odometry's."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

from graphvio.errors import GraphvioError, ServiceError
from graphvio.measurements.estimate import Estimate, Prediction
from graphvio.queues import BoundedQueue, Broadcast
from graphvio.slam.checks import check_covariance, check_pose
from graphvio.slam.interface import Served, map_of_epoch, newest_epoch
from graphvio.slam.keyframe_log import KeyframeLog
from graphvio.slam.service import convert, grpc, messages
from graphvio.slam.service.arrays import floats, packed
from graphvio.slam.service.options import RUN_KEY
from graphvio.version import __version__

_POLL_S = 0.25  # time within which a stream notices that its client is gone or the server stops
_MAX_WAITING = {messages.RATE_FRAME: 2, messages.RATE_IMU: 16}
_MAX_WAITING_EVENTS = 256
STREAMS_OF_A_CLIENT = 4
_log = logging.getLogger(__name__)
T = TypeVar("T")


@dataclass(eq=False)
class Stream:
    """An open stream of messages to a client."""

    client: str  # address of its client
    # when the client last read a message, or opened the stream, by `time.monotonic`
    read_s: float = field(default_factory=time.monotonic)


class StreamLimit:
    """The open streams, whose number is limited per client, as is the number of clients with streams."""

    def __init__(self, max_clients: int) -> None:
        self._max_clients = max_clients
        self._lock = threading.Lock()
        self._streams: set[Stream] = set()

    @property
    def open_streams(self) -> int:
        """Number of open streams."""
        with self._lock:
            return len(self._streams)

    def is_read_since(self, since_s: float) -> bool:
        """Return whether any client has read a message after a time of `time.monotonic`."""
        with self._lock:
            return any(stream.read_s > since_s for stream in self._streams)

    def enter(self, client: str) -> Stream:
        """Add and return a stream of a client.

        Raises:
            ServiceError: if there are too many clients, or the client has too many streams.
        """
        with self._lock:
            clients = {stream.client for stream in self._streams}
            if client not in clients and len(clients) >= self._max_clients:
                raise ServiceError(
                    f"{self._max_clients} clients have streams already; end one, or raise the server's max_clients"
                )
            if sum(stream.client == client for stream in self._streams) >= STREAMS_OF_A_CLIENT:
                raise ServiceError(f"a connection may have {STREAMS_OF_A_CLIENT} streams at a time; end one")
            stream = Stream(client)
            self._streams.add(stream)
            return stream

    def leave(self, stream: Stream) -> None:
        """Remove a stream that has ended."""
        with self._lock:
            self._streams.remove(stream)


class Servicer:
    """Answers the calls for one odometry; ``stopping`` is set when streams must end although the odometry goes on."""

    def __init__(self, served: Served, run_id: str, limit: StreamLimit, stopping: threading.Event) -> None:
        self._served = served
        self._run_id = run_id
        self._limit = limit
        self._stopping = stopping
        self._rig_text = convert.rig_text(served.rig)

    def GetInfo(self, request: Any, context: Any) -> Any:
        """Return the state of the odometry; see the proto for requests and answers."""
        log = self._served.keyframe_log
        return messages.Info(
            version=__version__,
            rig_yaml=self._rig_text,
            run_id=self._run_id,
            epoch=newest_epoch(self._served),
            oldest_keyframe_id=log.oldest_id,
            next_keyframe_id=log.next_id,
            has_ended=log.is_closed,
        )

    def GetStatus(self, request: Any, context: Any) -> Any:
        """Return the figures of the run."""
        return _answer(context, lambda: convert.status_message(self._served.status()))

    def StreamEstimates(self, request: Any, context: Any) -> Iterator[Any]:
        """Yield estimates or predictions from now on."""
        broadcast: Broadcast[Any]
        if request.rate == messages.RATE_FRAME:
            broadcast = self._served.estimates
        elif request.rate == messages.RATE_IMU:
            broadcast = self._served.predictions
        else:
            context.abort(grpc.StatusCode.INVALID_ARGUMENT, "rate: choose RATE_FRAME or RATE_IMU")
        with self._stream(request, context) as stream:
            for state, missed in self._listen(broadcast, _MAX_WAITING[request.rate], stream, context):
                yield self._update(state, missed)

    def StreamKeyframes(self, request: Any, context: Any) -> Iterator[Any]:
        """Yield keyframes from an id on."""
        if request.from_id < 0:
            context.abort(grpc.StatusCode.INVALID_ARGUMENT, f"from_id is {request.from_id}; the first keyframe is 0")
        log = self._served.keyframe_log
        next_id = request.from_id
        with self._stream(request, context) as stream:
            while context.is_active():
                keyframe = log.read(next_id, _POLL_S)
                if keyframe is not None:
                    message = convert.keyframe_message(keyframe, request.with_images, request.with_descriptors)
                    yield messages.KeyframeUpdate(keyframe=message, gone=keyframe.id - next_id)
                    stream.read_s = time.monotonic()  # gRPC asks for the next message: this one is sent
                    next_id = keyframe.id + 1
                elif log.is_closed and log.next_id <= next_id:
                    return
                self._abort_if_stopping(log, context)

    def StreamEvents(self, request: Any, context: Any) -> Iterator[Any]:
        """Yield events from now on."""
        with self._stream(request, context) as stream:
            for event, missed in self._listen(self._served.events, _MAX_WAITING_EVENTS, stream, context):
                yield convert.event_message(event, missed)

    def Correct(self, request: Any, context: Any) -> Any:
        """Check the form of a correction, and pass it to the odometry."""
        self._check_run(request, context)
        try:
            if request.keyframe_id < 0:
                raise ServiceError(f"keyframe_id is {request.keyframe_id}; the first keyframe is 0")
            map_T_body = floats(request.map_T_body, (4, 4), "map_T_body")
            covariance = floats(request.covariance, (6, 6), "covariance")
            check_pose(map_T_body, "map_T_body")
            check_covariance(covariance, "covariance")
        except GraphvioError as error:
            context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))
        return _answer(
            context,
            lambda: convert.result_message(self._served.correct(request.keyframe_id, map_T_body, covariance)),
        )

    def _update(self, state: Estimate | Prediction, missed: int) -> Any:
        update = messages.EstimateUpdate(map_T_odom=packed(map_of_epoch(self._served, state.epoch)), missed=missed)
        if isinstance(state, Estimate):
            update.estimate.CopyFrom(convert.estimate_message(state))
        else:
            update.prediction.CopyFrom(convert.prediction_message(state))
        return update

    def _listen(self, broadcast: Broadcast[T], depth: int, stream: Stream, context: Any) -> Iterator[tuple[T, int]]:
        """Yield items as they come, each with the number of items dropped before it."""
        subscription = broadcast.subscribe(depth)
        reported = 0
        try:
            while context.is_active():
                was_closed = subscription.is_closed
                item = subscription.get(_POLL_S)
                if item is not None:
                    missed = subscription.dropped()
                    yield item, missed - reported
                    stream.read_s = time.monotonic()
                    reported = missed
                elif was_closed:
                    return
                self._abort_if_stopping(subscription, context)
        finally:
            subscription.close()

    @contextmanager
    def _stream(self, request: Any, context: Any) -> Iterator[Stream]:
        self._check_run(request, context)
        try:
            stream = self._limit.enter(context.peer())
        except ServiceError as error:
            context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, str(error))
        try:
            # Sent before the first message, which may come late: the client knows that the stream is open.
            context.send_initial_metadata(((RUN_KEY, self._run_id),))
            yield stream
        finally:
            self._limit.leave(stream)

    def _check_run(self, request: Any, context: Any) -> None:
        if request.run_id not in ("", self._run_id):
            context.abort(
                grpc.StatusCode.FAILED_PRECONDITION,
                "another run of the odometry is served now, with other keyframes; connect again",
            )

    def _abort_if_stopping(self, read: KeyframeLog | BoundedQueue[Any], context: Any) -> None:
        """End a stream if the server stops; the stream of an odometry that has ended may be read to its end."""
        if self._stopping.is_set() and not read.is_closed:  # in this order: odometries end before their server
            context.abort(grpc.StatusCode.UNAVAILABLE, "the server stops")


def _answer(context: Any, make: Callable[[], Any]) -> Any:
    try:
        return make()
    except GraphvioError as error:
        code, text = grpc.StatusCode.FAILED_PRECONDITION, str(error)
    except Exception as error:
        _log.exception("a call failed")
        code, text = grpc.StatusCode.INTERNAL, f"the server failed ({type(error).__name__}); see its log"
    return context.abort(code, text)
