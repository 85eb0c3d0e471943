"""Replay of recordings as a live source: in real time, at a multiple of it, or as fast as readings are taken."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from graphvio.errors import SourceError
from graphvio.live.source import DeviceInfo
from graphvio.live.sources import SourceSpec, check_options
from graphvio.live.sources.spec_options import number_of
from graphvio.measurements.readings import CameraFrame, DeviceHealth, ImuReading, Notice, Reading, host_ns
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement
from graphvio.rig import Rig
from graphvio.sources import Source
from graphvio.sources import open_source as open_recording

_OPTIONS = ("speed", "from_s", "to_s")
_MAX_DELAY_NS = 1_000_000_000


def list_devices() -> Sequence[DeviceInfo]:
    """See `SourceKind.list_devices`: returns always one entry, which stands for any recording."""
    return [
        DeviceInfo("replay:RECORDING", "a recording in real time; ?speed=2 is twice as fast, ?speed=max waits for none")
    ]


def open_source(spec: SourceSpec, rig: Rig | None) -> Replay:
    """Open a recording by its path; see `SourceKind.open_source`."""
    check_options(spec, _OPTIONS)
    if not spec.what:
        raise SourceError("replay: names no recording; write replay:FOLDER or replay:FILE")
    speed = speed_of(spec)
    from_s, to_s = (number_of(spec, key, 0.0, 1e7) for key in ("from_s", "to_s"))
    return Replay(open_recording(Path(spec.what), rig, from_s=from_s, to_s=to_s), speed)


class Replay:
    """A recording as a `LiveSource`.

    Args:
        recording: the recording, which is read once.
        speed: factor of the recording's time, or None for as fast as readings are taken.
    """

    def __init__(self, recording: Source, speed: float | None) -> None:
        self.name = recording.name
        self.is_realtime = speed is not None
        self._recording = recording
        self._pace = Pace(speed)

    def open(self) -> Rig:
        """Return the rig of the recording without stamp offsets, as the images' stamps are corrected already."""
        return self._recording.rig.without_stamp_offsets()

    def readings(self) -> Iterator[Reading]:
        """Yield samples and images when they are due, and at the end the recording's faults."""
        yield from paced(self._recording, self._recording.rig, self._pace)
        for event in self._recording.faults.events:
            yield Notice(event.kind, event.detail, host_ns())

    def health(self) -> Sequence[DeviceHealth]:
        """Return the recording's faults so far."""
        return [DeviceHealth(self.name, True, "recording", dict(self._recording.faults.counts))]

    def close(self) -> None:
        """Stop reading."""
        self._pace.stop()


class Pace:
    """Waits until measurements are due, at a factor of the recording's speed; with None it does not wait."""

    def __init__(self, speed: float | None) -> None:
        self._speed = speed
        self._stop = threading.Event()
        self._first: tuple[int, int] | None = None  # stamp, and when it was due

    def wait_for(self, stamp_ns: int) -> bool:
        """Wait until a stamp is due; returns False after `stop`."""
        if self._speed is not None and not self._stop.is_set():
            if self._first is None:
                self._first = stamp_ns, host_ns()
            due_ns = self._first[1] + round((stamp_ns - self._first[0]) / self._speed)
            left_ns = due_ns - host_ns()
            if left_ns < -_MAX_DELAY_NS:  # after a suspension or a slow reader: real sensors do not catch up either
                self._first = stamp_ns, host_ns()
            elif left_ns > 0:
                self._stop.wait(left_ns * 1e-9)
        return not self._stop.is_set()

    def stop(self) -> None:
        """End the current wait and all later ones; may be called from any thread."""
        self._stop.set()


def speed_of(spec: SourceSpec) -> float | None:
    """Return the option ``speed``: a factor such as ``2``, 1 where it is not given, or None for ``max``."""
    if spec.options.get("speed") == "max":
        return None
    return number_of(spec, "speed", 0.01, 100.0, word="max") or 1.0


def paced(measurements: Iterable[Measurement], rig: Rig, pace: Pace) -> Iterator[Reading]:
    """Yield measurements as readings of one clock when they are due, those before the first frameset at once.

    Args:
        measurements: the measurements of a recording.
        rig: the rig, for the names of the cameras.
        pace: waits for the stamps, and ends the readings when it is stopped.
    """
    has_frameset = False
    for measurement in measurements:
        has_frameset = has_frameset or isinstance(measurement, FrameSet)
        if has_frameset and not pace.wait_for(measurement.stamp_ns):
            return
        stamp_ns, now_ns = measurement.stamp_ns, host_ns()
        if isinstance(measurement, ImuSample):
            yield ImuReading(stamp_ns, measurement.angular_velocity, measurement.linear_acceleration, now_ns)
            continue
        for j, images in sorted(measurement.images.items()):
            for camera, image in zip(rig.groups[j].cameras, images, strict=True):
                yield CameraFrame(camera.name, stamp_ns, partial(np.asarray, image), now_ns)
