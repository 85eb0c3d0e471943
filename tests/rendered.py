"""Simulated recordings on disk, each rendered once for all processes and all runs of the tests."""

import ast
import fcntl
import functools
import hashlib
import os
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numba
import numpy as np

_HERE = Path(__file__).parent
_MAKERS = ("recordings.py", "calibration_walks.py", "mapping_walks.py", "rendered.py")  # in tests, of what is rendered
_WRITERS = ("graphvio.simulation.recording", "graphvio.rig_files.native")
_TAKE_NO_PART = frozenset(  # in what is written: they read, raise, or compile
    ("graphvio.rig_files", "graphvio.rig_files.reading", "graphvio.errors", "graphvio.wording",
     "graphvio.kernel_cache", "graphvio.compiled_code")
)  # fmt: skip
_KEPT_S = 6 * 3600.0  # after their last use: another checkout, whose simulator differs, may be at its tests
_UNCOMPRESSED = (cv2.IMWRITE_PNG_COMPRESSION, 0, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE)


def modules_that_write() -> dict[str, bytes]:
    """Return the sources, by module, that determine the bytes of a recording."""
    sources: dict[str, bytes] = {}
    pending = list(_WRITERS)
    while pending:
        name = pending.pop()
        path = _HERE.parent.joinpath(*name.split("."))
        file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        if name in sources or name in _TAKE_NO_PART or not file.exists():  # no module, but a name in one
            continue
        sources[name] = file.read_bytes()
        for node in ast.walk(ast.parse(sources[name])):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("graphvio"):
                pending += [f"{node.module}", *(f"{node.module}.{alias.name}" for alias in node.names)]
    return sources


@functools.cache
def _digest() -> str:
    """Return a digest of all that determines the bytes of a recording apart from its options."""
    versions = [sys.version, numba.__version__, np.__version__, cv2.__version__]
    digest = hashlib.sha256(repr(versions).encode())
    for name, source in sorted(modules_that_write().items()):
        digest.update(name.encode() + source)
    for maker in _MAKERS:
        digest.update((_HERE / maker).read_bytes())
    return digest.hexdigest()[:16]


def rendered_once(name: str, write: Callable[[Path], object], *options: object) -> Path:
    """Return a folder with a recording, which is rendered if no run of the tests has done so before.

    Nobody may write into it. It is kept in the user's cache, by the digest of the sources that determine its bytes;
    those by other digests are removed some hours after their last use.

    Args:
        name: Name of the folder.
        write: Renders into a folder that does not exist.
        options: All that the recording depends on apart from the sources; recordings of one name differ in these.
    """
    which = f"{name}-{hashlib.sha256(repr(options).encode()).hexdigest()[:8]}"
    cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "graphvio" / "test-recordings"
    cache.mkdir(parents=True, exist_ok=True)
    folder = cache / f"{which}.{_digest()}" / name
    with (cache / f"{which}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # whichever process comes first renders it for all
        if not folder.exists():
            for other in [path for path in cache.glob(f"{which}.*") if path.is_dir()]:
                if other == folder.parent or time.time() - other.stat().st_mtime > _KEPT_S:  # its own was not finished
                    shutil.rmtree(other)
            folder.parent.mkdir()
            unfinished = folder.with_name(".unfinished")
            write(unfinished)
            _uncompress(unfinished)
            unfinished.rename(folder)
        os.utime(folder.parent)
    return folder


def _uncompress(recording: Path) -> None:
    """Write the images of a recording again without compression: they are decoded in a tenth of the time."""
    for path in recording.rglob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert cv2.imwrite(str(path), image, _UNCOMPRESSED)


def copy_part(whole: Path, folder: Path, duration_s: float) -> None:
    """Copy the first seconds of a simulated recording, as if it had ended then, into a folder that does not exist."""
    frames = [int(image.stem) for image in (whole / "mav0/cam0/data").iterdir()]
    end_ns = min(frames) + round(duration_s * 1e9)

    def later(path: str, names: list[str]) -> set[str]:
        return {name for name in names if name.endswith(".png") and int(name[:-4]) >= end_ns}

    shutil.copytree(whole, folder, ignore=later)
    for table in (folder / "mav0").glob("*/data.csv"):
        last_ns = end_ns - 1 if (table.parent / "data").is_dir() else end_ns  # an interval of samples is closed
        header, *rows = table.read_text().splitlines()
        table.write_text("\n".join([header, *(row for row in rows if int(row.split(",")[0]) <= last_ns), ""]))
