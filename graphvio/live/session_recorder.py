"""Recording of a live run as a session, in a thread of its own, so that a slow disk never holds up the odometry."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from graphvio.live.outputs import Output
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.events import Event
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.queues import BoundedQueue, Limit, WhenFull
from graphvio.rig import Rig
from graphvio.sessions.topics import ImageFormat
from graphvio.sessions.writer import SessionWriter

_FRAMESETS = "framesets"  # a lane of the queue
_WAITING = 20_000  # samples, poses and events that may wait: those of a minute
_WAITING_FRAMESETS = 120  # framesets that may wait, as a disk may pause for seconds
_READ_AHEAD = 2  # framesets that may wait if the source waits for its reader

_Write = tuple[Callable[[Any], None], Any]  # a method of the writer, and its argument


class SessionRecorder(Output):
    """Writes all measurements, estimates and events of a live run to a session file.

    When the disk does not keep up, framesets are left out of the recording and counted; samples and poses are, too,
    when it has been stuck for more than a minute.

    Args:
        path: path of the session, a new file.
        rig: the rig of the framesets.
        image_format: ``raw``, or ``png`` to compress images.
        waits: whether to wait for the disk instead, for a source that itself waits for its reader.

    Attributes:
        failure: newest error of writing, or None.

    Raises:
        SessionError: if the file exists or cannot be created.
        MissingExtraError: if the extra ``sessions`` is not installed.
    """

    def __init__(self, path: Path, rig: Rig, image_format: ImageFormat = "raw", waits: bool = False) -> None:
        self._path = path
        self._writer = SessionWriter(path, rig, image_format)
        when_full = WhenFull.WAIT if waits else WhenFull.DROP_NEWEST
        framesets = Limit(_READ_AHEAD if waits else _WAITING_FRAMESETS, when_full)
        self._queue: BoundedQueue[_Write] = BoundedQueue(_WAITING, when_full, framesets=framesets)
        self._framesets = 0
        self._failed_framesets = 0
        self._failed_messages = 0
        self.failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="graphvio-record", daemon=True)
        self._thread.start()

    def add_measurement(self, measurement: Measurement) -> None:
        """See `Output`."""
        lane = _FRAMESETS if isinstance(measurement, FrameSet) else ""
        self._queue.put((self._writer.add, measurement), lane)

    def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
        """See `Output`."""
        self._queue.put((self._writer.add_estimate, estimate))

    def add_event(self, event: Event) -> None:
        """See `Output`."""
        self._queue.put((self._writer.add_event, event))

    def status(self) -> Mapping[str, float | int | str | None]:
        """See `Output`."""
        return {
            "recorded_framesets": self._framesets,
            "recorded_poses": self._writer.poses,
            "framesets_not_recorded": self._queue.dropped(_FRAMESETS) + self._failed_framesets,
            "messages_not_recorded": self._queue.dropped() + self._failed_messages,
            "recording_stopped": self._writer.stopped or (str(self.failure) if self.failure else ""),
            "disk_free_gb": self._free_gb(),
        }

    def close(self) -> None:
        """Write everything that waits, and finish the file."""
        self._queue.close()
        self._thread.join()

    def _free_gb(self) -> float | None:
        try:
            return shutil.disk_usage(self._path.parent).free / 1e9
        except OSError:  # the disk was taken away
            return None

    def _run(self) -> None:
        with self._writer:
            while (item := self._queue.get()) is not None:
                is_written = self._is_written(*item)
                if isinstance(item[1], FrameSet):
                    self._framesets += is_written
                    self._failed_framesets += not is_written
                else:
                    self._failed_messages += not is_written

    def _is_written(self, write: Callable[[Any], None], message: Any) -> bool:
        try:
            write(message)
        except Exception as error:  # a message that cannot be written is no reason to stop the others
            self.failure = error
            return False
        return self._writer.stopped is None
