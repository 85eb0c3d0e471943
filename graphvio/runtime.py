"""Settings of the whole process: threads, memory and signals.

No object of the library changes the process that it runs in. The command line makes the settings of this module; a
program that embeds graphvio chooses among them:

- `set_up_threads`, since front-end and self-calibration have threads, with which OpenCV's would compete, and which
  would wait for each other for milliseconds;
- `limit_blas_threads` before numpy is imported, since BLAS would start threads of its own for matrices of some hundred
  rows;
- `share_heap` before threads are started, where images pass through many threads for hours;
- `interruptible` around calls that Ctrl-C should end, even while compiled code runs;
- `StopSignals`, `HeldInterrupt`, `on_interrupt` and the functions below them, for loops that must end cleanly.

Compiled kernels are cached in the folder that the environment variable ``GRAPHVIO_CACHE_DIR`` names, see
`graphvio.kernel_cache.cache_root`.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self

from graphvio.errors import MissingExtraError

_M_ARENA_MAX = -8  # defined in glibc's malloc.h
_SWITCH_INTERVAL_S = 0.0005
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)

# ---------------------------------------------------------------------- threads and memory


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def set_up_threads() -> None:
    """Switch off OpenCV's threads in this process, and let Python switch between threads every half millisecond.

    By default a thread that waits for the interpreter gets it after 5 ms, which is most of a frameset's time.
    """
    import cv2

    cv2.setNumThreads(1)
    sys.setswitchinterval(_SWITCH_INTERVAL_S)


def limit_blas_threads() -> None:
    """Let BLAS compute in the calling thread, in this process and its children; call this before numpy is imported.

    OpenBLAS has a thread for each core, and idle ones wait in a busy loop for the others: they take the cores from the
    odometry. A value of ``OPENBLAS_NUM_THREADS`` in the environment is kept.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def share_heap() -> bool:
    """Let all threads of this process that are started from now on allocate from one heap.

    glibc gives threads separate heaps, between which no memory is exchanged: a process whose threads pass on images
    keeps the free memory of each heap, and grows for minutes. The setting is that of ``MALLOC_ARENA_MAX=1`` in the
    environment.

    Returns:
        Whether the C library has such an option. Heaps that exist already remain in use.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and mallopt(_M_ARENA_MAX, 1) == 1


def has_mixed_zlib() -> bool:
    """Return whether the system's zlib calls functions of pycolmap's zlib, which is of another version.

    pycolmap's wheel exports the functions of its own zlib, and loads the system's as a dependency. Unless that was
    loaded before, it then calls the wheel's functions: whatever Python compresses corrupts the heap. Importing `zlib`
    before pycolmap, as ``import graphvio`` does, keeps them apart; afterwards nothing can.
    """
    modules = list(sys.modules)
    if "pycolmap" not in modules or not sys.platform.startswith("linux"):
        return False
    if "zlib" in modules and modules.index("zlib") < modules.index("pycolmap"):
        return False
    library = sys.modules["pycolmap"]._core.__file__
    try:
        own, of_system = (ctypes.CDLL(name).zlibVersion for name in (library, "libz.so.1"))
    except (AttributeError, OSError):
        return False
    return ctypes.cast(own, ctypes.c_void_p).value != ctypes.cast(of_system, ctypes.c_void_p).value


# ---------------------------------------------------------------------- Ctrl-C


@contextmanager
def interruptible() -> Iterator[None]:
    """End the block by `KeyboardInterrupt` at Ctrl-C, even if it came while compiled code ran.

    Compiled kernels end by a `SystemError` with the interrupt in its chain of causes; compiled libraries that are being
    loaded end by an `ImportError`, which may have been taken for a missing library.

    Raises:
        KeyboardInterrupt: At Ctrl-C.
    """
    try:
        yield
    except (SystemError, ImportError, MissingExtraError) as error:
        if not _is_interrupt(error):
            raise
        raise KeyboardInterrupt from error


def on_interrupt(handler: Callable[[], None]) -> Callable[[], None]:
    """Call a function at the next Ctrl-C, and restore the previous behaviour for later ones.

    Args:
        handler: Called in the main thread.

    Returns:
        A function that restores the previous behaviour at once.
    """
    before: list[Any] = []

    def restore() -> None:
        if before:
            signal.signal(signal.SIGINT, before.pop())

    def handle(*_: object) -> None:
        restore()
        handler()

    before.append(signal.signal(signal.SIGINT, handle))
    return restore


class HeldInterrupt:
    """Defers Ctrl-C within the block until `check`, so that nothing is left half written; a second one acts as usual.

    Outside of the main thread, and where Ctrl-C is ignored, nothing changes.
    """

    def __init__(self) -> None:
        self._came = False
        self._before: Any = None

    def __enter__(self) -> Self:
        is_main = threading.current_thread() is threading.main_thread()
        if is_main and signal.getsignal(signal.SIGINT) not in (signal.SIG_IGN, None):
            self._before = signal.signal(signal.SIGINT, self._hold)
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def check(self) -> None:
        """End the block if Ctrl-C came.

        Raises:
            KeyboardInterrupt: If Ctrl-C came.
        """
        if self._came:
            raise KeyboardInterrupt

    def _hold(self, *_: object) -> None:
        self._came = True
        self._restore()

    def _restore(self) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)
            self._before = None


# ---------------------------------------------------------------------- Ctrl-C and SIGTERM


class StopSignals:
    """Records the first Ctrl-C or SIGTERM within the block, so that all can be saved; a second one acts as usual.

    Attributes:
        came: Whether such a signal came.
    """

    def __init__(self) -> None:
        self.came = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        for number in _STOP_SIGNALS:
            if signal.getsignal(number) not in (signal.SIG_IGN, None):  # ignored in the background of a script
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.came = True
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}


@contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """End the block by `KeyboardInterrupt` at SIGTERM, as at Ctrl-C, so that what it started is cleaned up."""
    if signal.getsignal(signal.SIGTERM) in (signal.SIG_IGN, None):
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def stop_signals_blocked() -> Iterator[None]:
    """Deliver Ctrl-C and SIGTERM only after the block; processes that are started in it begin with both blocked."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore_stop_signals() -> None:
    """Handle Ctrl-C and SIGTERM by doing nothing, as the parent process ends this one.

    Ignored or blocked signals would be inherited by processes that are started here; handlers are not, so that signals
    still end those processes.
    """
    for number in _STOP_SIGNALS:
        signal.signal(number, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOP_SIGNALS)


def ignore_interrupts() -> None:
    """Ignore Ctrl-C here and in processes that are started from here: the parent process handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


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
