"""Writes the report of an optimisation into a folder."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from graphvio.errors import OptimizationError
from graphvio.optimization.optimize import Optimization
from graphvio.optimization.report import figures
from graphvio.optimization.report.document import document
from graphvio.optimization.report.maps import draw_map
from graphvio.optimization.report.numbers import Numbers, numbers_of
from graphvio.optimization.report.odometry import completion, rig_of
from graphvio.optimization.report.page import page
from graphvio.reporting.figures import png
from graphvio.reporting.files import replace_file
from graphvio.trajectory import Trajectory

PAGE, SUMMARY = "report.html", "summary.json"
_MOST_MAPS = 6


def write_report(found: Optimization, folder: Path, truths: Sequence[Trajectory | None]) -> Path:
    """Write ``report.html`` with everything in it, and all numbers as ``summary.json``; each is whole or absent.

    Args:
        found: the optimisation.
        folder: is made if it is missing; what the odometry left there of each session, in NAME/odometry, is told, too.
        truths: of each session, poses of body on the session's clock in any frame; or None.

    Returns:
        The page.

    Raises:
        OptimizationError: if there is not one truth, or None, for each session, or the folder cannot be written.
    """
    names = [session.record.name for session in found.sessions]
    rigs, completions = [rig_of(folder, name) for name in names], [completion(folder, name) for name in names]
    numbers = numbers_of(found, truths, rigs, completions)
    summary = json.dumps(document(found, numbers), indent=2, allow_nan=False) + "\n"
    maps = {frame: png(draw_map(found, numbers, frame)) for frame in _frames_to_draw(numbers)}
    pictures = {
        "residuals": png(figures.draw_residuals(numbers)),
        "moved": png(figures.draw_moved(found, numbers)),
        "sigmas": png(figures.draw_sigmas(found, numbers)),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        replace_file(folder / SUMMARY, summary)
        replace_file(folder / PAGE, page(found, numbers, maps, pictures))
    except OSError as error:
        raise OptimizationError(f"{folder}: cannot be written ({error.strerror}); choose another place") from None
    return folder / PAGE


def _frames_to_draw(numbers: Numbers) -> list[int]:
    """Those with most framesets, in their order."""
    framesets = [0] * numbers.frames
    for part in numbers.parts:
        framesets[part.frame] += part.framesets
    largest = sorted(range(numbers.frames), key=lambda frame: -framesets[frame])[:_MOST_MAPS]
    return sorted(largest)
