"""``graphvio convert`` and ``graphvio info``: recordings as sessions, and what is in one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import options

if TYPE_CHECKING:
    from graphvio.sessions.description import Description, TopicDescription

EXIT_STOPPED = 3


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
    """Write a recording as a session: one MCAP file with ROS 2 messages, which other tools open as it is.

    Ends with exit code 3 where the disk became full; what was written until then can be read.

    Examples:

        graphvio convert MH_01_easy --out mh01.mcap

        graphvio convert walk --from 10 --to 20 --png --out piece.mcap
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from graphvio.cli.run import open_recording
    from graphvio.config import Config
    from graphvio.events import FrameSet
    from graphvio.sessions.writer import SessionWriter

    opened = open_recording(source, rig, Config(), pairs=None, no_imu=False, from_s=from_s, to_s=to_s, topics=topics)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        SessionWriter(out, opened.rig, "png" if png else "raw") as writer,
        Progress(*columns, console=Console(stderr=True), transient=True) as bar,
    ):
        task = bar.add_task("framesets", total=opened.frameset_count)
        for event in opened:
            writer.add(event)
            bar.advance(task, isinstance(event, FrameSet))
            if writer.stopped is not None:
                break
        for incident in opened.faults.incidents:
            writer.add_incident(incident)
    if writer.stopped is not None:
        typer.echo(f"graphvio: {writer.stopped}", err=True)
        raise typer.Exit(EXIT_STOPPED)
    typer.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


def info(
    session: Annotated[Path, typer.Argument(help="Session (.mcap).")],
    verbose: options.Verbose = False,
) -> None:
    """Tell what a session holds: topics with their rates, gaps and jitter, how long, how large, what rig.

    Example:

        graphvio info mh01.mcap
    """
    from graphvio.sessions.description import describe

    _tell(describe(session))


def _tell(found: Description) -> None:
    typer.echo(
        f"{found.path}: {found.duration_s:.1f} s, {found.size_bytes / 1e6:.1f} MB"
        + ("" if found.is_whole else ", cut: its recording was not finished")
    )
    typer.echo(f"written by {found.library or 'an unknown program'}")
    typer.echo(f"rig: {found.rig or 'none inside; give one with --rig'}")
    for topic in found.topics:
        typer.echo(f"{topic.name}  ({topic.type_name}): {topic.messages} messages{_regularity(topic)}")


def _regularity(topic: TopicDescription) -> str:
    if topic.rate_hz is None:
        return ""
    told = f", {topic.rate_hz:.2f} Hz, jitter {topic.jitter_ms:.2f} ms, {topic.gaps} gaps, longest interval "
    told += f"{topic.longest_ms:.1f} ms"
    return told if topic.latency_ms is None else f"{told}, recorded {topic.latency_ms:.2f} ms after their stamps"
