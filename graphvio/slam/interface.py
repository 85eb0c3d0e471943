"""What a SLAM system may use of the odometry, be it in the same process or at the other end of a wire."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Protocol

from graphvio.arrays import Float
from graphvio.measurements.estimate import Estimate, Prediction
from graphvio.measurements.events import Event
from graphvio.queues import Broadcast
from graphvio.rig import Rig
from graphvio.slam.keyframe import CorrectionResult, Keyframe
from graphvio.slam.keyframe_log import KeyframeLog


class SlamFrontEnd(Protocol):
    """Keyframes out, corrections in; `graphvio.Odometry` and `graphvio.slam.client.Client` are such."""

    @property
    def rig(self) -> Rig:
        """Cameras and IMU of the keyframes."""

    def keyframes(self, from_id: int = 0) -> Iterator[Keyframe]:
        """Keyframes as they come, each waited for, until the odometry has ended.

        Args:
            from_id: where to begin, or to go on after a break. Ids that are passed over were no longer kept.
        """

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """Say where a keyframe is in the map.

        Args:
            keyframe_id: of it.
            map_T_body: (4, 4) of body there.
            covariance: (6, 6), tangent ``[rotation, translation]`` in body.
        """


class Served(Protocol):
    """What the services hand on: a running odometry, whose threads never wait for those who listen.

    Attributes:
        rig: cameras and IMU.
        estimates: of the framesets, as they are made.
        predictions: at each sample of the IMU.
        events: as they happen.
        keyframe_log: the newest keyframes; closed when the odometry has ended.
    """

    rig: Rig
    estimates: Broadcast[Estimate]
    predictions: Broadcast[Prediction]
    events: Broadcast[Event]
    keyframe_log: KeyframeLog

    @property
    def map_T_odom(self) -> Float | None:
        """(4, 4) in force, or None before the epoch's first correction."""

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """See `SlamFrontEnd.correct`; from any thread."""

    def status(self) -> Mapping[str, float | int | str | None]:
        """How it runs, by name: figures that the terminal and the metrics show, too; from any thread."""


def newest_epoch(served: Served) -> int | None:
    """The newest keyframe's, or None before the first."""
    log = served.keyframe_log
    newest = log.read(max(log.next_id - 1, 0), timeout_s=0.0)
    return None if newest is None else newest.epoch


def map_of_epoch(served: Served, epoch: int) -> Float | None:
    """``map_T_odom`` (4, 4) in force, unless it is another epoch's than that of an estimate that waited."""
    before = newest_epoch(served)
    map_T_odom = served.map_T_odom
    return map_T_odom if before == epoch == newest_epoch(served) else None
