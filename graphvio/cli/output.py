"""Streams in place of standard output and stderr that raise no error where nothing can be written."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, TextIO, cast


class LastingStream:
    """A text stream that raises no error when writing fails, because a disk is full or the reader of a pipe has gone.

    Text that is written after the failure is discarded, so that a command still writes its results.

    Attributes:
        error: the error of the write that failed, or None.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        """Write a text, or discard it if that fails; return the number of characters."""
        try:
            return self._stream.write(text)
        except OSError as error:
            self._give_up(error)
            return len(text)

    def flush(self) -> None:
        """Write the buffered text, or discard it if that fails."""
        try:
            self._stream.flush()
        except OSError as error:
            self._give_up(error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _give_up(self, error: OSError) -> None:
        self.error = error
        with Path(os.devnull).open("wb") as nowhere:  # receives the text that is still buffered, too
            os.dup2(nowhere.fileno(), self._stream.fileno())


@contextmanager
def lasting_streams() -> Iterator[LastingStream | None]:
    """Replace standard output and stderr within the block by a `LastingStream` each.

    Yields standard output, or None if the process has none.
    """
    out, err = (None if stream is None else LastingStream(stream) for stream in (sys.stdout, sys.stderr))
    with redirect_stdout(cast(TextIO, out)), redirect_stderr(cast(TextIO, err)):
        try:
            yield out
        finally:
            for stream in (out, err):
                if stream is not None:
                    stream.flush()
