"""Listing of the sessions in a folder, or in a text file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from graphvio.errors import FleetError
from graphvio.fleet.storage import file_system, local_path, reaching
from graphvio.sessions.store import SUFFIXES
from graphvio.sources import is_recording


@dataclass(frozen=True)
class Listed:
    """A session of a fleet run."""

    name: str  # unique name, which is also that of its folder of results
    recording: str  # absolute path, or URL


def list_sessions(where: str) -> list[Listed]:
    """List the recordings in a folder, one level deep and sorted by name, or those of a text file, in its order.

    A list has one path or URL per line; relative paths are relative to the list, and lines that begin with ``#`` are
    comments. In remote folders each folder counts as a recording, and so does a file that ends in .mcap, .bag
    or .db3.

    Raises:
        FleetError: if the folder or list does not exist, or has no recording.
    """
    local = local_path(where)
    try:
        with reaching():
            recordings = _in_local(local) if local is not None else _in_remote(where.rstrip("/"))
    except UnicodeDecodeError:
        raise FleetError(f"{where}: is neither a folder nor a list of recordings in text") from None
    except OSError as error:
        raise FleetError(f"{where}: cannot be read ({error.strerror or error}); give a folder or a list") from None
    if not recordings:
        raise FleetError(f"{where}: holds no recording that graphvio reads, one level deep; give a folder or a list")
    return _named(recordings)


def _in_local(path: Path) -> list[str]:
    if path.is_dir():
        return [str(each) for each in sorted(path.iterdir()) if is_recording(each)]
    lines = _lines(path.read_text(encoding="utf-8"))
    return [line if "://" in line else str((path.parent / Path(line).expanduser()).absolute()) for line in lines]


def _in_remote(url: str) -> list[str]:
    files, path = file_system(url)
    if files.isdir(path):
        found = sorted(files.ls(path, detail=True), key=lambda each: str(each["name"]))
        names = [str(each["name"]) for each in found if each["type"] == "directory" or each["name"].endswith(SUFFIXES)]
        return [f"{url}/{name.rstrip('/').rpartition('/')[2]}" for name in names]
    parent = url.rpartition("/")[0]
    lines = _lines(files.cat_file(path).decode("utf-8"))
    return [line if "://" in line or line.startswith("/") else f"{parent}/{line}" for line in lines]


def _lines(text: str) -> list[str]:
    stripped = (line.strip() for line in text.splitlines())
    return [line for line in stripped if line and not line.startswith("#")]


def _named(recordings: Iterable[str]) -> list[Listed]:
    """Name the recordings, with a number added to names that repeat."""
    made: dict[str, Listed] = {}
    for recording in recordings:
        path = PurePosixPath(recording)
        if path.name == "mav0":
            path = path.parent
        first = path.stem if path.suffix in SUFFIXES else path.name
        name, number = first, 1
        while name in made:
            number += 1
            name = f"{first}-{number}"
        made[name] = Listed(name, recording)
    return list(made.values())
