"""``graphvio record`` and ``graphvio convert``: sessions on disk, with what the odometry made of them or without."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from graphvio.cli import options

if TYPE_CHECKING:
    from pathlib import Path

    from graphvio.odometry import Odometry
    from graphvio.sources import Source

EXIT_STOPPED = 3


def record(
    source: options.Source,
    out: options.SessionOut,
    rig: options.RigFile = None,
    topics: options.Topics = None,
    config: options.ConfigName = "default",
    png: options.Png = False,
    no_imu: options.NoImu = False,
    from_s: options.FromS = None,
    to_s: options.ToS = None,
    verbose: options.Verbose = False,
) -> None:
    """Run the odometry and record images, IMU, rig, poses and incidents as a session (MCAP, ROS 2 messages).

    When the disk is full recording stops, the odometry goes on, and the exit code is 3.

    Example:

        graphvio record walk --out walk.mcap
    """
    from graphvio.cli.run import open_recording
    from graphvio.config import Config
    from graphvio.odometry import Odometry
    from graphvio.warmup import warm_up

    settings = Config.load(config)
    opened = open_recording(source, rig, settings, pairs=None, no_imu=no_imu, from_s=from_s, to_s=to_s, topics=topics)
    warm_up(opened.rig, settings)
    _write(opened, out, png, Odometry(opened.rig, settings))


def convert(
    source: options.Source,
    out: options.SessionOut,
    rig: options.RigFile = None,
    topics: options.Topics = None,
    png: options.Png = False,
    from_s: options.FromS = None,
    to_s: options.ToS = None,
    verbose: options.Verbose = False,
) -> None:
    """Write a recording as a session: one MCAP file with ROS 2 messages.

    Ends with exit code 3 where the disk became full; what was written until then can be read.

    Examples:

        graphvio convert MH_01_easy --out mh01.mcap

        graphvio convert walk --from 10 --to 20 --png --out piece.mcap
    """
    from graphvio.cli.run import open_recording
    from graphvio.config import Config

    opened = open_recording(source, rig, Config(), pairs=None, no_imu=False, from_s=from_s, to_s=to_s, topics=topics)
    _write(opened, out, png, None)


def _write(opened: Source, out: Path, png: bool, odometry: Odometry | None) -> None:
    """Record all events, and what an odometry makes of them; without one there is no reason to go on when the disk is
    full."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from graphvio.events import FrameSet
    from graphvio.sessions.writer import SessionWriter

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        SessionWriter(out, opened.rig, "png" if png else "raw") as writer,
        Progress(*columns, console=Console(stderr=True), transient=True) as bar,
    ):
        task = bar.add_task("framesets", total=opened.frameset_count)
        for event in opened:
            writer.add(event)
            bar.advance(task, isinstance(event, FrameSet))
            if odometry is not None:
                estimate = odometry.process(event)
                if estimate is not None:
                    writer.add_estimate(estimate)
                for incident in odometry.take_incidents():
                    writer.add_incident(incident)
            elif writer.stopped is not None:
                break
        if odometry is not None:
            for estimate in odometry.finish():
                writer.add_estimate(estimate)
        incidents = odometry.take_incidents() if odometry is not None else []
        for incident in (*incidents, *opened.faults.incidents):
            writer.add_incident(incident)
    typer.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {writer.poses} poses")
    if writer.stopped is not None:
        typer.echo(f"graphvio: {writer.stopped}", err=True)
        raise typer.Exit(EXIT_STOPPED)
