"""``graphvio optimize``: optimises recorded sessions as a whole, with loop closures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import options
from graphvio.cli.json_output import publish
from graphvio.cli.shared import (
    EXIT_INCOMPLETE,
    MIN_COMPLETION,
    ends_at_interrupt,
    open_recording,
    stage_bars,
    warn,
)

if TYPE_CHECKING:
    from graphvio.optimization.optimize import Optimization


def optimize(
    sources: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings of one place: folders (EuRoC/ASL, TUM-VI, KITTI), sessions (.mcap) or ROS bags.",
            metavar="SOURCE",
        ),
    ],
    reading: options.ReadingOptions,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Folder for the results: new, or that of an interrupted run of the same, which is continued.  "
            "[default: results/NAME-optimized-N]",
            metavar="DIR",
        ),
    ] = None,
    no_loops: options.NoLoops = False,
    refine_calibration: options.RefineCalibration = False,
) -> None:
    """Optimise the trajectory of recorded sessions from all their measurements.

    Calibrates the rig from the whole recording, runs the odometry, detects revisited places with all cameras, and
    optimises everything as one graph. Several sessions of one place are transformed into one frame. To continue an
    interrupted run, repeat the command with the same --out. With calibration: {online: false} in the configuration, the
    rig file is used as it is.

    The exit code is 0; 2 if the input cannot be used; 3 if less than 90 % of a session's framesets have a pose (the
    results are written all the same); 130 after Ctrl-C.

    Examples:

        graphvio optimize walk --out walk-optimized

        graphvio optimize monday.mcap tuesday.mcap --out both

        graphvio optimize walk --cameras 0 --no-pairs
    """
    from graphvio.cli.warming import warm_up_visibly
    from graphvio.config import Config
    from graphvio.optimization.loops.colmap_library import colmap
    from graphvio.optimization.pipeline import optimize_sessions
    from graphvio.results import ResultWriter
    from graphvio.runtime import set_up_threads

    if not no_loops:
        colmap()  # fails here if it is not installed, not after hours of work
    settings = Config.load(reading.config)
    opened = [open_recording(source, reading, settings) for source in sources]
    folder = out
    if folder is None:
        folder = ResultWriter.new_folder(Path("results"), f"{opened[0].name}-optimized")
    set_up_threads()
    for source in opened:
        warm_up_visibly(source.rig, settings)
    message = f"interrupted; the same command with --out {folder} continues from there"
    with ends_at_interrupt(message), stage_bars() as show:
        found = optimize_sessions(
            opened, folder, settings, with_loops=not no_loops, calibrates=refine_calibration, on_progress=show
        )
    complete = [_print_session(folder / session.record.name) for session in found.sessions]
    publish(json.loads((folder / "summary.json").read_text(encoding="utf-8")) | {"results": str(folder)})
    print_summary(found, folder)
    if not all(complete):
        raise typer.Exit(EXIT_INCOMPLETE)


def _print_session(session: Path) -> bool:
    """Print a session's calibration findings, warnings and faults; return whether `MIN_COMPLETION` is reached."""
    from graphvio.optimization.session_calibration import session_findings

    odometry = session / "odometry"
    findings = session_findings(session)
    for sentence in findings:
        typer.echo(f"{session.name}: {sentence}")
    summary = json.loads((odometry / "summary.json").read_text(encoding="utf-8"))
    for warning in summary["warnings"]:
        warn(warning if findings else f"{warning}; let it be calibrated first (calibration: {{online: true}})")
    faults = ", ".join(f"{kind} {count}" for kind, count in sorted(summary["input_faults"].items()))
    if faults:
        typer.echo(f"faults of {session.name}: {faults}")
    is_complete = bool(summary["completion"] >= MIN_COMPLETION)
    if not is_complete:
        share = 100 * summary["completion"]
        warn(f"only {share:.0f} % of the framesets have a pose; the events in {odometry} say why")
    return is_complete


def print_summary(found: Optimization, folder: Path) -> None:
    """Print an optimisation's loop closures, its cost and the refined calibration."""
    from graphvio.optimization.report.calibration import calibrations
    from graphvio.optimization.report.numbers import median_sigmas, rig_of
    from graphvio.optimization.report.page import plain

    used = sum(not loop.refusal for loop in found.loops)
    typer.echo(
        f"{sum(len(each.record.stamps_ns) for each in found.sessions)} framesets, "
        f"{sum(len(each.nodes.rows) for each in found.sessions)} states, "
        f"{len(found.loops)} loop closures found, {used} used"
    )
    frames = len(set(found.frames))
    if frames > 1:
        warn(f"{frames} parts that no loop closures join, each in a frame of its own")
    before, after = (median_sigmas(kinds.get("motion")) for kinds in (found.before, found.after))
    median = ""
    if before is not None and after is not None:
        median = f"; median error per motion {plain(before)} -> {plain(after)} sigmas"
    typer.echo(f"cost {plain(found.cost_before)} -> {plain(found.cost_after)}{median}")
    for each in calibrations(found, [rig_of(folder, session.record.name) for session in found.sessions]):
        if each is not None:
            name = "" if len(found.sessions) == 1 else f"{each.session}, "
            for line in each.lines():
                typer.echo(f"{name}{line}")
    typer.echo(f"results: {folder}")
