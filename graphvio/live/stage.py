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
        at_end: is called, in the thread, after the body and what follows a failure.
    """

    def __init__(
        self,
        name: str,
        body: Callable[[Stage], None],
        on_failure: Callable[[Stage, BaseException], None],
        at_end: Callable[[], None],
    ) -> None:
        self.name = name
        self.failure: BaseException | None = None
        self._body = body
        self._on_failure = on_failure
        self._at_end = at_end
        self._busy_since_s: float | None = None
        self._done = 0
        self._thread = threading.Thread(target=self._run, name=f"graphvio-{name}", daemon=True)

    @contextmanager
    def working(self) -> Iterator[None]:
        """Around each piece of work, so that one that does not end is noticed."""
        self._busy_since_s = time.monotonic()
        try:
            yield
        finally:
            self._busy_since_s = None
            self._done += 1

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Inside of `working`, around waiting for the next stage: that one is stuck then, and this one is not."""
        is_working = self._busy_since_s is not None
        self._busy_since_s = None
        try:
            yield
        finally:
            self._busy_since_s = time.monotonic() if is_working else None

    def get_on(self) -> None:
        """Inside of `working`: a part of the work is done, and the next one begins."""
        self._busy_since_s = time.monotonic()
        self._done += 1

    @property
    def done(self) -> int:
        """How many pieces or parts of work have ended, one way or another."""
        return self._done

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
            self._at_end()
