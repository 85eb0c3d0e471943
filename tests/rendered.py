"""Simulated recordings on disk, each rendered once for all processes and all runs of the tests."""

import fcntl
import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from graphvio.kernel_cache import source_digest

_HERE = Path(__file__).parent
_MAKERS = ("recordings.py", "calibration_walks.py", "rendered.py")  # in tests, of what is rendered


def rendered_once(name: str, write: Callable[[Path], object], *options: object) -> Path:
    """Return a folder with a recording, which is rendered if no run of the tests has done so before.

    Nobody may write into it. It is kept in the user's cache, by the digest of the simulator's sources.

    Args:
        name: Name of the folder.
        write: Renders into a folder that does not exist.
        options: All that the recording depends on apart from the sources; recordings of one name differ in these.
    """
    sources = hashlib.sha256(source_digest("graphvio.simulation.recording").encode())
    for maker in _MAKERS:
        sources.update((_HERE / maker).read_bytes())
    which = f"{name}-{hashlib.sha256(repr(options).encode()).hexdigest()[:8]}"
    cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "graphvio" / "test-recordings"
    cache.mkdir(parents=True, exist_ok=True)
    folder = cache / f"{which}.{sources.hexdigest()[:16]}" / name
    with (cache / f"{which}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # whichever process comes first renders it for all
        if not folder.exists():
            for outdated in [path for path in cache.glob(f"{which}.*") if path.is_dir()]:
                shutil.rmtree(outdated)
            folder.parent.mkdir()
            unfinished = folder.with_name(".unfinished")
            write(unfinished)
            unfinished.rename(folder)
    return folder


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
