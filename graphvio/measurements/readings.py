"""What devices deliver: IMU readings, camera frames and notices, stamped by their own clocks, and the host's clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from graphvio.arrays import Float, Image

_EPOCH_NS = time.time_ns() - time.monotonic_ns()


def host_ns() -> int:
    """Return the host's time: nanoseconds since 1970, steady from the start of the process on."""
    return _EPOCH_NS + time.monotonic_ns()


@dataclass(frozen=True, slots=True, eq=False)
class ImuReading:
    """An IMU sample as it arrives.

    Attributes:
        stamp_ns: on ``clock``.
        angular_velocity: (3,) rad/s, frame body.
        linear_acceleration: (3,) m/s^2, frame body.
        arrival_ns: host time of its arrival, see `host_ns`.
        clock: name of the clock that stamped it, such as a device's serial number; None where stamps are kept as they
            are, all sensors sharing one clock.
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
    """An image as it arrives.

    Attributes:
        camera: its name in the rig.
        stamp_ns: on ``clock``, of the middle of the exposure where the device reports it.
        decode: makes the grey image (height, width) uint8, in another thread; raises `graphvio.SourceError` if the
            data are damaged.
        arrival_ns: host time of its arrival, see `host_ns`.
        clock: as for `ImuReading`.
    """

    camera: str
    stamp_ns: int
    decode: Callable[[], Image]
    arrival_ns: int
    clock: str | None = None


@dataclass(frozen=True, slots=True)
class Notice:
    """A change in the state of a device.

    Attributes:
        kind: short name that can be counted: ``device_lost``, ``device_back``, or a fault of the driver.
        detail: one line for people.
        arrival_ns: host time, see `host_ns`.
        clock: of the device, whose clock may have restarted, or None.
    """

    kind: str
    detail: str
    arrival_ns: int
    clock: str | None = None


Reading = ImuReading | CameraFrame | Notice


@dataclass(frozen=True, slots=True)
class DeviceHealth:
    """The state of a device.

    Attributes:
        name: of the device.
        connected: whether it delivers, or could.
        detail: one line for people: model, firmware, what is wrong.
        counts: losses in the driver, by kind.
    """

    name: str
    connected: bool
    detail: str = ""
    counts: Mapping[str, int] = field(default_factory=dict)
