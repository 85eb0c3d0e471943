"""Writer of sessions: measurements, estimates and events as messages."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2

from graphvio.arrays import Float, Image
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.events import Event
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.rig import Rig
from graphvio.rig_files.native import to_text
from graphvio.sessions import messages
from graphvio.sessions.mcap_storage import McapStorage
from graphvio.sessions.storage import RecordingWriter
from graphvio.sessions.topics import (
    IMU_TOPIC,
    LOG_TOPIC,
    ODOMETRY_TOPIC,
    RIG_ATTACHMENT,
    RIG_TOPIC,
    TRANSFORMS_TOPIC,
    TRUTH_TOPIC,
    ImageFormat,
    image_topic,
    mask_topic,
    sides_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from graphvio.sessions.storage import Storage


class SessionWriter(RecordingWriter):
    """Writes measurements, estimates, the true trajectory and events.

    Args:
        path: path of the file or folder, which must not exist.
        rig: the rig of the framesets, which is written into the file without stamp offsets: framesets are corrected.
        image_format: raw, or PNG, which is smaller and slower.
        storage: creates the file or folder: MCAP, which loses at most the last second in a crash, or a bag.

    Attributes:
        poses: number of estimates that were recorded.

    Raises:
        SessionError: if the file exists or cannot be created, or from any method if messages cannot hold a stamp.
        MissingExtraError: if the extra ``sessions`` is not installed.
    """

    _work = "recording"

    def __init__(
        self,
        path: Path,
        rig: Rig,
        image_format: ImageFormat = "raw",
        storage: Callable[[Path], Storage] = McapStorage,
    ) -> None:
        super().__init__(path, rig)
        self.poses = 0
        self._rig_text = to_text(self.rig, path.parent)
        self._format: ImageFormat = image_format
        self._has_begun = False
        self._first_ns: int | None = None
        self._last_ns = 0
        self._is_closed = False
        self._storage = storage(path)
        if not self._storage.is_readable_when_cut:
            self._remainder = "what was written until then cannot be read: remove it, make room and begin again"
        if self._storage.has_attachments:
            self._guarded(lambda: self._storage.attach(RIG_ATTACHMENT, self._rig_text))

    def add(self, measurement: Measurement) -> None:
        """Record an IMU sample or a frameset."""
        self._first_ns = measurement.stamp_ns if self._first_ns is None else self._first_ns
        self._last_ns = max(self._last_ns, measurement.stamp_ns)
        if isinstance(measurement, FrameSet):
            self._guarded(lambda: self._add_frameset(measurement))
        else:
            self._guarded(lambda: self._add(IMU_TOPIC, measurement.stamp_ns, messages.imu(measurement)))

    def add_estimate(self, estimate: Estimate) -> None:
        """Record an estimate if it has a pose."""
        if estimate.nav_T_body is not None and self.stopped is None:
            self._guarded(lambda: self._add(ODOMETRY_TOPIC, estimate.stamp_ns, messages.odometry(estimate)))
            self.poses += 1

    def add_true_pose(self, stamp_ns: int, world_T_body: Float) -> None:
        """Record a pose ``world_T_body`` (4, 4) of the true trajectory."""
        message = messages.pose_stamped(stamp_ns, messages.WORLD, world_T_body)
        self._guarded(lambda: self._add(TRUTH_TOPIC, stamp_ns, message))

    def add_event(self, event: Event) -> None:
        """Record an event; if its stamp is outside of the recording's time, with the nearer end of that as stamp."""
        if self._first_ns is not None:
            stamp_ns = min(max(event.stamp_ns, self._first_ns), self._last_ns)
            event = Event(stamp_ns, event.kind, event.detail)
        self._guarded(lambda: self._add(LOG_TOPIC, event.stamp_ns, messages.log(event)))

    def close(self) -> None:
        """Finish the file; a second time does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        self._guarded(self._storage.finish)
        try:
            self._storage.close()
        except OSError as error:
            self._stop(error)

    def _add_frameset(self, frameset: FrameSet) -> None:
        if not self._has_begun:
            self._has_begun = True
            self._add_calibration(frameset.stamp_ns)
        for number, images in sorted(frameset.images.items()):
            group = self.rig.groups[number]
            for side, camera, pixels in zip(sides_of(group), group.cameras, images, strict=True):
                topic = image_topic(group.name, side, self._format)
                self._add(topic, frameset.stamp_ns, self._image(frameset.stamp_ns, camera.name, pixels))
            for side, camera, mask in zip(sides_of(group), group.cameras, frameset.masks.get(number, ()), strict=False):
                if mask is not None:
                    topic = mask_topic(group.name, side, self._format)
                    self._add(topic, frameset.stamp_ns, self._image(frameset.stamp_ns, camera.name, mask))

    def _add_calibration(self, stamp_ns: int) -> None:
        if not self._storage.has_attachments:
            self._add(RIG_TOPIC, stamp_ns, messages.text(self._rig_text), is_latched=True)
        self._add(TRANSFORMS_TOPIC, stamp_ns, messages.static_transforms(stamp_ns, self.rig), is_latched=True)
        for group in self.rig.groups:
            for side, camera in zip(sides_of(group), group.cameras, strict=True):
                topic = f"/{group.name}/{side}/camera_info"
                self._add(topic, stamp_ns, messages.camera_info(stamp_ns, camera), is_latched=True)

    def _image(self, stamp_ns: int, frame: str, pixels: Image) -> Any:
        if self._format == "raw":
            return messages.image(stamp_ns, frame, pixels)
        _, png = cv2.imencode(".png", pixels)
        return messages.compressed_image(stamp_ns, frame, png.tobytes())

    def _add(self, topic: str, stamp_ns: int, message: Any, is_latched: bool = False) -> None:
        self._storage.write(topic, stamp_ns, message, is_latched)
