"""A stage of the live system: a thread that tells whether it lives, and what ended it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Stage:
    """A thread that works on one thing after the other.

    Args:
        name: of it, for people.
        body: runs until there is nothing more to do; does each piece of its work inside `working`.
        on_failure: is called, in the thread, with what ended the body before its time.
    """

    def __init__(self, name: str, body: Callable[[Stage], None], on_failure: Callable[[Stage, BaseException], None]):
        self.name = name
        self.failure: BaseException | None = None
        self._body = body
        self._on_failure = on_failure
        self._busy_since_s: float | None = None
        self._thread = threading.Thread(target=self._run, name=f"graphvio-{name}", daemon=True)

    @contextmanager
    def working(self) -> Iterator[None]:
        """Around each piece of work, so that one that does not end is noticed."""
        self._busy_since_s = time.monotonic()
        try:
            yield
        finally:
            self._busy_since_s = None

    @property
    def busy_s(self) -> float:
        """How long the present piece of work has taken so far."""
        since = self._busy_since_s
        return 0.0 if since is None else time.monotonic() - since

    @property
    def is_alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait for its end; whether it has ended."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._body(self)
        except BaseException as error:  # whatever it is, the others must hear of it
            self.failure = error
            self._on_failure(self, error)
        finally:
            self._busy_since_s = None
