"""A recording as a live source: in real time, at a multiple, or as fast as it is taken."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from graphvio.arrays import Image
from graphvio.errors import SourceError
from graphvio.live.source import DeviceInfo
from graphvio.live.sources import SourceSpec, check_options
from graphvio.live.sources.pacing import Pace, speed_of
from graphvio.live.spec_options import number_of
from graphvio.measurements.readings import CameraFrame, DeviceHealth, ImuReading, Notice, Reading, host_ns
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement
from graphvio.rig import Rig
from graphvio.sources import Source
from graphvio.sources import open_source as open_recording

_OPTIONS = ("speed", "from_s", "to_s")


def list_devices() -> Sequence[DeviceInfo]:
    """There is always one: any recording."""
    return [
        DeviceInfo("replay:RECORDING", "a recording in real time; ?speed=2 is twice as fast, ?speed=max waits for none")
    ]


def open_source(spec: SourceSpec, rig: Rig | None) -> Replay:
    """A recording by its path.

    Raises:
        SourceError: if it cannot be read, or an option is not valid.
        RigError: if no rig is given and the recording carries none.
    """
    check_options(spec, _OPTIONS)
    if not spec.what:
        raise SourceError("replay: names no recording; write replay:FOLDER or replay:FILE")
    speed = speed_of(spec)
    from_s, to_s = (number_of(spec, key, 0.0, 1e7) for key in ("from_s", "to_s"))
    return Replay(open_recording(Path(spec.what), rig, from_s=from_s, to_s=to_s), speed)


class Replay:
    """A recording (`graphvio.live.source.LiveSource`).

    Args:
        recording: is read once.
        speed: of its time, or None for as fast as it is taken.
    """

    def __init__(self, recording: Source, speed: float | None) -> None:
        self.name = recording.name
        self.is_realtime = speed is not None
        self._recording = recording
        self._pace = Pace(speed)

    def open(self) -> Rig:
        """The rig of the recording."""
        return self._recording.rig

    def readings(self) -> Iterator[Reading]:
        """Samples and images, each when it is due."""
        yield from paced(self._recording, self._recording.rig, self._pace)
        for event in self._recording.faults.events:
            yield Notice(event.kind, event.detail, host_ns())

    def health(self) -> Sequence[DeviceHealth]:
        """What was wrong with the recording until now."""
        return [DeviceHealth(self.name, True, "recording", dict(self._recording.faults.counts))]

    def close(self) -> None:
        """Read no further."""
        self._pace.stop()


def paced(measurements: Iterable[Measurement], rig: Rig, pace: Pace) -> Iterator[Reading]:
    """Measurements as readings of one clock, each when it is due; samples before the first frameset come at once."""
    has_begun = False
    for measurement in measurements:
        has_begun = has_begun or isinstance(measurement, FrameSet)
        if has_begun and not pace.wait_for(measurement.stamp_ns):
            return
        now_ns = host_ns()
        if isinstance(measurement, ImuSample):
            yield ImuReading(
                measurement.stamp_ns, measurement.angular_velocity, measurement.linear_acceleration, now_ns
            )
            continue
        for j, images in sorted(measurement.images.items()):
            for camera, image in zip((rig.pairs[j].left, rig.pairs[j].right), images, strict=True):
                yield CameraFrame(camera.name, measurement.stamp_ns, _Decoded(image), now_ns)


class _Decoded:
    """An image that a recording's own threads have decoded."""

    def __init__(self, image: Image) -> None:
        self._image = image

    def __call__(self) -> Image:
        return self._image
