"""Writer of MCAP files that lose at most the last second in a crash."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path
from typing import Any, BinaryIO

from graphvio.errors import importing
from graphvio.sessions import cdr
from graphvio.sessions.storage import exists_error, not_writable_error
from graphvio.version import __version__

LIBRARY = "graphvio"

_CHUNK_BYTES = 4 * 1024 * 1024
_FLUSH_S = 0.5  # so that at most a second is lost
_ENCODING, _SCHEMA_ENCODING, _PROFILE = "cdr", "ros2msg", "ros2"


class McapStorage:
    """An MCAP file with ROS 2 messages."""

    has_attachments = True
    is_readable_when_cut = True

    def __init__(self, path: Path) -> None:
        self.path = path
        self._channels: dict[str, tuple[int, int]] = {}  # topic -> channel, messages so far
        self._schemas: dict[str, int] = {}
        writer = _writer_class()
        try:
            self._file: BinaryIO = path.open("xb")
        except FileExistsError:
            raise exists_error(path) from None
        except OSError as error:
            raise not_writable_error(path, error) from None
        self._mcap = writer(self._file)
        self._mcap.start(_PROFILE, f"{LIBRARY} {__version__}")  # buffered: nothing is written to the disk yet
        self._last_flush_s = time.monotonic()
        self._closing = threading.Event()
        self._syncing = threading.Thread(target=self._sync, name="graphvio-session", daemon=True)
        self._syncing.start()

    def attach(self, name: str, text: str) -> None:
        """Store a text before all messages: see `Storage`."""
        self._mcap.add_attachment(0, 0, name, "application/yaml", text.encode())
        self._file.flush()

    def write(self, topic: str, stamp_ns: int, message: Any, is_latched: bool) -> None:
        """Store a message: see `Storage`. All messages so far are flushed to the file twice a second."""
        if topic not in self._channels:
            name = message.__msgtype__
            if name not in self._schemas:
                self._schemas[name] = self._mcap.register_schema(name, _SCHEMA_ENCODING, cdr.definition(name))
            self._channels[topic] = self._mcap.register_channel(topic, _ENCODING, self._schemas[name]), 0
        channel, count = self._channels[topic]
        self._channels[topic] = channel, count + 1
        self._mcap.add_message(channel, stamp_ns, cdr.encode(message), stamp_ns, count)
        now_s = time.monotonic()
        if now_s - self._last_flush_s >= _FLUSH_S:
            self._last_flush_s = now_s
            self._mcap.flush()  # ends the chunk, which the library otherwise does by size only

    def finish(self) -> None:
        """Write the summary."""
        self._mcap.finish()

    def close(self) -> None:
        """Close the file."""
        self._closing.set()
        self._syncing.join()
        self._file.close()

    def _sync(self) -> None:
        """Sync the file with the disk, as a flush does not survive a power failure."""
        while not self._closing.wait(_FLUSH_S):
            try:
                os.fsync(self._file.fileno())
            except (OSError, ValueError):
                return


def _writer_class() -> Any:
    with importing("mcap", "sessions", "reading or writing a session"):
        from mcap.writer import CompressionType, Writer
    return lambda file: Writer(file, chunk_size=_CHUNK_BYTES, compression=CompressionType.LZ4)
