"""Ctrl-C, also while compiled code runs."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self

from graphvio.errors import MissingExtraError


@contextmanager
def interruptible() -> Iterator[None]:
    """Has Ctrl-C end what is inside by `KeyboardInterrupt`, whatever it came in the middle of.

    Compiled kernels that it meets end by a `SystemError` in whose chain of causes it is, compiled libraries that are
    being loaded by an `ImportError`, which may have been taken for a library that is missing.
    """
    try:
        yield
    except (SystemError, ImportError, MissingExtraError) as error:
        if not _is_interrupt(error):
            raise
        raise KeyboardInterrupt from error


class HeldInterrupt:
    """Ctrl-C is held back inside, until it is asked for by `check`, so that nothing is left half written.

    A second one is not. Outside of the main thread, and where Ctrl-C is ignored, nothing changes.
    """

    def __init__(self) -> None:
        self._came = False
        self._before: Any = None

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) not in (
            signal.SIG_IGN,
            None,
        ):
            self._before = signal.signal(signal.SIGINT, self._hold)
        return self

    def __exit__(self, *_: object) -> None:
        self._let_go()

    def check(self) -> None:
        """End what is inside, if Ctrl-C came.

        Raises:
            KeyboardInterrupt: if it did.
        """
        if self._came:
            raise KeyboardInterrupt

    def _hold(self, *_: object) -> None:
        self._came = True
        self._let_go()

    def _let_go(self) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)
            self._before = None


def _is_interrupt(error: BaseException) -> bool:
    """Whether a Ctrl-C is in the chain of an error's causes."""
    waiting: list[BaseException | None] = [error]
    seen: set[int] = set()
    while waiting:
        at = waiting.pop()
        if at is None or id(at) in seen:
            continue
        if isinstance(at, KeyboardInterrupt):
            return True
        seen.add(id(at))
        waiting += [at.__cause__, at.__context__]
    return False
