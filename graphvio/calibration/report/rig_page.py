"""The report of a calibration of all parameters: an HTML page with the picture of the calibration over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphvio.errors import CalibrationError, writing
from graphvio.odometry.recorded_calibration import HalfComparison, RecordedCalibration
from graphvio.reporting.html import render
from graphvio.results.calibration_plot import CalibrationHistory
from graphvio.rig_files.native import to_text
from graphvio.self_calibration.findings import Finding

PAGE, PICTURE, RIG = "report.html", "calibration.png", "rig-calibrated.yaml"
HEAD = ("", "file off by", "sigma", "file's sigma", "")


def rows_of(found: RecordedCalibration) -> list[tuple[str, ...]]:
    """Return a row of text, see `HEAD`, for each part that was calibrated."""
    return [_row(each) for each in found.findings]


def agreement_in_words(each: HalfComparison) -> str:
    """Return a sentence on the agreement of two halves in one group of parameters."""
    remark = "agree" if each.is_good else "do not agree"
    unit = f" {each.unit}" if each.unit else ""
    return (
        f"{each.group}: the halves {remark} (chi-square {each.statistic:.1f} of {each.dimension}, at most "
        f"{each.size:.2g}{unit} apart)"
    )


def doubts_of(found: RecordedCalibration) -> list[str]:
    """Return sentences on what a user should know before using the calibration."""
    doubts = [f"kept as in the file, though the recording contradicts it: {each}" for each in found.contradicted]
    doubts += [agreement_in_words(each) for each in found.agreements if not each.is_good]
    for motion in dict.fromkeys(each.motion for each in found.findings):
        hidden = [each.part for each in found.findings if each.motion == motion and not each.is_observed]
        if hidden:
            doubts.append(f"hardly better known than by the file: {'; '.join(hidden)} (to show it, {motion})")
    if count := sum(found.batch.left_out):
        doubts.append(
            f"{count} of {len(found.batch.left_out)} windows contradict the others, or fit no calibration: left out"
        )
    if found.halves is None:
        doubts.append("the recording is too short to be divided in halves, of which one would check the other")
    return doubts


def write_rig_report(found: RecordedCalibration, folder: Path, source: str) -> Path:
    """Write ``report.html`` with the picture embedded, the picture, and the rig; ``source`` is named in the title.

    Raises:
        CalibrationError: if the folder cannot be written.
    """
    history = CalibrationHistory()
    for stamp_ns, estimate in found.batch.history:
        history.add(stamp_ns, estimate)
    with writing(folder, CalibrationError, "choose another place"):
        folder.mkdir(parents=True, exist_ok=True)
        history.plot(folder / PICTURE, found.end_ns, source)
        text = render(
            "calibration/report/rig_page.html",
            source=source,
            rows=rows_of(found),
            head=HEAD,
            agreements=[agreement_in_words(each) for each in found.agreements],
            doubts=doubts_of(found),
            is_sound=found.is_complete and not found.contradicted and all(each.is_good for each in found.agreements),
            windows=len(found.batch.left_out),
            picture_png=(folder / PICTURE).read_bytes(),
            rig_yaml=to_text(found.rig, folder),
        )
        (folder / PAGE).write_text(text, encoding="utf-8")
        (folder / RIG).write_text(to_text(found.rig, folder), encoding="utf-8")
    return folder / PAGE


def _row(each: Finding) -> tuple[str, ...]:
    size, sigma, of_file = (float(np.sqrt(np.mean(v**2))) for v in (each.difference, each.sigmas, each.file_sigmas))
    remark = "beyond 5 sigma" if each.is_significant else "" if each.is_observed else "hardly shown"
    return each.part, f"{size:.3g} {each.unit}", f"{sigma:.2g}", f"{of_file:.2g}", remark
