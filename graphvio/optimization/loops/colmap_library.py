"""COLMAP's Python library, an optional dependency."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from graphvio.errors import OptimizationError, importing
from graphvio.runtime import has_mixed_zlib

CENTRE_PX = 0.5
"""COLMAP's coordinate of the centre of an image's first pixel."""


def colmap() -> Any:
    """Import and return pycolmap, set to log warnings and errors only.

    Raises:
        OptimizationError: if it was imported in an order that corrupts memory.
        MissingExtraError: if the extra ``maps`` is not installed.
    """
    with importing("pycolmap", "maps", "loop closure and maps"):
        import pycolmap
    if has_mixed_zlib():
        raise OptimizationError("pycolmap was imported before zlib, by which Python crashes; import graphvio before it")
    if threading.current_thread() is threading.main_thread():  # glog would print a stack at SIGTERM
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
    pycolmap.logging.minloglevel = pycolmap.logging.Level.WARNING.value
    return pycolmap


@contextmanager
def only_errors_logged() -> Iterator[None]:
    """Keep COLMAP from logging warnings inside the context."""
    logging = colmap().logging
    before = logging.minloglevel
    logging.minloglevel = logging.Level.ERROR.value
    try:
        yield
    finally:
        logging.minloglevel = before
