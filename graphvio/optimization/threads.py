"""Work on many items in two threads, in bounded memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

A = TypeVar("A")
B = TypeVar("B")

_THREADS = 2
_MAX_PENDING = 4  # items that are processed at a time, or whose results wait


def in_threads(function: Callable[[A], B], items: Iterable[A], name: str) -> Iterator[B]:
    """Yield ``function(item)`` of all items, in their order; the items are made in the calling thread.

    Args:
        function: called in threads.
        items: iterated a few items ahead of the results.
        name: of the threads.
    """
    with ThreadPoolExecutor(_THREADS, thread_name_prefix=name) as pool:
        pending: deque[Future[B]] = deque()
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) == _MAX_PENDING:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
