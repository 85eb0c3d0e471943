"""Cache folders of compiled kernels.

numba notices an edit to a kernel's own file but not to a file whose kernels it calls. The cache folder of a module is
therefore named after a digest of its source and of all sources that it imports from this package: outdated machine code
is never run by mistake, and an upgrade compiles only modules that changed.
"""

import functools
import hashlib
import os
import re
import sys
import tempfile
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

_PACKAGE = Path(__file__).parent
_IMPORT = re.compile(r"^from (graphvio[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)
_NAME = re.compile(r"\w+")


@functools.cache
def cache_root() -> Path:
    """Return the folder to which compiled kernels are written: ``GRAPHVIO_CACHE_DIR``, or one in the user's cache."""
    chosen = os.environ.get("GRAPHVIO_CACHE_DIR")
    user_cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "graphvio" / "kernels"
    for folder in ([Path(chosen)] if chosen else []) + [user_cache]:
        try:
            root = folder.expanduser()
            root.mkdir(parents=True, exist_ok=True)
            if os.access(root, os.W_OK):
                return root
        except (OSError, RuntimeError):
            pass  # a folder that is read-only, or a home that is unknown
    root = Path(tempfile.gettempdir()) / f"graphvio-{os.getuid()}-kernels"  # compiled code then lives as long as /tmp
    root.mkdir(mode=0o700, exist_ok=True)
    if root.stat().st_uid != os.getuid():  # code is loaded from here: it must be our own
        return Path(tempfile.mkdtemp(prefix="graphvio-kernels-"))
    return root


def shared_root() -> Path | None:
    """Return ``GRAPHVIO_CACHE_DIR`` if it is read-only, such as one that all users of a machine share; else None."""
    chosen = os.environ.get("GRAPHVIO_CACHE_DIR")
    if not chosen:
        return None
    shared = Path(chosen).expanduser()
    return shared if shared != cache_root() and shared.is_dir() else None


def cache_folders(module: str) -> list[Path]:
    """Return the folders that may hold code of a module's kernels; new code is written to the first."""
    roots = [root for root in (cache_root(), shared_root()) if root is not None]
    return [root / source_digest(module) for root in roots]


def any_compiled_before(module: str) -> bool:
    """Return whether a cache holds code of a module's kernels, so that a first call need not compile."""
    return any(any(folder.glob("*.nbc")) for folder in cache_folders(module))


def compiled_names(modules: Iterable[str]) -> list[str]:
    """Return the names of the modules' kernels that have code in a cache, in the order of their compilation."""
    times: dict[tuple[str, str], float] = {}
    for module in modules:
        for folder in cache_folders(module):
            for index in folder.glob("*.nbi"):  # such as stereo.epipolar_search-96.py311.nbi
                name = index.name.split(".")[1].rpartition("-")[0]
                times[module, name] = index.stat().st_mtime
    return [name for _, name in sorted(times, key=lambda key: times[key])]


@functools.cache
def source_digest(module: str) -> str:
    """Return a module's name with a digest of its source and of all sources that it imports from this package."""
    sources: dict[str, bytes] = {}
    pending = [module]
    while pending:
        name = pending.pop()
        if name not in sources:
            sources[name], imported = _source(name)
            pending += imported
    digest = hashlib.sha256(f"{metadata.version('numba')} {sys.version}".encode())
    for name in sorted(sources):
        digest.update(name.encode() + sources[name])
    return f"{module}-{digest.hexdigest()[:16]}"


@functools.cache
def _source(module: str) -> tuple[bytes, list[str]]:
    """Return the digest of one module's source, and the modules of this package that it imports."""
    file = _file(module)
    source = file.read_bytes() if file.is_file() else b""
    imported = []
    for package, names in _IMPORT.findall(source.decode()):
        imported.append(package)
        if _file(package).name == "__init__.py":  # names that are imported from it may be modules
            named = [f"{package}.{name}" for name in _NAME.findall(names)]
            imported += [each for each in named if _file(each).is_file()]
    return hashlib.sha256(source).digest(), imported


def _file(module: str) -> Path:
    """Return the path of a module's or package's source, which need not exist."""
    path = _PACKAGE.parent.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
