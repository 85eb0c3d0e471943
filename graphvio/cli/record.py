"""``graphvio record``: the odometry runs, and everything that goes in and comes out is a session on disk."""

from __future__ import annotations

import typer

from graphvio.cli import options

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
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from graphvio.cli.run import open_recording
    from graphvio.config import Config
    from graphvio.odometry import Odometry
    from graphvio.sessions.writer import SessionWriter
    from graphvio.warmup import warm_up

    settings = Config.load(config)
    opened = open_recording(source, rig, settings, pairs=None, no_imu=no_imu, from_s=from_s, to_s=to_s, topics=topics)
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
