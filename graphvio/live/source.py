"""The interface of live sources, and a live source with only some of its cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from graphvio.measurements.readings import CameraFrame, DeviceHealth, Reading
from graphvio.rig import Rig


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """A device that is connected."""

    spec: str  # what to write for SOURCE on the command line
    description: str  # one line for people


class LiveSource(Protocol):
    """Sensors as a stream of readings, used once: open, read in a thread, close."""

    @property
    def name(self) -> str:
        """Name for people, which can also be used in file names."""

    @property
    def is_realtime(self) -> bool:
        """Whether readings arrive in real time; otherwise the source waits for its reader, and loses nothing."""

    def open(self) -> Rig:
        """Start the devices.

        Returns:
            The rig that the source was given, or one with the factory's calibration.

        Raises:
            SourceError: if a device is missing or cannot be started.
            RigError: if no rig is given and the devices provide none.
        """

    def readings(self) -> Iterator[Reading]:
        """Yield readings in the order of arrival, until the end of the source or `close`.

        A lost device is reported by a `Notice`, and never raises; its readings continue when it is back.
        """

    def health(self) -> Sequence[DeviceHealth]:
        """Return the state of each device; may be called from any thread."""

    def close(self) -> None:
        """Stop the devices and end `readings`; may be called from any thread, a second call does nothing."""


class SelectedCameras:
    """A `LiveSource` without the images of cameras that are not used.

    Args:
        source: the source, not opened yet.
        choose: takes the source's rig and returns the part of it to use; may raise RigError.
    """

    def __init__(self, source: LiveSource, choose: Callable[[Rig], Rig]) -> None:
        self._source = source
        self._choose = choose
        self._unused: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        """See `LiveSource.name`."""
        return self._source.name

    @property
    def is_realtime(self) -> bool:
        """See `LiveSource.is_realtime`."""
        return self._source.is_realtime

    def open(self) -> Rig:
        """See `LiveSource.open`."""
        whole = self._source.open()
        chosen = self._choose(whole)
        self._unused = frozenset(camera.name for camera in whole.cameras) - {camera.name for camera in chosen.cameras}
        return chosen

    def readings(self) -> Iterator[Reading]:
        """See `LiveSource.readings`."""
        for reading in self._source.readings():
            if not (isinstance(reading, CameraFrame) and reading.camera in self._unused):
                yield reading

    def health(self) -> Sequence[DeviceHealth]:
        """See `LiveSource.health`."""
        return self._source.health()

    def close(self) -> None:
        """See `LiveSource.close`."""
        self._source.close()
