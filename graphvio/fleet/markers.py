"""What tells that a stage of a session is finished: a small file that is written after all others of the stage."""

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
    """A finished stage.

    Attributes:
        stage: its name, such as ``odometry`` or ``features-0-of-2``.
        inputs: what decided the results: name -> value.
        files: names of what it left in the session's folder.
        wall_s: time that it took, fetching and putting included.
        figures: name -> value, of the session's health.
    """

    stage: str
    inputs: Mapping[str, str]
    files: Sequence[str]
    wall_s: float
    figures: Mapping[str, Any] = field(default_factory=dict)

    def write(self, storage: Storage) -> None:
        """Put it into a session's folder.

        Raises:
            FleetError: if it cannot be written.
        """
        text = json.dumps(asdict(self), indent=2, allow_nan=False) + "\n"
        storage.write(_name(self.stage), text.encode())


def finished(storage: Storage, inputs: Mapping[str, str]) -> dict[str, Marker]:
    """The stages of a session whose files are all there: name -> marker.

    Args:
        storage: the session's folder.
        inputs: what decides the results, as far as it is known.

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
    """Have a stage done again.

    Raises:
        FleetError: if its marker cannot be removed.
    """
    storage.remove(_name(stage))


def refuse_others(storage: Storage, markers: Iterable[Marker], inputs: Mapping[str, str]) -> None:
    """Check that stages were made of the same.

    Args:
        storage: the session's folder.
        markers: of its stages.
        inputs: what decides the results, as far as it is known.

    Raises:
        FleetError: if one was made of other inputs.
    """
    for marker in markers:
        differing = [key for key, value in inputs.items() if marker.inputs.get(key) != value]
        if differing:
            raise FleetError(
                f"{storage.url}: holds results of other input (different: {', '.join(sorted(differing))}); "
                "remove it, or give another folder for the results"
            )


def _read(storage: Storage, name: str) -> Marker | None:
    """None if it is damaged: the stage is then done again."""
    try:
        return Marker(**json.loads(storage.read(name) or b""))
    except (ValueError, TypeError):
        return None


def _name(stage: str) -> str:
    return f"{_FOLDER}/{stage}.json"
