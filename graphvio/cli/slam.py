"""``graphvio slam``: the odometry with the reference SLAM behind it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import options
from graphvio.cli.live import run_live
from graphvio.cli.services import Services, Started

if TYPE_CHECKING:
    from contextlib import ExitStack
    from multiprocessing.context import SpawnProcess
    from multiprocessing.synchronize import Event

    from graphvio.live.path_output import PathOutput
    from graphvio.live.running import LiveOdometry
    from graphvio.mapping.process import MappingTask

EXIT_FAILED = 2
_LOOK_S = 0.1
_PATIENCE_S = 300.0  # for a SLAM that is behind when the odometry ends


def slam(
    source: options.LiveSource,
    rig: options.RigFile = None,
    config: options.ConfigName = "default",
    saved_map: Annotated[
        Path | None, typer.Option("--map", help="Saved map to find the way in, and to go on with.", metavar="DIR")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Save the map, and the trajectory in it.", metavar="DIR")
    ] = None,
    view: Annotated[bool, typer.Option("--view", help="Watch both trajectories in the rerun viewer.")] = False,
    ros2: options.Ros2Domain = None,
    web: options.WebPort = None,
    save_rrd: Annotated[
        Path | None, typer.Option("--save-rrd", help="Save what the viewer would show; needs no display.")
    ] = None,
    record: options.Record = None,
    png: options.Png = False,
    health_port: options.HealthPort = None,
    duration: options.Duration = None,
    verbose: options.Verbose = False,
) -> None:
    """Run the odometry with a small SLAM system behind it, in a process of its own, that corrects its place in the map.

    The SLAM recognises places, optimises a graph of them and sends corrections by gRPC, as any other would do. With
    --map the rig finds its place in a saved map.

    Examples:

        graphvio slam simulator:loop --out map

        graphvio slam realsense --map map --view
    """
    from graphvio.errors import MapError
    from graphvio.mapping.saved_map import check_target

    if out is not None:
        check_target(out)
        if out.exists() and any(out.iterdir()) and (saved_map is None or out.resolve() != saved_map.resolve()):
            raise MapError(f"{out}: holds a map already; name another folder, or go on with it by  --map {out}")
    services = _WithMapping(
        port=0, ros2_domain=ros2, saved_map=saved_map, out=out, view=view, map_web_port=web, save_rrd=save_rrd
    )
    run_live(
        source, rig, config, record=record, png=png, view=False, health_port=health_port, duration_s=duration,
        services=services,
    )  # fmt: skip


@dataclass(frozen=True)
class _WithMapping(Services):
    """gRPC on this machine, ROS 2 topics where asked for, and the SLAM as a client of gRPC.

    Attributes:
        saved_map: to begin with.
        out: for the map.
        view: open a window.
        map_web_port: of the page for browsers.
        save_rrd: for what is shown.
    """

    saved_map: Path | None = None
    out: Path | None = None
    view: bool = False
    map_web_port: int | None = None
    save_rrd: Path | None = None

    def start(self, running: LiveOdometry, stack: ExitStack) -> Started:
        """Offer the odometry, and start the SLAM; see `Services.start`."""
        from multiprocessing import get_context

        from graphvio.live.path_output import PathOutput
        from graphvio.mapping.process import MappingTask

        offered = super().start(running, stack)
        task = MappingTask(
            offered.address,
            running.odometry.config,
            self.saved_map,
            self.out,
            self.view,
            self.map_web_port,
            self.save_rrd,
        )
        path = PathOutput(lambda: running.map_T_odom)
        if self.out is not None:
            running.add_output(path)
        context = get_context("spawn")
        ready = context.Event()
        process = context.Process(target=_map, args=(task, ready), name="graphvio-slam")
        process.start()
        stack.callback(process.kill)
        while not ready.wait(_LOOK_S):  # places that are seen before would be lost
            _check(process)

        def check() -> None:
            offered.check()
            _check(process)

        return replace(offered, check=check, finish=lambda: _finish(process, path, self.out))


def _map(task: MappingTask, ready: Event) -> None:
    """What the SLAM's process does."""
    from graphvio.errors import GraphvioError
    from graphvio.mapping.process import run_mapping

    try:
        typer.echo(run_mapping(task, ready), err=True)
    except GraphvioError as error:
        typer.echo(f"graphvio: mapping: {error}", err=True)
        raise SystemExit(EXIT_FAILED) from None


def _check(process: SpawnProcess) -> None:
    """Notice a SLAM that failed.

    Raises:
        ServiceError: if it did.
    """
    from graphvio.errors import ServiceError

    if process.exitcode:
        raise ServiceError(f"the SLAM failed (exit code {process.exitcode}); what it said is above")


def _finish(process: SpawnProcess, path: PathOutput, out: Path | None) -> None:
    """Wait until the SLAM has worked on all keyframes and saved the map, and put the odometry's path beside it.

    Raises:
        ServiceError: if it failed.
    """
    from graphvio.errors import ServiceError

    if process.is_alive():
        typer.echo("waiting for the SLAM, which works on the last keyframes", err=True)
    process.join(_PATIENCE_S)
    if process.exitcode is None:
        raise ServiceError(f"the SLAM is not done {_PATIENCE_S:g} s after the odometry; its map is not saved")
    _check(process)
    if out is not None:
        path.write(out)
        typer.echo(f"map: {out}; paths in it: odometry.txt, online.txt as it was known, trajectory.txt as it is now")
