"""Data that devices deliver, with stamps of their own clocks: IMU readings, camera frames and notices."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from graphvio.arrays import Float, Image

_EPOCH_NS = time.time_ns() - time.monotonic_ns()


def host_ns() -> int:
    """Return the host's time, nanoseconds since 1970; it is monotonic within the process."""
    return _EPOCH_NS + time.monotonic_ns()


@dataclass(frozen=True, slots=True, eq=False)
class ImuReading:
    """An IMU sample as it arrives.

    Attributes:
        stamp_ns: stamp on ``clock``.
        angular_velocity: (3,) rad/s, frame body.
        linear_acceleration: (3,) m/s^2, frame body.
        arrival_ns: host time of its arrival, see `host_ns`.
        clock: name of the clock that stamped it, such as a device's serial number; None where stamps are kept as they
            are, all sensors sharing one clock.
        temperature_c: temperature of the sensor, or None.
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
        camera: name of the camera in the rig.
        stamp_ns: stamp on ``clock``, of the middle of the exposure where the device reports it.
        decode: returns the grey image (height, width) uint8, and is called in another thread; raises
            `graphvio.SourceError` if the data are damaged.
        arrival_ns: host time of its arrival, see `host_ns`.
        clock: as in `ImuReading`.
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
        clock: name of the device's clock if it may have restarted, or None.
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
        name: name of the device.
        connected: whether the device delivers data, or could.
        detail: one line for people: model, firmware, what is wrong.
        counts: number of losses in the driver, by kind.
    """

    name: str
    connected: bool
    detail: str = ""
    counts: Mapping[str, int] = field(default_factory=dict)
