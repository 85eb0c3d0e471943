"""``graphvio info``: what a session or bag holds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import options

if TYPE_CHECKING:
    from graphvio.sessions.stamps import Clock
    from graphvio.sources.description import Description, Synchronisation, TopicDescription


def info(
    session: Annotated[Path, typer.Argument(help="Session (.mcap) or ROS bag (.bag, or a ROS 2 folder).")],
    verbose: options.Verbose = False,
) -> None:
    """Tell what a session or bag holds: topics with their rates, gaps and jitter, how long, how large, what rig; and
    how far clocks are to be trusted: stamps that go back or jump, how long after its stamp a message was recorded and
    whether that drifts, and how well cameras are synchronised.

    Examples:

        graphvio info mh01.mcap

        graphvio info walk.bag
    """
    from graphvio.sources.description import describe

    _tell(describe(session))


def _tell(found: Description) -> None:
    typer.echo(
        f"{found.path}: {found.duration_s:.1f} s, {found.size_bytes / 1e6:.1f} MB"
        + ("" if found.is_whole else ", cut: its recording was not finished, or it is damaged")
        + (f", {found.damaged} damaged chunks or records" if found.damaged else "")
    )
    if found.library:
        typer.echo(f"written by {found.library}")
    typer.echo(f"rig: {found.rig or 'none inside; give one with --rig'}")
    for topic in found.topics:
        typer.echo(f"{topic.name}  ({topic.type_name}): {topic.messages} messages{_regularity(topic)}")
    for each in found.synchronisation:
        typer.echo(_synchronised(each))


def _regularity(topic: TopicDescription) -> str:
    if topic.rate_hz is None:
        return ""
    told = f", {topic.rate_hz:.2f} Hz, jitter {topic.jitter_ms:.2f} ms, {topic.gaps} gaps, longest interval "
    told += f"{topic.longest_ms:.1f} ms"
    return told if topic.clock is None else told + _clock(topic.clock)


def _clock(clock: Clock) -> str:
    told = f", recorded {clock.latency_ms:.2f} ms after their stamps"
    if clock.drift_ms_per_minute is not None:
        told += f", drifting by {clock.drift_ms_per_minute:.2f} +- {clock.drift_sigma:.2f} ms a minute"
    if clock.backward:
        told += f", {clock.backward} stamps that repeat or go back"
    if clock.jumps:
        told += f", {clock.jumps} jumps of the stamps by a second or more"
    return told


def _synchronised(found: Synchronisation) -> str:
    what = f"{found.first} to {found.second}: "
    if found.offset is None:
        return f"{what}no stamps belong together"
    told = f"{what}{found.offset.matched} of {found.images} images, the second {found.offset.median_ms:.3f} ms later"
    return f"{told} (median), {found.offset.largest_ms:.3f} ms apart at most"
