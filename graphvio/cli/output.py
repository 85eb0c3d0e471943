"""Standard output and stderr as commands see them: streams that take every line, also where none can be written."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, TextIO, cast


class LastingStream:
    """A text stream of which a failure ends nothing: the full disk of its file, or a reader that has left its pipe.

    What is written afterwards is thrown away, so that a command still writes its results.

    Attributes:
        error: the failure, or None.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        """Write a text, or throw it away."""
        try:
            return self._stream.write(text)
        except OSError as error:
            self._give_up(error)
            return len(text)

    def flush(self) -> None:
        """Write what is buffered, or throw it away."""
        try:
            self._stream.flush()
        except OSError as error:
            self._give_up(error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _give_up(self, error: OSError) -> None:
        self.error = error
        with Path(os.devnull).open("wb") as nowhere:  # takes what is still buffered, too
            os.dup2(nowhere.fileno(), self._stream.fileno())


@contextmanager
def lasting_streams() -> Iterator[LastingStream | None]:
    """Let failures of standard output and stderr end nothing inside.

    Yields standard output, None where the process has none.
    """
    out, err = (None if stream is None else LastingStream(stream) for stream in (sys.stdout, sys.stderr))
    with redirect_stdout(cast(TextIO, out)), redirect_stderr(cast(TextIO, err)):
        try:
            yield out
        finally:
            for stream in (out, err):
                if stream is not None:
                    stream.flush()
