"""Compilation of numerical kernels with numba, without the interpreter's lock."""

import atexit
import logging
import subprocess
from collections.abc import Callable
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast

import numba
import numpy as np
from numba.core import event as numba_event
from numba.core.compiler import Compiler

from graphvio.compiled_code import KernelCache
from graphvio.fast_math import fast_math_compiler
from graphvio.kernel_cache import compiled_names

P = ParamSpec("P")
R = TypeVar("R")

_ANY_ORDER = fast_math_compiler(frozenset({"reassoc", "contract", "arcp", "nsz"}))
_FAST = fast_math_compiler(frozenset({"fast"}))
_registered: list[Any] = []
_compilers: list[subprocess.Popen[bytes]] = []
_log = logging.getLogger(__name__)


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function with numba: no GIL, cached on disk, IEEE division (no exception on 1/0)."""
    return _compile(function, Compiler)


def vector_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel for sums over points, whose order is left to the compiler; NaN and infinity keep their meaning.

    Equal inputs still give equal results on one machine.
    """
    return _compile(function, _ANY_ORDER)


def fast_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel for sums over pixels, whose order is left to the compiler; NaN and infinity must not occur.

    Equal inputs still give equal results on one machine.
    """
    return _compile(function, _FAST)


def _compile(function: Callable[P, R], compiler: type[Compiler]) -> Callable[P, R]:
    # What a kernel calls becomes part of it. Else the linker takes whichever copy of the callee it met first, and these
    # differ by how often they were optimised: the run that compiles would not give what later ones give.
    compiled = numba.njit(
        nogil=True, error_model="numpy", forceinline=True, no_cfunc_wrapper=True, pipeline_class=compiler
    )(function)
    if compiled is not function:  # as with NUMBA_DISABLE_JIT
        compiled._cache = KernelCache(function)
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
    """Return how many kernels are compiled, or None where this process has compiled none; from any thread."""
    if not _announcer.has_announced:
        return None
    kernels = list(_registered)
    names = compiled_names({each.__module__ for each in kernels})
    return CompilationProgress(len(names), len(kernels), names[-1] if names else "")


class _Announcer(numba_event.Listener):  # type: ignore[misc]
    """Logs, once in a process, that kernels are being compiled."""

    def __init__(self) -> None:
        self.has_announced = False

    def on_start(self, event: Any) -> None:
        """Handle that numba begins to compile a function that no cache holds."""
        if not self.has_announced and event.data["dispatcher"] in _registered:
            self.has_announced = True
            _log.warning("compiling numerical kernels for this machine, once; it takes about a minute")

    def on_end(self, event: Any) -> None:
        """Handle that numba has compiled a function."""


_announcer = _Announcer()
numba_event.register("numba:compile", _announcer)


@kernel
def put(target: Any, values: Any) -> None:
    """Assign ``target[:] = values`` of equal shapes, which numba itself takes seconds to compile at each use."""
    for index in np.ndindex(values.shape):
        target[index] = values[index]
