"""Records a session: one MCAP file, of which a crash loses the last second at most."""

from __future__ import annotations

import logging
import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, Self

from graphvio import __version__
from graphvio.arrays import Image
from graphvio.errors import MissingExtraError, SessionError
from graphvio.events import Estimate, Event, FrameSet, Incident
from graphvio.rig import Rig
from graphvio.rig_files.native import to_text
from graphvio.sessions import cdr, messages

if TYPE_CHECKING:
    from types import TracebackType

ImageFormat = Literal["raw", "png"]
RIG_ATTACHMENT = "rig.yaml"
LIBRARY = "graphvio"
IMU_TOPIC, TRANSFORMS_TOPIC, ODOMETRY_TOPIC, LOG_TOPIC = "/imu", "/tf_static", "/odometry", "/rosout"

_CHUNK_BYTES = 4 * 1024 * 1024
_FLUSH_S = 0.5  # two flushes a second, so that a second is lost at most
_ENCODING, _SCHEMA_ENCODING, _PROFILE = "cdr", "ros2msg", "ros2"
_log = logging.getLogger(__name__)


def image_topic(pair: str, side: str, image_format: ImageFormat) -> str:
    """Topic of a camera's images."""
    return f"/{pair}/{side}/image_raw" + ("/compressed" if image_format == "png" else "")


class SessionWriter:
    """Writes sensors' events, and what the odometry made of them.

    When the disk is full or the file cannot be written any more, recording stops, which is logged and told by
    `stopped`; the caller goes on.

    Args:
        path: of the file, which must not exist.
        rig: of the framesets; written into the file, so that it needs no other.
        image_format: images as they are, or as PNG, which is smaller and slower.

    Attributes:
        stopped: why nothing is recorded any more, or None.
        poses: that were recorded.

    Raises:
        SessionError: if the file exists or cannot be made.
        MissingExtraError: if the extra ``sessions`` is not installed.
    """

    def __init__(self, path: Path, rig: Rig, image_format: ImageFormat = "raw") -> None:
        self.path = path
        self.stopped: str | None = None
        self.poses = 0
        self._rig = rig
        self._format: ImageFormat = image_format
        self._channels: dict[str, tuple[int, int]] = {}  # topic -> channel, messages so far
        self._schemas: dict[str, int] = {}
        try:
            self._file: BinaryIO = path.open("xb")
        except FileExistsError:
            raise SessionError(f"{path}: exists, and sessions are never overwritten; name another file") from None
        except OSError as error:
            raise SessionError(f"{path}: cannot be written ({error.strerror}); choose another place") from None
        self._mcap = _mcap_writer(self._file)
        self._last_flush_s = time.monotonic()
        self._has_begun = False
        self._closing = threading.Event()
        self._syncing = threading.Thread(target=self._sync, name="graphvio-session", daemon=True)
        self._guarded(self._begin)
        self._syncing.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()

    def add(self, event: Event) -> None:
        """Record an IMU sample or a frameset."""
        if isinstance(event, FrameSet):
            self._guarded(lambda: self._add_frameset(event))
        else:
            self._guarded(lambda: self._add(IMU_TOPIC, event.stamp_ns, messages.imu(event)))

    def add_estimate(self, estimate: Estimate) -> None:
        """Record an estimate, if it has a pose."""
        if estimate.nav_T_body is not None and self.stopped is None:
            self._guarded(lambda: self._add(ODOMETRY_TOPIC, estimate.stamp_ns, messages.odometry(estimate)))
            self.poses += 1

    def add_incident(self, incident: Incident) -> None:
        """Record an incident."""
        self._guarded(lambda: self._add(LOG_TOPIC, incident.stamp_ns, messages.log(incident)))

    def close(self) -> None:
        """Finish the file; a second time does nothing."""
        if self._closing.is_set():
            return
        self._guarded(self._mcap.finish)
        self._closing.set()
        self._syncing.join()
        try:
            self._file.close()
        except OSError as error:
            self._stop(error)

    def _begin(self) -> None:
        self._mcap.start(_PROFILE, f"{LIBRARY} {__version__}")
        self._mcap.add_attachment(
            0, 0, RIG_ATTACHMENT, "application/yaml", to_text(self._rig, self.path.parent).encode()
        )
        self._file.flush()

    def _add_frameset(self, frameset: FrameSet) -> None:
        if not self._has_begun:
            self._has_begun = True
            stamp = frameset.stamp_ns
            self._add(TRANSFORMS_TOPIC, stamp, messages.static_transforms(stamp, self._rig))
            for pair in self._rig.pairs:
                for side, camera in (("left", pair.left), ("right", pair.right)):
                    self._add(f"/{pair.name}/{side}/camera_info", stamp, messages.camera_info(stamp, camera))
        for number, images in sorted(frameset.images.items()):
            pair = self._rig.pairs[number]
            for side, camera, pixels in zip(("left", "right"), (pair.left, pair.right), images, strict=True):
                topic = image_topic(pair.name, side, self._format)
                self._add(topic, frameset.stamp_ns, self._image(frameset.stamp_ns, camera.name, pixels))

    def _image(self, stamp_ns: int, frame: str, pixels: Image) -> Any:
        if self._format == "raw":
            return messages.image(stamp_ns, frame, pixels)
        import cv2

        _, png = cv2.imencode(".png", pixels)
        return messages.compressed_image(stamp_ns, frame, png.tobytes())

    def _add(self, topic: str, stamp_ns: int, message: Any) -> None:
        if topic not in self._channels:
            name = message.__msgtype__
            if name not in self._schemas:
                self._schemas[name] = self._mcap.register_schema(name, _SCHEMA_ENCODING, cdr.definition(name))
            self._channels[topic] = self._mcap.register_channel(topic, _ENCODING, self._schemas[name]), 0
        channel, count = self._channels[topic]
        self._channels[topic] = channel, count + 1
        self._mcap.add_message(channel, stamp_ns, cdr.encode(message), stamp_ns, count)
        now_s = time.monotonic()
        if now_s - self._last_flush_s >= _FLUSH_S:
            self._last_flush_s = now_s
            self._mcap._Writer__finalize_chunk()  # the library ends chunks by size only
            self._file.flush()

    def _guarded(self, action: Any) -> None:
        if self.stopped is None:
            try:
                action()
            except OSError as error:
                self._stop(error)

    def _stop(self, error: OSError) -> None:
        self.stopped = f"{self.path}: recording stopped ({error.strerror}); what was written until then can be read"
        _log.error("%s", self.stopped)

    def _sync(self) -> None:
        """Has what was flushed on the disk, for when the power fails."""
        while not self._closing.wait(_FLUSH_S):
            try:
                os.fsync(self._file.fileno())
            except (OSError, ValueError):
                return


def _mcap_writer(file: BinaryIO) -> Any:
    try:
        from mcap.writer import CompressionType, Writer
    except ImportError:
        raise MissingExtraError("mcap", "sessions", "reading or writing a session") from None
    return Writer(file, chunk_size=_CHUNK_BYTES, compression=CompressionType.LZ4)
