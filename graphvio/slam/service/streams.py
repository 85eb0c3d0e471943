"""How many streams are open, and whose."""

from __future__ import annotations

import threading
from collections import Counter

from graphvio.errors import ServiceError

RUN_KEY = "graphvio-run"  # first metadata of a stream: it is open, though its first message may be long in coming
STREAMS_OF_A_CLIENT = 4


class StreamLimit:
    """Lets in so many clients with streams, and so many streams of each.

    Args:
        max_clients: at a time.
    """

    def __init__(self, max_clients: int) -> None:
        self._max_clients = max_clients
        self._lock = threading.Lock()
        self._streams: Counter[str] = Counter()

    @property
    def open_streams(self) -> int:
        """How many there are now."""
        with self._lock:
            return self._streams.total()

    def enter(self, client: str) -> None:
        """Count a stream of a client.

        Raises:
            ServiceError: if there is no room.
        """
        with self._lock:
            if client not in self._streams and len(self._streams) >= self._max_clients:
                raise ServiceError(
                    f"{self._max_clients} clients have streams already; end one, or raise the server's max_clients"
                )
            if self._streams[client] >= STREAMS_OF_A_CLIENT:
                raise ServiceError(f"a connection may have {STREAMS_OF_A_CLIENT} streams at a time; end one")
            self._streams[client] += 1

    def leave(self, client: str) -> None:
        """A stream that was counted has ended."""
        with self._lock:
            self._streams[client] -= 1
            if not self._streams[client]:
                del self._streams[client]
