"""Faults of simulated devices: drifting clocks, late arrivals and outages."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from graphvio.errors import SourceError
from graphvio.measurements.events import EventKind
from graphvio.measurements.readings import CameraFrame, ImuReading, Notice, Reading, host_ns
from graphvio.rig import Rig

IMU = "imu"
OPTIONS = ("drift_ppm", "jitter_ms", "unplug")
_CLOCK_OFFSET_NS = 7_000_000_000_000  # between the clocks of consecutive devices


@dataclass(frozen=True)
class Outage:
    """An interval of the walk, in seconds, in which a device is unplugged."""

    device: str
    from_s: float
    to_s: float


@dataclass(frozen=True)
class DeviceFaults:
    """Faults of a rig's devices, which are the pairs, the single cameras and the IMU."""

    # drift of the first device's clock; those of the others are at most as large, of alternating sign. With None, all
    # devices share one clock
    drift_ppm: float | None = None
    jitter_ms: float = 0.0  # mean of the exponentially distributed delay of a reading on its way to the host
    outages: tuple[Outage, ...] = ()  # intervals in which devices are unplugged

    @staticmethod
    def parse(options: Mapping[str, str], rig_devices: tuple[str, ...]) -> DeviceFaults:
        """Parse options such as ``drift_ppm=100``, ``jitter_ms=2`` and ``unplug=back@5-8,imu@20-21``.

        Raises:
            SourceError: if the rig does not have a device, or a value is not valid.
        """
        try:
            drift = float(options["drift_ppm"]) if "drift_ppm" in options else None
            jitter = float(options.get("jitter_ms", "0"))
            outages = []
            for text in filter(None, options.get("unplug", "").split(",")):
                device, _, interval = text.partition("@")
                begin, _, end = interval.partition("-")
                outages.append(Outage(device, float(begin), float(end)))
        except ValueError:
            raise SourceError(
                "simulator: a fault's value is not a number; write drift_ppm=100, jitter_ms=2, unplug=DEVICE@FROM-TO"
            ) from None
        for outage in outages:
            if outage.device not in rig_devices:
                raise SourceError(
                    f"simulator: there is no device {outage.device!r}; there are {', '.join(rig_devices)}"
                )
            if not 0.0 <= outage.from_s < outage.to_s < math.inf:
                raise SourceError(f"simulator: {outage.device} is unplugged for no time; write unplug=DEVICE@FROM-TO")
        if not 0.0 <= jitter <= 1000.0 or not abs(drift or 0.0) <= 1000.0:  # also refuses NaN
            raise SourceError("simulator: jitter_ms is not from 0 to 1000, or drift_ppm not from -1000 to 1000")
        return DeviceFaults(drift, jitter, tuple(outages))


def devices_of(rig: Rig) -> tuple[str, ...]:
    """Return the names of the pairs and single cameras and, if there is one, the IMU."""
    return (*(group.name for group in rig.groups), *((IMU,) if rig.imu is not None else ()))


def with_faults(
    readings: Iterable[Reading], rig: Rig, faults: DeviceFaults, start_ns: int, seed: int
) -> Iterator[Reading]:
    """Apply faults to readings of one clock; the times of outages count from the stamp ``start_ns``."""
    devices = devices_of(rig)
    device_of = {camera.name: group.name for group in rig.groups for camera in group.cameras}
    rng, number = np.random.default_rng(seed), count()
    late: list[tuple[int, int, Reading]] = []
    last_ns = dict.fromkeys(devices, 0)  # readings of a device keep their order
    gone: frozenset[str] = frozenset()
    for reading in readings:
        if isinstance(reading, Notice):
            yield reading
            continue
        device = device_of[reading.camera] if isinstance(reading, CameraFrame) else IMU
        now_s = (reading.stamp_ns - start_ns) * 1e-9
        absent = frozenset(each.device for each in faults.outages if each.from_s <= now_s < each.to_s)
        for name in sorted(absent ^ gone):
            kind = EventKind.DEVICE_LOST if name in absent else EventKind.DEVICE_BACK
            yield Notice(kind, f"{name} was {'un' * (name in absent)}plugged", host_ns(), name)
        gone = absent
        if device in gone:
            continue
        if faults.drift_ppm is not None:
            reading = _by_own_clock(reading, device, devices.index(device), faults.drift_ppm, start_ns)
        if not faults.jitter_ms:
            yield reading
            continue
        arrival_ns = max(reading.arrival_ns + round(1e6 * rng.exponential(faults.jitter_ms)), last_ns[device])
        last_ns[device] = arrival_ns
        heapq.heappush(late, (arrival_ns, next(number), replace(reading, arrival_ns=arrival_ns)))
        while late and late[0][0] <= host_ns():
            yield heapq.heappop(late)[2]
    while late:
        yield heapq.heappop(late)[2]


def _by_own_clock(
    reading: ImuReading | CameraFrame, device: str, place: int, drift_ppm: float, start_ns: int
) -> ImuReading | CameraFrame:
    drift = 1e-6 * drift_ppm * (-1.0) ** place / (1.0 + place // 2)
    elapsed_ns = reading.stamp_ns - start_ns
    stamp_ns = place * _CLOCK_OFFSET_NS + elapsed_ns + round(drift * elapsed_ns)
    return replace(reading, stamp_ns=stamp_ns, clock=device)
