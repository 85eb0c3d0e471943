"""Calibration of a session's rig, from its whole recording, before the odometry measures all motions with it."""

from __future__ import annotations

import json
from pathlib import Path

from graphvio.errors import CalibrationError
from graphvio.odometry.recorded_calibration import CalibrationWindows, Progress
from graphvio.rig import Rig
from graphvio.self_calibration.findings import described

FINDINGS = "calibration.json"
"""File in a session's folder with the findings of its calibration, a sentence each."""


def calibrated_rig(rig: Rig, windows: CalibrationWindows, end_ns: int, on_progress: Progress) -> tuple[Rig, list[str]]:
    """Calibrate a rig from a recording, and return it with sentences on what was found.

    The given rig is returned where the recording does not contradict it, or does not suffice to estimate it.

    Args:
        rig: the rig of the rig file.
        windows: the windows of an odometry that has finished.
        end_ns: stamp of the recording's last frameset.
        on_progress: called with the progress of the calibration.
    """
    try:
        found = windows.calibrate("all", end_ns, on_progress, compares_halves=False)
    except CalibrationError as error:
        return rig, [cannot_be_calibrated(error)]
    if found.is_file_exact and not found.clock_shift_s:
        return rig, ["calibration: as in the rig file, which the recording does not contradict"]
    return found.rig, [*described(found.findings), *found.remarks]


def cannot_be_calibrated(error: CalibrationError) -> str:
    """Return a sentence on a rig that cannot be calibrated and is used as it is."""
    return f"calibration: as in the rig file, since it cannot be estimated: {error}"


def session_findings(folder: Path) -> list[str]:
    """Read the findings of a session's calibration from its folder; empty where it was not calibrated."""
    try:
        return [str(sentence) for sentence in json.loads((folder / FINDINGS).read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError):
        return []
