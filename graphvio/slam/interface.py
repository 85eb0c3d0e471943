"""Interfaces between the odometry, SLAM systems and the services that publish it."""

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
    """Interface of the odometry to a SLAM system: it gives keyframes and takes corrections.

    `graphvio.slam.FrontEnd` implements it for an odometry in the same process, `graphvio.slam.client.Client` for one in
    another process.
    """

    @property
    def rig(self) -> Rig:
        """Cameras and IMU of the keyframes, as in the rig file; see `Keyframe.calibrated_rig`."""

    def keyframes(self, from_id: int = 0) -> Iterator[Keyframe]:
        """Yield keyframes as they come until the odometry has ended.

        Args:
            from_id: Id of the first keyframe. Ids that are skipped were no longer kept.
        """

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """Correct the pose of a keyframe in the map.

        Args:
            keyframe_id: Id of a keyframe of the newest epoch.
            map_T_body: (4, 4) pose of body in the map.
            covariance: (6, 6) covariance of that pose, tangent ``[rotation, translation]`` in body.

        Returns:
            Whether the correction was accepted.
        """


class Served(Protocol):
    """Interface of a running odometry to the services; its threads never wait for subscribers.

    Attributes:
        rig: Cameras and IMU.
        estimates: Broadcast of the estimates of the framesets.
        predictions: Broadcast of the predictions at each sample of the IMU.
        events: Broadcast of the events of the run.
        keyframe_log: The newest keyframes; closed when the odometry has ended.
    """

    rig: Rig
    estimates: Broadcast[Estimate]
    predictions: Broadcast[Prediction]
    events: Broadcast[Event]
    keyframe_log: KeyframeLog

    @property
    def map_T_odom(self) -> Float | None:
        """Correction in force (4, 4), or None before the first correction of the epoch."""

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """See `SlamFrontEnd.correct`; thread-safe."""

    def status(self) -> Mapping[str, float | int | str | None]:
        """Return the figures of the run by name; thread-safe."""


def newest_epoch(served: Served) -> int | None:
    """Return the epoch of the newest keyframe, or None before the first.

    Args:
        served: The odometry.
    """
    log = served.keyframe_log
    newest = log.read(max(log.next_id - 1, 0), timeout_s=0.0)
    return None if newest is None else newest.epoch


def map_of_epoch(served: Served, epoch: int) -> Float | None:
    """Return the ``map_T_odom`` (4, 4) in force; None if there is none, or the odometry is in another epoch by now.

    Args:
        served: The odometry.
        epoch: The epoch of whose odom frame the transform is wanted.
    """
    before = newest_epoch(served)
    map_T_odom = served.map_T_odom
    return map_T_odom if before == epoch == newest_epoch(served) else None
