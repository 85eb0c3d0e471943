"""Some of a live source's cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from graphvio.live.source import LiveSource
from graphvio.measurements.readings import CameraFrame, DeviceHealth, Reading
from graphvio.rig import Rig


class SelectedCameras:
    """A `LiveSource` without the images of cameras that are not used.

    Args:
        source: not opened yet.
        choose: returns the rig to use of the source's rig; may raise RigError.
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
