"""``graphvio info`` and ``graphvio dump-config``: show the contents of a recording and the values of a profile."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import completion, options
from graphvio.cli.json_output import publish
from graphvio.cli.shared import check_scene

if TYPE_CHECKING:
    from graphvio.sessions.stamps import Clock
    from graphvio.sources.description import Regularity, Synchronisation


def info(
    source: options.Source,
    rig: options.RigFile = None,
) -> None:
    """Show what a recording contains: its duration, its rig, and cameras and IMU with their rates, gaps and jitter.

    For a session or bag it shows all topics, and how far their clocks can be trusted: stamps that go back or jump, the
    delay from a message's stamp to its recording and the drift of this delay, and how well cameras are synchronised.

    The exit code is 0; 2, with a line that says why, if the path is no recording that can be run.

    Examples:

        graphvio info walk

        graphvio info mh01.mcap
    """
    from graphvio.errors import SourceError, reading
    from graphvio.sessions.store import is_store

    with reading(source, SourceError, "check the path"):
        is_session = is_store(source)
    check_scene(source)
    if is_session:
        _show_session(source, rig)
    else:
        _show_folder(source, rig)


def _show_session(path: Path, rig: Path | None) -> None:
    from graphvio.rig_files import load_rig
    from graphvio.sources.description import describe, rig_line

    found = describe(path)
    if rig is not None:
        found = replace(found, rig=rig_line(load_rig(rig)))
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
        regularity = "" if topic.regularity is None else _regularity(topic.regularity)
        clock = "" if topic.regularity is None or topic.clock is None else _clock(topic.clock)
        typer.echo(f"{topic.name}  ({topic.type_name}): {topic.messages} messages{regularity}{clock}")
    for each in found.synchronisation:
        typer.echo(_synchronised(each))


def _show_folder(path: Path, rig: Path | None) -> None:
    from graphvio.sources.contents import describe_folder

    found = describe_folder(path, rig)
    publish(found)
    rate = "" if found.rate_hz is None else f" at {found.rate_hz:.2f} Hz"
    typer.echo(f"{found.path}: {found.layout}, {found.duration_s:.1f} s, {found.framesets} framesets{rate}")
    typer.echo(f"rig: {found.rig}")
    for sensor in found.sensors:
        size = "" if sensor.size_px is None else f" of {sensor.size_px[0]}x{sensor.size_px[1]}"
        what = f"{sensor.count} {'samples' if sensor.name == 'imu' else 'images'}{size}"
        typer.echo(f"{sensor.name}: {what}{'' if sensor.regularity is None else _regularity(sensor.regularity)}")
    typer.echo(f"true trajectory: {found.truth or 'none'}")
    if found.faults:
        typer.echo("faults: " + ", ".join(f"{kind} {count}" for kind, count in sorted(found.faults.items())))


def dump_config(
    profile: Annotated[
        str, typer.Argument(help="Profile or YAML file.", autocompletion=completion.profile)
    ] = "default",
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


def _regularity(found: Regularity) -> str:
    rate = "" if found.rate_hz is None else f", {found.rate_hz:.2f} Hz"
    return f"{rate}, jitter {found.jitter_ms:.2f} ms, {found.gaps} gaps, longest interval {found.longest_ms:.1f} ms"


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
