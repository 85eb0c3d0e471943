"""The odometry as the front-end of a SLAM system in the same process: it gives keyframes and takes corrections."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3_inverse
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.events import EventKind
from graphvio.odometry import Odometry
from graphvio.odometry.step import NewKeyframe, Step
from graphvio.rig import Rig
from graphvio.slam.keyframe import CorrectionResult, Keyframe
from graphvio.slam.keyframe_log import KeyframeLog
from graphvio.slam.landmarks import describer, landmarks_of
from graphvio.slam.map_frame import MapFrame


class FrontEnd:
    """Makes keyframes of a running odometry, and keeps the map frame that a SLAM system corrects.

    It subscribes to the odometry's steps, and never changes its results. It implements
    `graphvio.slam.interface.SlamFrontEnd`, as does `graphvio.slam.client.Client` for an odometry in another process.

    Args:
        odometry: The odometry, which is fed as usual; its configuration has the keyframes' settings.

    Attributes:
        log: The newest keyframes; empty until keyframes are requested.
    """

    def __init__(self, odometry: Odometry) -> None:
        self.log = KeyframeLog()
        self._odometry = odometry
        self._map_frame = MapFrame(odometry.config.keyframes.gate_probability)
        self._describe = describer(odometry.config.keyframes.descriptors)
        self._callbacks: list[Callable[[Keyframe], None]] = []
        self._is_wanted = False
        self._previous: Keyframe | None = None
        self._newest_ns = 0
        odometry.subscribe(self._on_step, self.log.close)

    @property
    def rig(self) -> Rig:
        """Cameras and IMU of the keyframes, as in the rig file; see `Keyframe.calibrated_rig`."""
        return self._odometry.rig

    # ------------------------------------------------------------------ keyframes out

    def on_keyframe(self, callback: Callable[[Keyframe], None]) -> None:
        """Pass each keyframe from now on to a callback.

        Args:
            callback: Function that is called within `Odometry.process`, and should return soon.
        """
        self._is_wanted = True
        self._callbacks.append(callback)

    def keyframes(self, from_id: int = 0) -> Iterator[Keyframe]:
        """Yield keyframes until the odometry is finished, see `SlamFrontEnd.keyframes`; call it in another thread.

        Args:
            from_id: Id of the first keyframe.
        """
        self._is_wanted = True
        return self.log.follow(from_id)

    def _on_step(self, step: Step) -> None:
        self._newest_ns = step.estimate.stamp_ns
        self._map_frame.begin(step.estimate.epoch)
        if step.keyframe is not None:
            self._add(step.estimate, step.keyframe)

    # ------------------------------------------------------------------ corrections in

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """Correct the pose of a keyframe in the map, which changes `map_T_odom` and nothing else; thread-safe.

        Args:
            keyframe_id: Id of a keyframe of this epoch, however old: the correction is carried forward.
            map_T_body: (4, 4) pose of body in the map.
            covariance: (6, 6) covariance of that pose, tangent ``[rotation, translation]`` in body.

        Returns:
            Whether it was accepted. A correction far from the expected one fails the innovation test and is reported,
            until several in a row agree with each other.

        Raises:
            MeasurementError: If the pose is not rigid, or the covariance is not positive definite.
        """
        result = self._map_frame.correct(keyframe_id, map_T_body, covariance)
        if result.reason:
            kind = EventKind.MAP_MOVED if result.accepted else EventKind.CORRECTION_REFUSED
            self._odometry.report(self._newest_ns, kind, result.reason)
        return result

    @property
    def map_T_odom(self) -> Float | None:
        """Pose (4, 4) in the map of the newest epoch's odom frame, which is nav (REP-105); None before a correction."""
        return self._map_frame.map_T_odom

    def map_T_body(self, stamp_ns: int) -> Float | None:
        """Predict the pose in the map at a stamp.

        Args:
            stamp_ns: Stamp in nanoseconds of the camera clock.

        Returns:
            ``map_T_body`` (4, 4), or None where `Odometry.predict` returns None or ``map_T_odom`` is not known.
        """
        prediction = self._odometry.predict(stamp_ns)
        map_T_odom = None if prediction is None else self._map_frame.of_epoch(prediction.epoch)
        return None if prediction is None or map_T_odom is None else map_T_odom @ prediction.nav_T_body

    # ------------------------------------------------------------------ making keyframes

    def _add(self, estimate: Estimate, new: NewKeyframe) -> None:
        is_initialising = estimate.status is Status.INITIALISING and self.rig.imu is not None
        if not self._is_wanted or estimate.nav_T_body is None or is_initialising:
            return  # while initialising with an IMU, attitude and velocity may jump
        assert estimate.covariance is not None
        previous = self._previous
        if previous is not None and previous.epoch != estimate.epoch:
            previous = None
        motion = None if previous is None else self._motion_since(previous, estimate, new)
        config = self._odometry.config
        calibration = self._odometry.calibration
        rig = self.rig if calibration is None else calibration.rig
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
            landmarks=landmarks_of(rig, new, config.motion.pixel_sigma_px, self._describe),
            images={j: tuple(np.copy(image) for image in images) for j, images in new.images.items()}
            if config.keyframes.images
            else {},
            calibrated_rig=None if rig is self.rig else rig,
        )
        self._previous = keyframe
        self._map_frame.add(keyframe)
        self.log.add(keyframe)
        for callback in self._callbacks:
            callback(keyframe)

    def _motion_since(self, previous: Keyframe, estimate: Estimate, new: NewKeyframe) -> tuple[Float, Float]:
        """Return the motion (4, 4) since the previous keyframe and its covariance (6, 6)."""
        assert estimate.nav_T_body is not None
        assert estimate.covariance is not None
        is_successive = previous.stamp_ns == new.previous_ns
        if is_successive and new.previous_T_body is not None and new.covariance is not None:
            return new.previous_T_body, new.covariance
        # The state was reinitialised in between: the motion is as uncertain as the whole path until here.
        return se3_inverse(previous.odom_T_body) @ estimate.nav_T_body, estimate.covariance
