"""Compilation of numerical kernels with numba, without the interpreter's lock."""

import atexit
import logging
import subprocess
from collections.abc import Callable
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast

import numba
import numpy as np
from numba.core import event as numba_event

from graphvio.compiled_code import InlinedKernel, Kernel
from graphvio.kernel_cache import compiled_names

P = ParamSpec("P")
R = TypeVar("R")

_ANY_ORDER = frozenset({"reassoc", "contract", "arcp", "nsz"})
_FAST = frozenset({"fast"})
_registered: list[Any] = []
_compilers: list[subprocess.Popen[bytes]] = []
_log = logging.getLogger(__name__)


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function with numba: no GIL, cached on disk, IEEE division (no exception on 1/0)."""
    return _compiled(function)


def vector_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel for sums over points, whose order is left to the compiler; NaN and infinity keep their meaning.

    Equal inputs still give equal results on one machine.
    """
    return _compiled(function, _ANY_ORDER)


def fast_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel for sums over pixels, whose order is left to the compiler; NaN and infinity must not occur.

    Equal inputs still give equal results on one machine.
    """
    return _compiled(function, _FAST)


def _compiled(function: Callable[P, R], fast_math: frozenset[str] = frozenset()) -> Callable[P, R]:
    if numba.config.DISABLE_JIT:  # NUMBA_DISABLE_JIT, to debug kernels as Python
        return function
    compiled = Kernel(function, fast_math)
    _registered.append(compiled)
    return cast(Callable[P, R], compiled)


def compile_elsewhere(compiler: subprocess.Popen[bytes]) -> None:
    """Note that a process compiles kernels that this one needs later; it ends with this one at the latest."""
    _compilers.append(compiler)
    atexit.register(compiler.kill)


def is_compiling_elsewhere() -> bool:
    """Return whether a process of `compile_elsewhere` is still at work."""
    return any(compiler.poll() is None for compiler in _compilers)


def await_compilers() -> None:
    """Wait until no other process compiles kernels for this one; what it has not compiled is compiled here."""
    for compiler in _compilers:
        compiler.wait()


class CompilationProgress(NamedTuple):
    """How many kernels of the modules that are imported are compiled.

    Attributes:
        compiled: number of kernels whose code is in a cache, by whichever process.
        total: number of kernels; some of them may not be needed.
        newest: name of the kernel that was compiled last.
    """

    compiled: int
    total: int
    newest: str


def compilation_progress() -> CompilationProgress | None:
    """Return how many kernels are compiled, or None where none had to be compiled; from any thread."""
    if not _announcer.has_announced:
        return None
    kernels = list(_registered)
    names = compiled_names({each.__module__ for each in kernels})
    return CompilationProgress(len(names), len(kernels), names[-1] if names else "")


def announce_compilation() -> None:
    """Log, once in a process, that kernels are being compiled, here or in a process of `compile_elsewhere`."""
    if not _announcer.has_announced:
        _announcer.has_announced = True
        _log.warning("compiling numerical kernels for this machine, once; it takes about a minute")


class _Announcer(numba_event.Listener):  # type: ignore[misc]
    """Announces that kernels are compiled in this process."""

    def __init__(self) -> None:
        self.has_announced = False

    def on_start(self, event: Any) -> None:
        """Handle that numba begins to compile a function that no cache holds."""
        if isinstance(event.data["dispatcher"], Kernel | InlinedKernel):
            announce_compilation()

    def on_end(self, event: Any) -> None:
        """Handle that numba has compiled a function."""


_announcer = _Announcer()
numba_event.register("numba:compile", _announcer)


@kernel
def put(target: Any, values: Any) -> None:
    """Assign ``target[:] = values`` of equal shapes, which numba itself takes seconds to compile at each use."""
    for index in np.ndindex(values.shape):
        target[index] = values[index]
