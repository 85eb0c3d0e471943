"""``graphvio fleet optimize``: optimises many sessions in parallel."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import options
from graphvio.cli.json_output import publish, with_json
from graphvio.cli.shared import EXIT_INCOMPLETE, ends_at_interrupt, reading_of, warn

if TYPE_CHECKING:
    from rich.progress import Progress

    from graphvio.fleet.run import FleetProgress

_Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        help="Address of a running Dask scheduler, such as tcp://host:8786.  [default: workers on this machine]",
        metavar="ADDRESS",
    ),
]
_Workers = Annotated[
    int | None,
    typer.Option(
        "--workers", help="Number of processes on this machine.  [default: half its cores, and two at least]", min=1
    ),
]

fleet = typer.Typer(help="Many sessions side by side, on this machine or on a Dask cluster.", no_args_is_help=True)


@fleet.callback()
def _group() -> None:
    """Many sessions side by side, on this machine or on a Dask cluster."""


@fleet.command()
@with_json
def optimize(
    sessions: Annotated[
        str,
        typer.Argument(
            help="Folder of recordings, or text file with a path or URL a line; itself a path or URL.",
            metavar="FOLDER|LIST",
        ),
    ],
    out: Annotated[
        str,
        typer.Option(
            "--out", help="Folder for the results, path or URL: new, or that of a run to continue.", metavar="DIR"
        ),
    ],
    reading: options.ReadingOptions,
    scheduler: _Scheduler = None,
    workers: _Workers = None,
    no_loops: options.NoLoops = False,
    refine_calibration: options.RefineCalibration = False,
) -> None:
    """Optimise many sessions, each by itself, and write a table of the results.

    A session that fails does not affect the others: it is tried three times, and then the table has its error. When the
    command is run again with the same --out, it computes only the missing results.

    The exit code is 0; 2 if the input cannot be used; 3 if a session failed.

    Examples:

        graphvio fleet optimize recordings --out results

        graphvio fleet optimize list.txt --out s3://bucket/results --scheduler tcp://10.0.0.5:8786
    """
    import logging

    from graphvio.config import Config
    from graphvio.errors import FleetError
    from graphvio.fleet.cluster import distributed
    from graphvio.fleet.listing import list_sessions
    from graphvio.fleet.run import optimize_fleet
    from graphvio.optimization.loops.colmap_library import colmap
    from graphvio.rig_files import load_rig

    if scheduler is not None and workers is not None:
        raise FleetError("--workers is for this machine, and a --scheduler has its own workers: give one of them")
    distributed()
    if not no_loops:
        colmap()
    settings = Config.load(reading.config)
    loaded = None if reading.rig is None else load_rig(reading.rig)
    parsed = reading_of(reading)
    listed = list_sessions(sessions)
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # errors are printed below
    with ends_at_interrupt(f"interrupted; the same command with --out {out} continues from there"), _bars() as bars:
        task = bars.add_task("0 tasks", total=len(listed))
        outcomes = optimize_fleet(
            listed,
            out,
            settings,
            rig=loaded,
            with_loops=not no_loops,
            calibrates=refine_calibration,
            reading=parsed,
            scheduler=scheduler,
            workers=workers,
            on_progress=lambda progress: bars.update(
                task, completed=progress.optimized + progress.failed, description=_description(progress)
            ),
        )
    publish({"results": out, "sessions": [asdict(each) | {"status": each.status} for each in outcomes]})
    failed = [each for each in outcomes if each.error]
    for each in failed:
        warn(f"{each.name} failed in {each.failed_in}: {each.error}")
    typer.echo(f"{len(outcomes) - len(failed)} of {len(outcomes)} sessions optimised")
    typer.echo(f"results: {out}")
    if failed:
        raise typer.Exit(EXIT_INCOMPLETE)


def _bars() -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("sessions, {task.description}"), TimeElapsedColumn())
    return Progress(*columns, console=Console(stderr=True))


def _description(progress: FleetProgress) -> str:
    texts = [f"{progress.tasks} tasks"]
    texts += [f"{progress.failed} failed"] if progress.failed else []
    texts += [progress.latest] if progress.latest else []
    return ", ".join(texts)
