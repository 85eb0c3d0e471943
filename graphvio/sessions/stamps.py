"""Stamps of messages: those of their headers, and how far they are to be trusted."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from graphvio.arrays import Int
from graphvio.sessions import cdr
from graphvio.sessions.mcap_file import Place, Topic, stamps_of
from graphvio.sessions.mcap_storage import LIBRARY


class Store(Protocol):
    """A file with messages by topic."""

    library: str

    def read(self, place: Place) -> bytes:
        """A message."""


def header_stamps(store: Store, topic: Topic) -> Int:
    """Stamps (N,) of the headers of a topic's messages, in the order of the file.

    graphvio's own sessions are logged by them, and bags have been read for them; other files are read here.

    Raises:
        SessionError: if a message cannot be read.
    """
    if store.library.startswith(LIBRARY):
        return stamps_of(topic)
    if topic.header_ns:
        return np.array(topic.header_ns, dtype=np.int64)
    return np.array([cdr.stamp_ns(store.read(place)) for place in topic.places], dtype=np.int64)
