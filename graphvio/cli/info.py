"""``graphvio info``: what a session holds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import options

if TYPE_CHECKING:
    from graphvio.sessions.description import Description, TopicDescription


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
