"""``graphvio info`` and ``graphvio dump-config``: the contents of a session or bag, and the values of a profile."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import options
from graphvio.cli.json_output import publish

if TYPE_CHECKING:
    from graphvio.sessions.stamps import Clock
    from graphvio.sources.description import Synchronisation, TopicDescription


def info(
    session: Annotated[Path, typer.Argument(help="Session (.mcap) or ROS bag (.bag, or a ROS 2 folder).")],
    verbose: options.Verbose = False,
) -> None:
    """Show the contents of a session or bag: duration, size, rig, and topics with their rates, gaps and jitter.

    Also shows how far clocks can be trusted: stamps that go back or jump, the delay from a message's stamp to its
    recording with its drift, and how well cameras are synchronised.

    Examples:

        graphvio info mh01.mcap

        graphvio info walk.bag
    """
    from graphvio.sources.description import describe

    found = describe(session)
    publish(found)
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


def dump_config(
    profile: Annotated[str, typer.Argument(help="Profile or YAML file.")] = "default",
    verbose: options.Verbose = False,
) -> None:
    """Print all values of a configuration as YAML.

    Examples:

        graphvio dump-config > mine.yaml

        graphvio dump-config paper
    """
    from graphvio.config import Config

    settings = Config.load(profile)
    publish(settings)
    typer.echo(settings.to_yaml(), nl=False)


def _regularity(topic: TopicDescription) -> str:
    if topic.rate_hz is None:
        return ""
    text = f", {topic.rate_hz:.2f} Hz, jitter {topic.jitter_ms:.2f} ms, {topic.gaps} gaps, longest interval "
    text += f"{topic.longest_ms:.1f} ms"
    return text if topic.clock is None else text + _clock(topic.clock)


def _clock(clock: Clock) -> str:
    text = f", recorded {clock.latency_ms:.2f} ms after their stamps"
    if clock.drift_ms_per_minute is not None:
        text += f", drifting by {clock.drift_ms_per_minute:.2f} +- {clock.drift_sigma:.2f} ms a minute"
    if clock.backward:
        text += f", {clock.backward} stamps that repeat or go back"
    if clock.jumps:
        text += f", {clock.jumps} jumps of the stamps by a second or more"
    return text


def _synchronised(found: Synchronisation) -> str:
    what = f"{found.first} to {found.second}: "
    if found.offset is None:
        return f"{what}no stamps match"
    text = f"{what}{found.offset.matched} of {found.images} images, the second {found.offset.median_ms:.3f} ms later"
    return f"{text} (median), {found.offset.largest_ms:.3f} ms apart at most"
