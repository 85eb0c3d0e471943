"""Which streams are open, whose they are, and whether they are read."""

from __future__ import annotations

import threading
import time

from graphvio.errors import ServiceError

RUN_KEY = "graphvio-run"  # first metadata of a stream: it is open, though its first message may be long in coming
STREAMS_OF_A_CLIENT = 4


class Stream:
    """One that is open.

    Args:
        client: whose it is.

    Attributes:
        taken_s: when its client last took a message, or opened it, by `time.monotonic`.
    """

    def __init__(self, client: str) -> None:
        self.client = client
        self.taken_s = time.monotonic()

    def taken(self) -> None:
        """The client has taken a message."""
        self.taken_s = time.monotonic()


class StreamLimit:
    """Lets in so many clients with streams, and so many streams of each.

    Args:
        max_clients: at a time.
    """

    def __init__(self, max_clients: int) -> None:
        self._max_clients = max_clients
        self._lock = threading.Lock()
        self._streams: set[Stream] = set()

    @property
    def open_streams(self) -> int:
        """How many there are now."""
        with self._lock:
            return len(self._streams)

    def is_read_since(self, since_s: float) -> bool:
        """Whether any client has taken a message after a time of `time.monotonic`."""
        with self._lock:
            return any(stream.taken_s > since_s for stream in self._streams)

    def enter(self, client: str) -> Stream:
        """Count a stream of a client.

        Raises:
            ServiceError: if there is no room.
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
        """A stream that was counted has ended."""
        with self._lock:
            self._streams.remove(stream)
