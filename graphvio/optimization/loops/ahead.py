"""Extraction of places' features while the odometry still runs, which leaves some cores idle."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Self

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.errors import GraphvioError
from graphvio.measurements.estimate import Status
from graphvio.odometry.step import Step
from graphvio.optimization.loops.database import FeatureDatabase
from graphvio.optimization.loops.features import PlaceObserver, is_stored, store_place
from graphvio.optimization.loops.places import PlaceChooser
from graphvio.rig import Rig
from graphvio.sources import Source


class FeaturesAhead:
    """Extracts the features of places in a thread and a process as soon as their poses are final; a context manager.

    `add` and `add_smoothed` take the output of the odometry. Places are chosen as `choose_places` does afterwards, up
    to the first frameset whose final pose is missing; at the end the place being processed is finished, and the others
    are left to `extract_places`.

    Args:
        source: the recording with the images.
        rig: the rig of their cameras.
        session: name of the session in the database.
        database: path of the database: a new file, or that of an interrupted run of the same session.
        config: configuration of all stages.
    """

    def __init__(self, source: Source, rig: Rig, session: str, database: Path, config: Config) -> None:
        settings = config.optimization
        self._source = source
        self._rig = rig
        self._session = session
        self._database = database
        self._config = config
        self._chooser = PlaceChooser(settings.place_distance_m, settings.place_angle_deg)
        self._epochs: dict[int, int] = {}  # stamp -> epoch, of framesets whose final pose is awaited, in order
        self._references: set[int] = set()
        self._final: dict[int, Float] = {}
        self._chosen: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        self._is_stopped = False
        self._thread = threading.Thread(target=self._work, name="graphvio-features-ahead")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._thread.join()

    def stop(self) -> None:
        """Extract no more features once the place being processed is finished."""
        self._is_stopped = True
        self._chosen.put(None)

    def add(self, step: Step) -> None:
        """Add a step of the odometry."""
        estimate = step.estimate
        self._references |= step.references
        if estimate.nav_T_body is not None and estimate.status is not Status.LOST:
            self._epochs[estimate.stamp_ns] = estimate.epoch

    def add_smoothed(self, poses: Iterable[tuple[int, Float]]) -> None:
        """Add stamps and poses ``nav_T_body`` (4, 4) that have left the smoother's window."""
        self._final.update(poses)
        while self._epochs and (stamp_ns := next(iter(self._epochs))) in self._final:
            epoch, pose = self._epochs.pop(stamp_ns), self._final.pop(stamp_ns)
            if stamp_ns in self._references and self._chooser.takes(epoch, pose):
                self._chosen.put(stamp_ns)

    def _work(self) -> None:
        try:
            with (
                FeatureDatabase(self._database) as database,
                PlaceObserver(self._rig, self._config, in_processes=True) as observer,
            ):
                while (stamp_ns := self._chosen.get()) is not None and not self._is_stopped:
                    if not is_stored(database, self._rig, self._session, stamp_ns):
                        seen = observer.look(self._source.frameset_at(stamp_ns))
                        store_place(database, self._rig, self._session, stamp_ns, seen)
        except GraphvioError:
            pass  # `extract_places` runs into the same error, and reports it
