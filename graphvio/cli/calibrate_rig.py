"""``graphvio calibrate --what`` for other choices than pairs: calibration of a whole rig, or some of its parameters."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from graphvio.cli.json_output import publish
from graphvio.cli.shared import EXIT_INCOMPLETE, ends_at_interrupt, stage_bars, warn

if TYPE_CHECKING:
    from graphvio.config import Config
    from graphvio.odometry.recorded_calibration import RecordedCalibration
    from graphvio.sources import Source


def calibrate_rig(opened: Source, settings: Config, what: str, out: Path | None, report: Path | None) -> None:
    """Calibrate the rig of a recording, print the result, and write the rig file and the report if asked for."""
    from graphvio.calibration.report.rig_page import write_rig_report
    from graphvio.cli.warming import warm_up_visibly
    from graphvio.odometry.recorded_calibration import calibrate_recording
    from graphvio.rig_files import save_rig
    from graphvio.runtime import set_up_threads

    set_up_threads()
    warm_up_visibly(opened.rig, settings)
    totals = {"odometry": opened.frameset_count}
    with ends_at_interrupt("interrupted; nothing is written"), stage_bars(totals) as show:
        found = calibrate_recording(opened, opened.rig, what, settings, show)
    publish(_document(found))
    _print(found)
    if not found.is_consistent:
        warn(
            f"{out or 'the rig'} is not written: the halves contradict each other, so what is kept as in the file is "
            "wrong, too; calibrate with --what all"
        )
    elif out is not None:
        save_rig(found.rig, out)
        typer.echo(f"wrote {out}")
    if report is not None:
        typer.echo(f"report: {write_rig_report(found, report, opened.name)}")
    if not (found.is_complete and found.is_consistent):
        raise typer.Exit(EXIT_INCOMPLETE)


def _document(found: RecordedCalibration) -> dict[str, object]:
    from graphvio.calibration.report.rig_page import doubts_of

    return {
        "what": found.what,
        "complete": found.is_complete,
        "consistent": found.is_consistent,
        "parameters": [
            {
                "part": each.part,
                "unit": each.unit,
                "difference": each.difference.tolist(),
                "sigmas": each.sigmas.tolist(),
                "file_sigmas": each.file_sigmas.tolist(),
                "significant": each.is_significant,
            }
            for each in found.findings
        ],
        "halves": [
            {"group": each.group, "chi_square": each.statistic, "dimension": each.dimension, "agree": each.is_good}
            for each in found.agreements
        ],
        "remarks": found.remarks,
        "doubts": doubts_of(found),
    }


def _print(found: RecordedCalibration) -> None:
    from graphvio.calibration.report.rig_page import HEAD, agreement_in_words, doubts_of, rows_of

    rows = [HEAD, *rows_of(found)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(HEAD))]
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row[1:-1], widths[1:-1], strict=True)]
        typer.echo("  ".join([row[0].ljust(widths[0]), *cells, row[-1]]).rstrip())
    for remark in found.remarks:
        typer.echo(remark)
    agreements = found.agreements
    if agreements:
        worst = max(agreements, key=lambda each: each.statistic / each.dimension)
        good = sum(each.is_good for each in agreements)
        typer.echo(
            f"first half against second: {good} of {len(agreements)} groups agree; worst: {agreement_in_words(worst)}"
        )
    for doubt in doubts_of(found):
        warn(doubt)
