"""The interface of live sources."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from graphvio.measurements.readings import DeviceHealth, Reading
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
        """Name for people, and fit for the name of a file."""

    @property
    def is_realtime(self) -> bool:
        """Whether readings arrive at the sensors' pace; else the source waits for its reader, and loses nothing."""

    def open(self) -> Rig:
        """Start the devices.

        Returns:
            The rig that was given, or the factory's calibration.

        Raises:
            SourceError: if a device is missing or cannot be started.
            RigError: if no rig is given and the devices provide none.
        """

    def readings(self) -> Iterator[Reading]:
        """Yield readings in the order of arrival, until the end of the source or `close`.

        A lost device is reported by a `Notice` and read on when it is back; it never raises.
        """

    def health(self) -> Sequence[DeviceHealth]:
        """Return the state of each device; from any thread."""

    def close(self) -> None:
        """Stop the devices and end `readings`; from any thread, a second call does nothing."""
