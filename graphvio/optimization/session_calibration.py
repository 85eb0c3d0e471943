"""Calibration of a session's rig, from its whole recording, before the odometry measures all motions with it."""

from __future__ import annotations

import json
from pathlib import Path

from graphvio.config import Config
from graphvio.errors import CalibrationError
from graphvio.odometry.recorded_calibration import Progress, calibrate_recording
from graphvio.rig import Rig
from graphvio.self_calibration.findings import described
from graphvio.sources import Source

FINDINGS = "calibration.json"
"""File of a session with what was found, a sentence each."""


def calibrated_rig(source: Source, config: Config, on_progress: Progress) -> tuple[Rig, list[str]]:
    """Calibrate the rig of a recording, and return it with sentences on what was found.

    It stays where the recording says nothing against it, or does not show it.
    """
    try:
        found = calibrate_recording(source, source.rig, "all", config, on_progress, compares_halves=False)
    except CalibrationError as error:
        return source.rig, [f"calibration: as in the rig file, since it cannot be estimated: {error}"]
    if found.is_file_exact and not found.clock_shift_s:
        return source.rig, ["calibration: as in the rig file, which the recording does not contradict"]
    return found.rig, [*described(found.findings), *found.remarks]


def session_findings(folder: Path) -> list[str]:
    """Read what the calibration of a session found from its folder; nothing where it was not calibrated."""
    try:
        return [str(sentence) for sentence in json.loads((folder / FINDINGS).read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError):
        return []
