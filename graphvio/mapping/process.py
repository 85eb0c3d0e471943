"""The reference SLAM in a process of its own, at the other end of the odometry's gRPC service."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.errors import GraphvioError, MapError, ServiceError
from graphvio.mapping.mapper import Mapper
from graphvio.optimization.loops.database import colmap
from graphvio.runtime import ignore_stop_signals, use_one_opencv_thread
from graphvio.slam.client import Client
from graphvio.slam.keyframe import Keyframe
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import save_trajectory
from graphvio.viewer import Viewer, WebOptions
from graphvio.warmup import warm_up

_MAP_COLOUR, _ODOM_COLOUR = (40, 190, 90), (150, 150, 150)
_SHOWN_EVERY = 3  # places


@dataclass(frozen=True)
class MappingTask:
    """What the process is to do.

    Attributes:
        address: of the odometry's service.
        config: of the odometry, whose ``optimization`` says what places and closures are.
        map: folder of a saved map to begin with, or None.
        out: folder for the map, or None.
        view: open rerun's window.
        web_port: let a browser watch on this port, or None.
        save_rrd: write what the viewer shows, or None.
        folder: empty, to work in; removed in the end. None: one is made.
    """

    address: str
    config: Config
    map: Path | None = None
    out: Path | None = None
    view: bool = False
    web_port: int | None = None
    save_rrd: Path | None = None
    folder: Path | None = None


def run_mapping(task: MappingTask, ready: Event) -> str:
    """Map until the odometry ends, and save the map; in a process of its own, whose signals it ignores from here on.

    After a failure, what is there by then is saved.

    Args:
        task: what to do.
        ready: is set when keyframes may come.

    Returns:
        The summary, in one line.

    Raises:
        GraphvioError: if the odometry cannot be reached, or the map not be used or written.
    """
    colmap()  # takes SIGTERM for itself when it is loaded
    ignore_stop_signals()  # they are for the odometry, with which this process ends
    use_one_opencv_thread()
    with Client(task.address) as client, Mapper(_WithImages(client), task.config, task.map, task.folder) as mapper:
        warm_up(client.rig, task.config)
        try:
            _follow(client, mapper, task, ready)
        except GraphvioError as error:
            raise MapError(f"{error}{_rescued(mapper, task.out)}") from None
        except Exception as error:
            error.add_note(_rescued(mapper, task.out))
            raise
        if task.out is not None:
            _save(mapper, task.out)
        return told(mapper)


class _WithImages:
    """The client as a front-end whose keyframes carry images: places are recognised by features of their own."""

    def __init__(self, client: Client) -> None:
        self.rig = client.rig
        self.correct = client.correct
        self._client = client

    def keyframes(self, from_id: int = 0) -> Iterator[Keyframe]:
        """See `graphvio.slam.interface.SlamFrontEnd`."""
        return self._client.keyframes(from_id, with_images=True, with_descriptors=False)


def told(mapper: Mapper) -> str:
    """The summary in one line."""
    figures = {name: value for name, value in mapper.summary().items() if value is not None}
    return "map: " + ", ".join(
        f"{name} {value:.1f}" if isinstance(value, float) else f"{name} {value}" for name, value in figures.items()
    )


def _save(mapper: Mapper, out: Path) -> None:
    mapper.save(out)
    save_trajectory(mapper.trajectory, out / "trajectory.txt")


def _rescued(mapper: Mapper, out: Path | None) -> str:
    """Save what there is after a failure; what became of it, to be put behind what is told of that."""
    if out is None or not mapper.summary()["places"]:
        return ""
    try:
        _save(mapper, out)
    except GraphvioError as error:
        return f" (and the map until then cannot be saved: {error})"
    return f" (the map until then is in {out})"


def _follow(client: Client, mapper: Mapper, task: MappingTask, ready: Event) -> None:
    if not (task.view or task.web_port is not None or task.save_rrd is not None):
        ready.set()
        mapper.run()
        return
    web = None if task.web_port is None else WebOptions(port=task.web_port)
    with Viewer(client.rig, spawn=task.view, save=task.save_rrd, web=web) as viewer:
        odom = _OdomPath(client, viewer)
        odom.thread.start()
        ready.set()

        def show(at: Mapper) -> None:
            if len(at.place_poses) % _SHOWN_EVERY == 0:
                viewer.show_path("map", at.trajectory, _MAP_COLOUR)

        mapper.run(show)
        viewer.show_path("map", mapper.trajectory, _MAP_COLOUR)
        odom.thread.join()
        viewer.show_path("odom", odom.path, _ODOM_COLOUR)


class _OdomPath:
    """Shows the estimates as they come, and keeps their path."""

    def __init__(self, client: Client, viewer: Viewer) -> None:
        self._client = client
        self._viewer = viewer
        self._stamps: list[int] = []
        self._poses: list[Float] = []
        self.thread = threading.Thread(target=self._listen, daemon=True)

    @property
    def path(self) -> Trajectory:
        """All of it."""
        return Trajectory(np.array(self._stamps, dtype=np.int64), np.array(self._poses).reshape(-1, 4, 4))

    def _listen(self) -> None:
        with suppress(ServiceError):  # the service has gone, which the mapping itself tells of
            for update in self._client.estimates():
                self._viewer.show(None, update.state)
                if update.state.nav_T_body is not None:
                    self._stamps.append(update.state.stamp_ns)
                    self._poses.append(update.state.nav_T_body)
