"""A listener that measures errors and times of a live run on a simulated scene, which is walked to and fro."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3_inverse
from graphvio.live.running import LiveOdometry
from graphvio.sources import open_source
from graphvio.trajectory_files import load_trajectory

_STAGES = ("predict", "track", "motion", "quality", "replenish", "update")


class Listener:
    """Receives the estimates in its own thread until the run has ended.

    Args:
        running: the live odometry, before its start.
        folder: folder of the recording; its first frameset corresponds to the first estimate.

    Attributes:
        work_ms: processing time of each frameset, milliseconds.
        error_mm: error of the newest position relative to the first pose, millimetres.
        epochs: number of epochs so far.
        thread: the thread that receives the estimates.
    """

    def __init__(self, running: LiveOdometry, folder: Path) -> None:
        source = open_source(folder)
        assert source.truth is not None
        self.work_ms: list[float] = []
        self.error_mm = 0.0
        self.epochs = 0
        self._first_ns: int | None = None
        self._start_ns, self._end_ns = source.start_ns, source.end_ns
        self._truth = load_trajectory(source.truth)
        self._nav_T_world: Float | None = None
        self._estimates = running.estimates.subscribe(256)
        self.thread = threading.Thread(target=self._listen, daemon=True)
        self.thread.start()

    def _listen(self) -> None:
        while (estimate := self._estimates.get()) is not None:
            self._first_ns = estimate.stamp_ns if self._first_ns is None else self._first_ns
            self.epochs = estimate.epoch + 1
            if estimate.nav_T_body is None:
                continue
            self.work_ms.append(sum(estimate.stage_ms.get(stage, 0.0) for stage in _STAGES))
            world_T_body = self._true_pose(estimate.stamp_ns)
            if self._nav_T_world is None:
                self._nav_T_world = estimate.nav_T_body @ se3_inverse(world_T_body)
            apart = estimate.nav_T_body[:3, 3] - (self._nav_T_world @ world_T_body)[:3, 3]
            self.error_mm = 1e3 * float(np.linalg.norm(apart))

    def _true_pose(self, stamp_ns: int) -> Float:
        """Return the true pose that is nearest to a stamp, (4, 4), in the walk to and fro."""
        length_ns = self._end_ns - self._start_ns
        assert self._first_ns is not None
        along_ns = (stamp_ns - self._first_ns) % (2 * length_ns)  # of an arbitrary clock
        wanted_ns = self._start_ns + min(along_ns, 2 * length_ns - along_ns)
        at = int(np.argmin(np.abs(self._truth.stamps_ns - wanted_ns)))
        return np.ascontiguousarray(self._truth.nav_T_body[at])
