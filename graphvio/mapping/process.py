"""The SLAM system in a process of its own, as a client of the odometry's gRPC service."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.errors import GraphvioError, MapError, ServiceError
from graphvio.mapping.mapper import Mapper
from graphvio.optimization.loops.colmap_library import colmap
from graphvio.runtime import ignore_stop_signals, set_up_threads
from graphvio.slam.client import Client
from graphvio.slam.keyframe import Keyframe
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import save_trajectory
from graphvio.viewer import Viewer, WebOptions
from graphvio.warmup import warm_up

_MAP_COLOUR, _ODOM_COLOUR = (40, 190, 90), (150, 150, 150)
_VIEWED_EVERY = 3  # places after which the map's path is shown again


@dataclass(frozen=True)
class MappingTask:
    """Options of the mapping process; those that are known only when the odometry runs have defaults."""

    map: Path | None = None  # folder of a saved map to begin with, or None
    out: Path | None = None  # folder for the new map, or None
    view: bool = False  # open rerun's window
    web_port: int | None = None  # port of the view in a browser, or None
    save_rrd: Path | None = None  # file for the viewer's data, or None
    address: str = ""  # address of the odometry's service
    config: Config = field(default_factory=Config)  # the odometry's configuration, with settings of places and closures
    # empty folder for temporary files, removed at the end; None for one in the system's folder
    folder: Path | None = None


def run_mapping(task: MappingTask, ready: Event) -> str:
    """Map until the odometry ends, and save the map; to be called in a process of its own, which then ignores signals.

    After a failure, the map until then is saved. ``ready`` is set when keyframes may come. Returns a one-line summary.

    Raises:
        GraphvioError: If the odometry cannot be reached, or the map cannot be used or written.
    """
    colmap()  # installs its own handler of SIGTERM when it is loaded
    ignore_stop_signals()  # they are for the odometry, with which this process ends
    set_up_threads()
    with Client(task.address) as client, Mapper(ClientWithImages(client), task.config, task.map, task.folder) as mapper:
        warm_up(client.rig, task.config)
        try:
            _follow(client, mapper, task, ready)
        except GraphvioError as error:
            raise MapError(f"{error}{_save_after_failure(mapper, task.out)}") from None
        except Exception as error:
            error.add_note(_save_after_failure(mapper, task.out))
            raise
        if task.out is not None:
            _save(mapper, task.out)
        return summary_line(mapper)


class ClientWithImages:
    """A front-end made of a client, whose keyframes have the images that the mapper needs."""

    def __init__(self, client: Client) -> None:
        self.rig = client.rig
        self.correct = client.correct
        self._client = client

    def keyframes(self, from_id: int = 0) -> Iterator[Keyframe]:
        """See `graphvio.slam.interface.SlamFrontEnd`."""
        return self._client.keyframes(from_id, with_images=True, with_descriptors=False)


def summary_line(mapper: Mapper) -> str:
    """Return the mapper's summary in one line."""
    figures = {name: value for name, value in mapper.summary().items() if value is not None}
    return "map: " + ", ".join(
        f"{name} {value:.1f}" if isinstance(value, float) else f"{name} {value}" for name, value in figures.items()
    )


def _save(mapper: Mapper, out: Path) -> None:
    mapper.save(out)
    save_trajectory(mapper.trajectory, out / "trajectory.txt")


def _save_after_failure(mapper: Mapper, out: Path | None) -> str:
    """Save the map after a failure; return the outcome, to be appended to the error's message."""
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
            if len(at.place_poses) % _VIEWED_EVERY == 0:
                viewer.show_path("map", at.trajectory, _MAP_COLOUR)

        mapper.run(show)
        viewer.show_path("map", mapper.trajectory, _MAP_COLOUR)
        odom.thread.join()
        viewer.show_path("odom", odom.path, _ODOM_COLOUR)


class _OdomPath:
    """Shows the odometry's estimates in the viewer as they come, and records their path."""

    def __init__(self, client: Client, viewer: Viewer) -> None:
        self._client = client
        self._viewer = viewer
        self._stamps: list[int] = []
        self._poses: list[Float] = []
        self.thread = threading.Thread(target=self._listen, daemon=True)

    @property
    def path(self) -> Trajectory:
        """The path until now."""
        return Trajectory(np.array(self._stamps, dtype=np.int64), np.array(self._poses).reshape(-1, 4, 4))

    def _listen(self) -> None:
        with suppress(ServiceError):  # the service has ended, which the mapper reports
            for update in self._client.estimates():
                self._viewer.show(None, update.state)
                if update.state.nav_T_body is not None:
                    self._stamps.append(update.state.stamp_ns)
                    self._poses.append(update.state.nav_T_body)
