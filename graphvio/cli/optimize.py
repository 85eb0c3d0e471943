"""``graphvio optimize``: recorded sessions as a whole, with loop closures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graphvio.cli import options

if TYPE_CHECKING:
    from graphvio.optimization.optimize import Optimization


def optimize(
    sources: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings of one place: folders (EuRoC/ASL, TUM-VI, KITTI), sessions (.mcap) or ROS bags.",
            metavar="SOURCE...",
        ),
    ],
    rig: options.RigFile = None,
    topics: options.Topics = None,
    config: options.ConfigName = "default",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Folder for the results: new, or that of an interrupted run of the same, which goes on.  "
            "[default: results/NAME-optimized-N]",
            metavar="DIR",
        ),
    ] = None,
    pairs: options.Pairs = None,
    no_imu: options.NoImu = False,
    no_loops: Annotated[bool, typer.Option("--no-loops", help="Look for no loop closures.")] = False,
    refine_calibration: Annotated[
        bool,
        typer.Option("--refine-calibration", help="Find the pairs' places and the IMU's time offset, too."),
    ] = False,
    from_s: options.FromS = None,
    to_s: options.ToS = None,
    verbose: options.Verbose = False,
) -> None:
    """Find the best trajectory that all measurements of recorded sessions hold together.

    Runs the odometry, finds places that are seen again, by any pair, and optimises everything as one graph. Several
    sessions of one place are brought into one frame. What is interrupted goes on where it was when it is started again
    with the same --out.

    Ends with exit code 0; with 2 where the input cannot be used; with 3 where less than 90 % of a session's framesets
    have a pose (the results are written all the same); with 130 after Ctrl-C.

    Examples:

        graphvio optimize walk --out walk-optimized

        graphvio optimize monday.mcap tuesday.mcap --out both
    """
    from graphvio.cli.run import EXIT_INCOMPLETE, EXIT_INTERRUPTED, open_recording
    from graphvio.config import Config
    from graphvio.optimization.loops.database import colmap
    from graphvio.optimization.pipeline import optimize_sessions
    from graphvio.results import ResultWriter
    from graphvio.runtime import interruptible, use_one_opencv_thread
    from graphvio.warmup import warm_up

    if not no_loops:
        colmap()  # before hours of work, not after
    settings = Config.load(config)
    opened = [
        open_recording(source, rig, settings, pairs=pairs, no_imu=no_imu, from_s=from_s, to_s=to_s, topics=topics)
        for source in sources
    ]
    folder = out
    if folder is None:
        folder = ResultWriter.new_folder(Path("results"), f"{opened[0].name}-optimized")
    use_one_opencv_thread()
    for source in opened:
        warm_up(source.rig, settings)
    try:
        with interruptible(), _Stages() as stages:
            found = optimize_sessions(
                opened,
                folder,
                settings,
                with_loops=not no_loops,
                calibrates=refine_calibration,
                on_progress=stages.show,
            )
    except KeyboardInterrupt:
        typer.echo(f"graphvio: interrupted; the same command with --out {folder} goes on from there", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    complete = [_warn(folder / session.record.name / "odometry") for session in found.sessions]
    _tell(found, folder)
    if not all(complete):
        raise typer.Exit(EXIT_INCOMPLETE)


class _Stages:
    """A bar for each stage."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (TextColumn("{task.description:<28}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        self._bars = Progress(*columns, console=Console(stderr=True))
        self._tasks: dict[str, Any] = {}

    def __enter__(self) -> _Stages:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def show(self, stage: str, done: float, total: float) -> None:
        """Draw how far a stage is."""
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total)
        self._bars.update(self._tasks[stage], completed=done, total=total)


def _warn(odometry: Path) -> bool:
    """Tell what the odometry found wrong in a session; whether most framesets have a pose."""
    from graphvio.cli.run import LEAST_COMPLETION

    summary = json.loads((odometry / "summary.json").read_text(encoding="utf-8"))
    for warning in summary["warnings"]:
        typer.echo(f"graphvio: {warning}; try --refine-calibration, or graphvio calibrate", err=True)
    faults = ", ".join(f"{kind} {count}" for kind, count in sorted(summary["input_faults"].items()))
    if faults:
        typer.echo(f"faults of {odometry.parent.name}: {faults}")
    is_complete = bool(summary["completion"] >= LEAST_COMPLETION)
    if not is_complete:
        share = 100 * summary["completion"]
        typer.echo(f"graphvio: only {share:.0f} % of the framesets have a pose; {odometry} tells why", err=True)
    return is_complete


def _tell(found: Optimization, folder: Path) -> None:
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
        typer.echo(f"graphvio: {frames} parts that no loop closures join, each in a frame of its own", err=True)
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
