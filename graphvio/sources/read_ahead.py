"""Preparation of results ahead of their use, in threads: bounded, in order, and ended with the consumer."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def read_ahead(work: Callable[[T], R], items: Iterable[T], depth: int = 8) -> Generator[R, None, None]:
    """Yield ``map(work, items)``, with results prepared ahead in two threads.

    The items are made in the calling thread, at most ``depth`` of them before their results are taken. An exception of
    ``work`` is raised where its result is due. The threads end when the iterator is exhausted, closed or collected.
    """
    waiting: deque[Future[R]] = deque()
    pool = ThreadPoolExecutor(2, thread_name_prefix="graphvio-read")
    try:
        source = iter(items)
        for item in islice(source, depth):
            waiting.append(pool.submit(work, item))
        while waiting:
            result = waiting.popleft().result()
            for item in islice(source, 1):  # refill first, so that the threads work while the consumer does
                waiting.append(pool.submit(work, item))
            yield result
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
