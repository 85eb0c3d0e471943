"""Markers of finished stages: a small file, written after all others of a stage."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from graphvio.errors import FleetError
from graphvio.fleet.storage import Storage

_FOLDER = "stages"


@dataclass(frozen=True)
class Marker:
    """A finished stage."""

    stage: str  # name, such as ``odometry`` or ``features-0-of-2``
    inputs: Mapping[str, str]  # name -> value of everything that determines the results
    files: Sequence[str]  # names of its files in the session's folder
    wall_s: float  # wall time, including the transfer of files
    figures: Mapping[str, Any] = field(default_factory=dict)  # name -> value, for the table of sessions

    def write(self, storage: Storage) -> None:
        """Write the marker into a session's folder."""
        text = json.dumps(asdict(self), indent=2, allow_nan=False) + "\n"
        storage.write(_name(self.stage), text.encode())


def finished(storage: Storage, inputs: Mapping[str, str]) -> dict[str, Marker]:
    """Return the finished stages of a session whose files all exist: name -> marker.

    ``inputs`` are those that are known without opening the recording.

    Raises:
        FleetError: if the folder cannot be read, or holds results of other inputs.
    """
    there = storage.sizes()
    found = {}
    for name in sorted(there):
        if not name.startswith(f"{_FOLDER}/") or not name.endswith(".json"):
            continue
        marker = _read(storage, name)
        if marker is None:
            continue
        refuse_others(storage, [marker], inputs)
        if there.keys() >= set(marker.files):
            found[marker.stage] = marker
    return found


def forget(storage: Storage, stage: str) -> None:
    """Remove a stage's marker, so that the stage is done again."""
    storage.remove(_name(stage))


def refuse_others(storage: Storage, markers: Iterable[Marker], inputs: Mapping[str, str]) -> None:
    """Raise a `FleetError` unless the markers' stages were made from the same inputs."""
    for marker in markers:
        differing = [key for key, value in inputs.items() if marker.inputs.get(key) != value]
        if differing:
            raise FleetError(
                f"{storage.url}: holds results of other input (different: {', '.join(sorted(differing))}); "
                "remove it, or give another folder for the results"
            )


def _read(storage: Storage, name: str) -> Marker | None:
    """Read a marker, or return None if it is damaged: the stage is then done again."""
    try:
        return Marker(**json.loads(storage.read(name) or b""))
    except (ValueError, TypeError):
        return None


def _name(stage: str) -> str:
    return f"{_FOLDER}/{stage}.json"
