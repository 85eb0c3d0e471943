"""``graphvio live``: runs the odometry on sensors in real time, or lists the connected devices."""

from __future__ import annotations

from typing import Annotated

import typer

from graphvio.cli import completion, options
from graphvio.cli.json_output import publish


def live(
    source: Annotated[
        str | None,
        typer.Argument(
            help="KIND[:DEVICE][?OPTION=VALUE]: v4l2, realsense, oak, ros2, replay or simulator; "
            "or a recording's path.",
            autocompletion=completion.live_kind,
        ),
    ] = None,
    list_devices: Annotated[bool, typer.Option("--list", help="List the connected devices, and end.")] = False,
    *,
    asked: options.LiveOptions,
    view: options.View = False,
    serve: Annotated[
        bool, typer.Option("--serve", help="Serve other programs of this machine, see graphvio serve.")
    ] = False,
) -> None:
    """Run the odometry on live sensors until they end, or until Ctrl-C or SIGTERM; either leaves a complete recording.

    When processing falls behind, fewer corners are tracked, and then framesets are skipped and counted; IMU samples are
    never skipped. The exit code is 3 if a recording is incomplete, because the disk became full or was too slow.

    Examples:

        graphvio live --list

        graphvio live simulator

        graphvio live realsense --record walk.mcap

        graphvio live "replay:walk.mcap?speed=2" --view

        graphvio live realsense --cameras 0
    """
    if list_devices:
        _list()
        return
    if source is None:
        raise typer.BadParameter("give a SOURCE, or --list to see the connected devices")
    from graphvio.cli.live_run import run_live
    from graphvio.cli.services import Services

    services = None
    if serve:
        from graphvio.slam.service.options import ServiceOptions

        services = Services(ServiceOptions())
    run_live(source, asked, services, view=view)


def _list() -> None:
    """Print and publish the connected devices of each kind of source, or why they cannot be listed."""
    from graphvio.errors import GraphvioError
    from graphvio.live.sources import KINDS, kind_of

    found: list[dict[str, object]] = []
    for kind in KINDS:
        try:
            devices = kind_of(kind).list_devices()
        except GraphvioError as error:
            found.append({"kind": kind, "devices": [], "error": str(error)})
            typer.echo(f"{kind:<10} {error}")
            continue
        listed = [{"spec": device.spec, "description": device.description} for device in devices]
        found.append({"kind": kind, "devices": listed, "error": None})
        for device in devices:
            typer.echo(f"{kind:<10} {device.spec}   {device.description}")
        if not devices:
            typer.echo(f"{kind:<10} nothing is connected")
    publish(found)
