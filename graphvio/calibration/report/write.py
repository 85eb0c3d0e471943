"""Writes the report of a calibration into a folder."""

from __future__ import annotations

from pathlib import Path

from graphvio.calibration.report import figures
from graphvio.calibration.report.document import write_document
from graphvio.calibration.report.page import page
from graphvio.calibration.result import Calibration
from graphvio.errors import CalibrationError
from graphvio.reporting.figures import png

PAGE, NUMBERS = "report.html", "calibration.yaml"


def write_report(found: Calibration, folder: Path, source: str, count: int) -> Path:
    """Write ``report.html`` with everything in it, its pictures as PNGs, and all numbers as ``calibration.yaml``.

    Args:
        found: the calibration.
        folder: is made if it is missing.
        source: what was calibrated from, for the title.
        count: of framesets that were used, or of the first trajectory's poses.

    Returns:
        The page.

    Raises:
        CalibrationError: if the folder cannot be written.
    """
    pictures: dict[tuple[int, int], dict[str, bytes]] = {}
    for cameras, each in found.places.pairwise.items():
        drawn = {
            "alignment_errors": figures.alignment_errors(each),
            "residuals": figures.residuals(each),
            "turning": figures.turning(each),
        }
        if len(each.growth) > 1:
            drawn["growth"] = figures.growth(each, count, "framesets" if found.rig is not None else "poses")
        pictures[cameras] = {name: png(figure) for name, figure in drawn.items()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for (i, j), named in pictures.items():
            for name, data in named.items():
                (folder / f"{name}-{i}-{j}.png").write_bytes(data)
        (folder / PAGE).write_text(page(found, pictures, source), encoding="utf-8")
    except OSError as error:
        raise CalibrationError(f"{folder}: cannot be written ({error.strerror}); choose another place") from None
    write_document(found, folder / NUMBERS)
    return folder / PAGE
