"""The side of the odometry that a SLAM system sees: keyframes out, corrections in."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from graphvio.arrays import Float, Image
from graphvio.config import Config
from graphvio.frontend.tracks import PairFrame
from graphvio.geometry import se3_inverse
from graphvio.measurements.estimate import Estimate, Status
from graphvio.rig import Rig
from graphvio.slam.descriptors import describer
from graphvio.slam.keyframe import CorrectionResult, Keyframe
from graphvio.slam.keyframe_log import KeyframeLog
from graphvio.slam.landmarks import landmarks_of
from graphvio.slam.map_frame import MapFrame


class Keyframes:
    """Makes keyframes for those who asked, and knows where the map is.

    Args:
        rig: cameras.
        config: of all stages.

    Attributes:
        log: the newest keyframes; empty as long as nobody asked.
        map_frame: where odom is in the map.
        previous_ns: stamp of the newest frameset that became a reference, or None.
    """

    def __init__(self, rig: Rig, config: Config) -> None:
        self.log = KeyframeLog()
        self.map_frame = MapFrame(config.keyframes.gate_probability)
        self.previous_ns: int | None = None
        self._rig = rig
        self._config = config
        self._describe = describer(config.keyframes.descriptors)
        self._callbacks: list[Callable[[Keyframe], None]] = []
        self._are_wanted = False
        self._previous: Keyframe | None = None

    def call(self, callback: Callable[[Keyframe], None]) -> None:
        """Make keyframes from now on, and hand each to a callback."""
        self._are_wanted = True
        self._callbacks.append(callback)

    def follow(self, from_id: int) -> Iterator[Keyframe]:
        """Make keyframes from now on; see `KeyframeLog.follow`."""
        self._are_wanted = True
        return self.log.follow(from_id)

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """See `MapFrame.correct`."""
        return self.map_frame.correct(keyframe_id, map_T_body, covariance)

    def add(
        self,
        estimate: Estimate,
        frames: Mapping[int, PairFrame],
        images: Mapping[int, tuple[Image, Image]],
        body_T_left: Float,
        motion: tuple[Float, Float] | None,
    ) -> None:
        """A frameset became a reference.

        Args:
            estimate: of it.
            frames: pair -> its tracks there.
            images: pair -> (left, right).
            body_T_left: (P, 4, 4) of all pairs.
            motion: ``previous_T_body`` since the reference before and its covariance, or None where it is not known.
        """
        if self._previous is None or self._previous.stamp_ns != self.previous_ns:
            motion = None  # it is from a reference that was no keyframe
        self.previous_ns = estimate.stamp_ns
        if not self._are_wanted or estimate.nav_T_body is None:
            return
        if estimate.status is Status.INITIALISING and self._rig.imu is not None:
            return  # attitude and velocity may jump yet; vision alone has nothing that could
        assert estimate.covariance is not None
        previous = self._previous
        if previous is not None and previous.epoch != estimate.epoch:
            previous = None
        if previous is None:
            motion = None
        elif motion is None:  # it began anew in between: no better known than the whole way until here
            motion = se3_inverse(previous.odom_T_body) @ estimate.nav_T_body, estimate.covariance
        settings = self._config.keyframes
        keyframe = Keyframe(
            id=self.log.next_id,
            epoch=estimate.epoch,
            stamp_ns=estimate.stamp_ns,
            status=estimate.status,
            odom_T_body=estimate.nav_T_body,
            covariance=estimate.covariance,
            previous_id=None if previous is None else previous.id,
            previous_T_body=None if motion is None else motion[0],
            relative_covariance=None if motion is None else motion[1],
            landmarks=landmarks_of(
                self._rig, body_T_left, frames, images, self._config.motion.pixel_sigma_px, self._describe
            ),
            images={j: (np.copy(left), np.copy(right)) for j, (left, right) in images.items()}
            if settings.images
            else {},
        )
        self._previous = keyframe
        self.map_frame.add(keyframe)
        self.log.add(keyframe)
        for callback in self._callbacks:
            callback(keyframe)
