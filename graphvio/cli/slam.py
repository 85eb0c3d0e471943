"""``graphvio slam``: runs the odometry together with a small SLAM system."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from graphvio.cli import options
from graphvio.cli.services import Services, Started

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import ExitStack

    from graphvio.live.running import LiveOdometry
    from graphvio.mapping.process import MappingTask


def slam(
    source: options.LiveSource,
    asked: options.LiveOptions,
    saved_map: Annotated[
        Path | None, typer.Option("--map", help="Saved map to localise in and to extend.", metavar="DIR")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Save the map, and the trajectory in it.", metavar="DIR")
    ] = None,
    view: Annotated[bool, typer.Option("--view", help="Show both trajectories in the rerun viewer.")] = False,
    ros2: options.Ros2Domain = None,
    web: options.WebPort = None,
    save_rrd: options.SaveRrd = None,
) -> None:
    """Run the odometry with a small SLAM system in a process of its own, which corrects the pose in the map.

    The SLAM system recognises places, optimises a graph of them and sends corrections by gRPC, as any other SLAM system
    would. With --map, the rig is localised in a saved map. If the SLAM system fails, the odometry goes on, and the exit
    code is 3.

    Examples:

        graphvio slam simulator:loop --out map

        graphvio slam realsense --map map --view
    """
    from graphvio.errors import MapError
    from graphvio.mapping.saved_map import check_map, check_target
    from graphvio.slam.service.options import ServiceOptions

    if saved_map is not None:
        check_map(saved_map)
    if out is not None:
        check_target(out)
        if out.exists() and any(out.iterdir()) and (saved_map is None or out.resolve() != saved_map.resolve()):
            raise MapError(f"{out}: holds a map already; name another folder, or extend it by  --map {out}")
    if save_rrd is not None and save_rrd.exists():
        raise MapError(f"{save_rrd}: exists; name another file for --save-rrd")
    from graphvio.cli.live_run import run_live
    from graphvio.mapping.process import MappingTask

    task = MappingTask(saved_map, out, view, web, save_rrd)
    run_live(source, asked, _WithMapping(ServiceOptions(port=0), ros2, task=task))


@dataclass(frozen=True)
class _WithMapping(Services):
    """The services gRPC on this machine and, if asked for, ROS 2 topics; and the SLAM as a client of gRPC."""

    task: MappingTask = field(kw_only=True)  # task of the SLAM's process

    def start(self, running: LiveOdometry, stack: ExitStack, is_stopped: Callable[[], bool] = lambda: False) -> Started:
        """Start the services of the odometry, and the SLAM; see `Services.start`."""
        from graphvio.cli.slam_process import SlamProcess
        from graphvio.live.outputs import PathOutput
        from graphvio.viewer import WebOptions

        served = super().start(running, stack, is_stopped)
        task = replace(self.task, address=served.address, config=running.odometry.config)
        path = PathOutput(lambda: running.map_T_odom)
        if task.out is not None:
            running.add_output(path)
        process = SlamProcess(task, path)
        stack.callback(process.close)
        process.wait_ready(is_stopped)
        lines = list(served.lines)
        if task.web_port is not None:
            lines.append(f"browser: {WebOptions(port=task.web_port).url}")

        def check() -> None:
            served.check()
            process.check()

        return replace(served, lines=lines, check=check, finish=process.finish)
