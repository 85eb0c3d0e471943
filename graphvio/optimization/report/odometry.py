"""What the odometry's own results say of a session, where they lie beside the report."""

from __future__ import annotations

import json
from pathlib import Path

from graphvio.errors import RigError
from graphvio.rig import Rig
from graphvio.rig_files import load_rig

_FOLDER = "odometry"


def completion(folder: Path, session: str) -> float | None:
    """Share of the session's framesets that have a pose, of those that could have one; None if it is not known."""
    try:
        summary = json.loads((folder / session / _FOLDER / "summary.json").read_text(encoding="utf-8"))
        return float(summary["completion"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def rig_of(folder: Path, session: str) -> Rig | None:
    """The rig that the session was recorded with, as its file has it; None if it is not known."""
    try:
        return load_rig(folder / session / _FOLDER / "rig.yaml")
    except RigError:
        return None
