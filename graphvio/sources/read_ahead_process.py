"""Preparation of results ahead of their use in a separate process, which shares neither interpreter nor heap.

Decoding images in threads slows down the odometry in the same process: the threads take turns at the interpreter some
hundred times per frameset, and each turn moves its state to another core. A process costs one copy of the images.

The process is forked, so that it need not import anything, and common data are in memory only once.
"""

from __future__ import annotations

import logging
import mmap
import multiprocessing
import os
import pickle
import signal
import sys
import warnings
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from graphvio.runtime import HeldInterrupt, ignore_interrupts, usable_cores
from graphvio.sources.read_ahead import read_ahead

T = TypeVar("T")
R = TypeVar("R")

_log = logging.getLogger(__name__)
_TIMEOUT_S = 60.0  # a forked process may wait forever for a lock that another thread held
_NICENESS = 5  # lower priority: results are prepared ahead of time, and their consumer comes first


def can_fork() -> bool:
    """Return whether a process can be forked here and has a core to itself: on Linux, with at least two cores."""
    return sys.platform == "linux" and usable_cores() > 1


def read_ahead_in_process(
    work: Callable[[T], R], items: Sequence[T], buffer_bytes: int, depth: int = 8
) -> Generator[R, None, None]:
    """Yield ``map(work, items)``, with results prepared ahead in a forked process; only where `can_fork`.

    If the process cannot be started or ends early, threads of this process continue from the result that is due, as
    `read_ahead` does. An exception of ``work`` ends the process, and is raised here. The process ends when the iterator
    is exhausted, closed or collected, and with this process at the latest.

    Args:
        work: function that is called in the process; it must not use files and locks of other threads.
        items: items that it is called with.
        buffer_bytes: room for the arrays of one result; larger results take longer.
        depth: how many results may wait.
    """
    done = 0
    try:
        process = _Process(work, items, buffer_bytes, depth)
    except OSError as error:
        _log.warning("no process can be started to read ahead (%s): reading goes on in threads, more slowly", error)
    else:
        with closing(process):
            while done < len(items) and (results := process.take()):
                yield results[0]
                done += 1
    if done < len(items):
        with closing(read_ahead(work, items[done:], depth)) as remaining:
            yield from remaining


class _Process:
    """The forked process, and the shared memory through which the arrays of its results are passed."""

    def __init__(self, work: Callable[[T], Any], items: Sequence[T], buffer_bytes: int, depth: int) -> None:
        self._slots = _Slots(buffer_bytes, depth)
        context = multiprocessing.get_context("fork")
        self._results, results = context.Pipe(duplex=False)
        freed, self._freed = context.Pipe(duplex=False)

        def serve() -> None:
            self._results.close()  # so that the pipes end with the parent
            self._freed.close()
            _serve(work, items, self._slots, results, freed)

        self._process = context.Process(target=serve, name="graphvio-read", daemon=True)
        with HeldInterrupt() as interrupt, warnings.catch_warnings():  # Python drops errors while it forks
            warnings.simplefilter("ignore", DeprecationWarning)  # on locks that threads hold: there is a timeout
            self._process.start()
        results.close()
        freed.close()
        interrupt.check()

    def take(self) -> list[Any]:
        """Wait for the next result; returns a list with it, or an empty one if none will come."""
        try:
            if not self._results.poll(_TIMEOUT_S):
                raise TimeoutError
            message = self._results.recv()
        except (EOFError, OSError):
            _log.warning("the process that reads ahead ended early or hangs: reading goes on in threads, more slowly")
            return []
        if message is None:
            return []
        result = self._slots.load(*message)
        with suppress(BrokenPipeError):  # the process has sent all results
            self._freed.send_bytes(b"1")
        return [result]

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._results.close()
        self._freed.close()


class _Slots:
    """Memory that two processes share, divided into slots, each with room for the arrays of one result."""

    def __init__(self, slot_bytes: int, depth: int) -> None:
        self.depth = depth
        self._slot_bytes = slot_bytes
        self._memory = mmap.mmap(-1, slot_bytes * depth)
        self._at = 0

    def store(self, result: Any) -> tuple[list[int], bytes]:
        """Store the arrays of a result in the next slot; return their sizes, and the pickled result without them."""
        buffers: list[pickle.PickleBuffer] = []
        pickled = pickle.dumps(result, protocol=5, buffer_callback=buffers.append)
        views = [buffer.raw() for buffer in buffers]
        if sum(view.nbytes for view in views) > self._slot_bytes:
            views, pickled = [], pickle.dumps(result, protocol=5)
        at = self._next()
        for view in views:
            self._memory[at : at + view.nbytes] = view
            at += view.nbytes
        return [view.nbytes for view in views], pickled

    def load(self, sizes: list[int], pickled: bytes) -> Any:
        """Return the result whose arrays are in the next slot; they are copied, so that the slot is free afterwards."""
        at, buffers = self._next(), []
        with memoryview(self._memory) as memory:
            for size in sizes:
                buffers.append(bytearray(memory[at : at + size]))
                at += size
        return pickle.loads(pickled, buffers=buffers)

    def _next(self) -> int:
        at = self._at
        self._at = (at + self._slot_bytes) % (self._slot_bytes * self.depth)
        return at


def _serve(work: Callable[[T], Any], items: Sequence[T], slots: _Slots, results: Connection, freed: Connection) -> None:
    """Send the results of all items to the parent; send None and end if ``work`` fails."""
    ignore_interrupts()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.nice(_NICENESS)
    with suppress(EOFError, BrokenPipeError):  # the parent has ended
        for number, item in enumerate(items):
            if number >= slots.depth:
                freed.recv_bytes()
            try:
                message = slots.store(work(item))
            except Exception:  # the parent calls `work` itself, and raises it
                results.send(None)
                return
            results.send(message)
