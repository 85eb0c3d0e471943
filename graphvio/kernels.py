"""Compilation of numerical kernels with numba, and their cache on disk.

numba notices an edit to a kernel's own file but not to a file whose kernels it calls. The cache folder
of a module is therefore named after a digest of its source and of all that it imports from this package:
outdated machine code is never run by mistake.
"""

import atexit
import functools
import hashlib
import logging
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
import numpy as np
from numba.core import event as numba_event

P = ParamSpec("P")
R = TypeVar("R")

_PACKAGE = Path(__file__).parent
_IMPORT = re.compile(r"^from (graphvio[\w.]*) import", re.MULTILINE)
_ANY_ORDER = {"reassoc", "contract", "arcp", "nsz"}
_registered: list[Any] = []
_compilers: list[subprocess.Popen[bytes]] = []
_log = logging.getLogger(__name__)


@functools.cache
def cache_root() -> Path:
    """Return the folder of all compiled kernels: ``GRAPHVIO_CACHE_DIR``, or graphvio's folder in the user's cache."""
    chosen = os.environ.get("GRAPHVIO_CACHE_DIR")
    user_cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    try:
        root = (Path(chosen) if chosen else user_cache / "graphvio" / "kernels").expanduser()
        root.mkdir(parents=True, exist_ok=True)
        if os.access(root, os.W_OK):
            return root
    except (OSError, RuntimeError):
        pass  # a home that is read-only or unknown: compiled code then lives as long as /tmp does
    root = Path(tempfile.gettempdir()) / f"graphvio-{os.getuid()}-kernels"
    root.mkdir(mode=0o700, exist_ok=True)
    if root.stat().st_uid != os.getuid():  # code is loaded from here: it must be our own
        return Path(tempfile.mkdtemp(prefix="graphvio-kernels-"))
    return root


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function with numba: no GIL, cached on disk, IEEE division (no exception on 1/0)."""
    return _compile(function, fastmath=False)


def vector_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel for sums over points, whose order is left to the compiler; NaN and infinity keep their meaning.

    Equal inputs still give equal results on one machine.
    """
    return _compile(function, fastmath=_ANY_ORDER)


def fast_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel for sums over pixels, whose order is left to the compiler; NaN and infinity must not occur.

    Equal inputs still give equal results on one machine.
    """
    return _compile(function, fastmath=True)


def _compile(function: Callable[P, R], *, fastmath: bool | set[str]) -> Callable[P, R]:
    callers_choice = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(cache_root() / source_digest(function.__module__))  # read when the cache is attached
    try:
        # What a kernel calls becomes part of it. Else the linker takes whichever copy of the callee it met first, and
        # these differ by how often they were optimised: the run that compiles would not give what later ones give.
        compiled = numba.njit(
            cache=True, nogil=True, error_model="numpy", fastmath=fastmath, forceinline=True, no_cfunc_wrapper=True
        )(function)
    finally:
        numba.config.CACHE_DIR = callers_choice
    _registered.append(compiled)
    return cast(Callable[P, R], compiled)


def any_compiled_before(module: str) -> bool:
    """Return whether the cache holds code of a module's kernels, so that a first call need not compile."""
    return any((cache_root() / source_digest(module)).rglob("*.nbc"))


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


@functools.cache
def source_digest(module: str) -> str:
    """Return a module's name with a digest of its source and of all that it imports from this package."""
    sources: dict[str, bytes] = {}
    pending = [module]
    while pending:
        name = pending.pop()
        if name in sources:
            continue
        path = _PACKAGE.parent.joinpath(*name.split("."))
        file = path.with_suffix(".py") if not path.is_dir() else path / "__init__.py"
        sources[name] = file.read_bytes() if file.is_file() else b""
        pending += _IMPORT.findall(sources[name].decode())
    digest = hashlib.sha256(f"{numba.__version__} {sys.version}".encode())
    for name in sorted(sources):
        digest.update(name.encode() + sources[name])
    return f"{module}-{digest.hexdigest()[:16]}"


class _Announcer(numba_event.Listener):  # type: ignore[misc]
    """Logs, once in a process, that kernels are being compiled."""

    def __init__(self) -> None:
        self._announced = False

    def on_start(self, event: Any) -> None:
        """Handle that numba begins to compile a function that no cache holds."""
        if not self._announced and event.data["dispatcher"] in _registered:
            self._announced = True
            _log.warning("compiling numerical kernels for this machine, once; it takes about a minute")

    def on_end(self, event: Any) -> None:
        """Handle that numba has compiled a function."""


numba_event.register("numba:compile", _Announcer())


@kernel
def put(target: Any, values: Any) -> None:
    """Assign ``target[:] = values`` of equal shapes, which numba itself takes seconds to compile at each use."""
    for index in np.ndindex(values.shape):
        target[index] = values[index]
