"""``graphvio record``: the odometry runs, and everything that goes in and comes out is a session on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EXIT_STOPPED = 3


def record(
    source: Annotated[Path, typer.Argument(help="Recording: a folder as for `graphvio run`, or a session (.mcap).")],
    out: Annotated[Path, typer.Option("--out", help="Session to write; a new file, .mcap.", metavar="FILE")],
    rig: Annotated[
        Path | None, typer.Option("--rig", help="Rig or calibration file.  [default: what the recording carries]")
    ] = None,
    config: Annotated[
        str, typer.Option("--config", help="Profile, or a YAML file with the values to change.")
    ] = "default",
    png: Annotated[bool, typer.Option("--png", help="Pack images as PNG: smaller and slower.")] = False,
    no_imu: Annotated[bool, typer.Option("--no-imu", help="Use the cameras alone.")] = False,
    from_s: Annotated[float | None, typer.Option("--from", help="Begin at this second of the recording.")] = None,
    to_s: Annotated[float | None, typer.Option("--to", help="End at this second of the recording.")] = None,
    verbose: Annotated[bool, typer.Option("--verbose", help="Show the traceback of an error.")] = False,
) -> None:
    """Run the odometry and record images, IMU, rig, poses and incidents as a session (MCAP, ROS 2 messages).

    When the disk is full recording stops, the odometry goes on, and the exit code is 3.

    Example:

        graphvio record walk --out walk.mcap
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from graphvio.cli.run import open_recording
    from graphvio.config import Config
    from graphvio.odometry import Odometry
    from graphvio.sessions.writer import SessionWriter
    from graphvio.warmup import warm_up

    settings = Config.load(config)
    opened = open_recording(source, rig, settings, pairs=None, no_imu=no_imu, from_s=from_s, to_s=to_s)
    odometry = Odometry(opened.rig, settings)
    estimated = 0
    with SessionWriter(out, opened.rig, "png" if png else "raw") as writer:
        warm_up(opened.rig, settings)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("framesets", total=opened.frameset_count)
            for event in opened:
                writer.add(event)
                estimate = odometry.process(event)
                if estimate is not None:
                    writer.add_estimate(estimate)
                    estimated += estimate.nav_T_body is not None
                    bar.advance(task)
                for incident in odometry.take_incidents():
                    writer.add_incident(incident)
            for estimate in odometry.finish():
                writer.add_estimate(estimate)
                estimated += estimate.nav_T_body is not None
        for incident in (*odometry.take_incidents(), *opened.faults.incidents):
            writer.add_incident(incident)
    typer.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {estimated} poses")
    if writer.stopped is not None:
        typer.echo(f"graphvio: {writer.stopped}", err=True)
        raise typer.Exit(EXIT_STOPPED)
