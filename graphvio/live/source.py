"""What every live source offers, whatever the sensors are."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from graphvio.arrays import Float, Image
from graphvio.rig import Rig

_EPOCH_NS = time.time_ns() - time.monotonic_ns()


def host_ns() -> int:
    """The host's clock: nanoseconds since 1970 as they were known at the start, and steady from there on."""
    return _EPOCH_NS + time.monotonic_ns()


@dataclass(frozen=True, slots=True, eq=False)
class ImuReading:
    """A sample of an IMU as it came.

    Attributes:
        stamp_ns: by ``clock``.
        angular_velocity: (3,) rad/s, frame body.
        linear_acceleration: (3,) m/s^2, frame body.
        arrival_ns: when it came, `host_ns`.
        clock: name of the clock that stamped it, such as a device's serial number; None where stamps are to be kept as
            they are, all sensors having one clock.
        temperature_c: of the sensor, or None.
    """

    stamp_ns: int
    angular_velocity: Float
    linear_acceleration: Float
    arrival_ns: int
    clock: str | None = None
    temperature_c: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CameraFrame:
    """An image as it came.

    Attributes:
        camera: its name in the rig.
        stamp_ns: by ``clock``, of the middle of the exposure where the device tells it.
        decode: makes the grey image (height, width) uint8, in a thread of its own; raises `graphvio.SourceError` if
            what came is damaged.
        arrival_ns: when it came, `host_ns`.
        clock: as with the IMU.
    """

    camera: str
    stamp_ns: int
    decode: Callable[[], Image]
    arrival_ns: int
    clock: str | None = None


@dataclass(frozen=True, slots=True)
class Notice:
    """Something that happened to a device.

    Attributes:
        kind: short name that can be counted: ``device_lost``, ``device_back``, or a fault of the driver.
        detail: one line for people.
        arrival_ns: when, `host_ns`.
        clock: of the device whose clock may have begun anew, or None.
    """

    kind: str
    detail: str
    arrival_ns: int
    clock: str | None = None


Reading = ImuReading | CameraFrame | Notice


@dataclass(frozen=True, slots=True)
class DeviceHealth:
    """How a device is.

    Attributes:
        name: of it.
        connected: whether it delivers, or would.
        detail: one line for people: model, firmware, what is wrong.
        counts: what was lost in the driver, by kind.
    """

    name: str
    connected: bool
    detail: str = ""
    counts: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """A device that is connected.

    Attributes:
        spec: what to write for SOURCE on the command line.
        description: one line for people.
    """

    spec: str
    description: str


class LiveSource(Protocol):
    """Sensors as a stream of readings, used once: open, read in a thread, close."""

    @property
    def name(self) -> str:
        """For people, and fit for the name of a file."""

    @property
    def is_realtime(self) -> bool:
        """Whether readings come when they come; else the source waits for whoever takes them, and loses nothing."""

    def open(self) -> Rig:
        """Start the devices.

        Returns:
            The rig that was given, or the factory's calibration.

        Raises:
            SourceError: if a device is not there or cannot be started.
            RigError: if no rig is given and the devices tell none.
        """

    def readings(self) -> Iterator[Reading]:
        """What comes, in the order in which it comes, until the end of the source or `close`.

        A device that is lost is told by a `Notice`, looked for, and read on when it is back; it never raises for that.
        """

    def health(self) -> Sequence[DeviceHealth]:
        """Each device; from any thread."""

    def close(self) -> None:
        """Stop the devices, and end `readings`; from any thread, a second time does nothing."""
