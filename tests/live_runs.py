"""Live runs for tests: scripted sources, and the estimates, events and figures of a run."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from recordings import START_NS, noise_image

from graphvio import Odometry, open_source
from graphvio.arrays import Image
from graphvio.config import Config
from graphvio.live.outputs import Output
from graphvio.live.running import LiveOdometry
from graphvio.live.source import LiveSource
from graphvio.live.sources import open_live_source
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.events import Event
from graphvio.measurements.readings import CameraFrame, DeviceHealth, ImuReading, Reading, host_ns
from graphvio.measurements.sensors import FrameSet
from graphvio.queues import BoundedQueue
from graphvio.rig import Rig

SOON_S = 60.0  # until then an end is waited for; only a test that fails takes so long
FRAME_NS, IMU_NS = 50_000_000, 5_000_000

Figures = Mapping[str, float | int | str | None]
T = TypeVar("T")


class Scripted:
    """A live source that gives what a function makes.

    Args:
        rig: of it.
        make: the readings.
        is_realtime: what it claims.
        interval_s: between readings.
    """

    name = "scripted"

    def __init__(
        self, rig: Rig, make: Callable[[], Iterator[Reading]], is_realtime: bool = False, interval_s: float = 0.0
    ) -> None:
        self.is_realtime = is_realtime
        self._rig = rig
        self._make = make
        self._interval_s = interval_s
        self._closed = threading.Event()

    def open(self) -> Rig:
        return self._rig

    def readings(self) -> Iterator[Reading]:
        for reading in self._make():
            if self._closed.wait(self._interval_s):
                return
            yield reading

    def health(self) -> Sequence[DeviceHealth]:
        return [DeviceHealth("scripted", not self._closed.is_set())]

    def close(self) -> None:
        self._closed.set()


class Stalling(Output):
    """Is held up by its first result until it is let go."""

    def __init__(self) -> None:
        self.is_held = threading.Event()
        self.may_go_on = threading.Event()
        self.results = 0

    def add_result(self, estimate: Estimate, frameset: FrameSet | None) -> None:
        self.is_held.set()
        assert self.may_go_on.wait(SOON_S)
        self.results += 1


def small_readings(
    rig: Rig, framesets: int = 100, decode: Callable[[int, Image], Image] = lambda _, image: image
) -> Iterator[Reading]:
    """Readings of a stationary rig that sees noise: IMU at 200 Hz, framesets at 20 Hz, images through ``decode``."""
    for i in range(framesets * FRAME_NS // IMU_NS):
        stamp_ns = START_NS + i * IMU_NS
        yield ImuReading(stamp_ns, np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.2, 9.81]), host_ns())
        if i % (FRAME_NS // IMU_NS):
            continue
        for number, camera in enumerate(rig.cameras):
            image = noise_image(number, camera.size_px)
            yield CameraFrame(
                camera.name, stamp_ns, lambda i=i, image=image: decode(i, image), host_ns()  # type: ignore[misc]
            )  # fmt: skip


def all_of(queue: BoundedQueue[T]) -> list[T]:
    """All items of a closed queue."""
    assert queue.is_closed
    taken = []
    while (item := queue.get()) is not None:
        taken.append(item)
    return taken


def run(
    source: LiveSource, config: Config | None = None, outputs: Sequence[Output] = ()
) -> tuple[list[Estimate], list[Event], Figures]:
    """Run a source to its end: estimates, events and status."""
    running = LiveOdometry(source, source.open(), config or Config(), outputs)
    estimates, events = running.estimates.subscribe(100_000), running.events.subscribe(100_000)
    running.start()
    assert running.wait(SOON_S)
    assert estimates.is_closed  # all can go home without anybody's stopping it
    running.stop()
    return all_of(estimates), all_of(events), running.status()


def run_spec(spec: str, outputs: Sequence[Output] = ()) -> tuple[list[Estimate], list[Event], Figures]:
    """The same by what is written on the command line."""
    return run(open_live_source(spec), outputs=outputs)


def plain(recording: Path) -> list[Estimate]:
    """Estimates of the odometry over a recording."""
    source = open_source(recording)
    odometry = Odometry(source.rig)
    estimates = [estimate for measurement in source if (estimate := odometry.process(measurement)) is not None]
    return [*estimates, *odometry.finish()]


def assert_same(found: Sequence[Estimate], expected: Sequence[Estimate]) -> None:
    """Bit for bit."""
    assert [each.stamp_ns for each in found] == [each.stamp_ns for each in expected]
    for one, other in zip(found, expected, strict=True):
        assert (one.status, one.epoch) == (other.status, other.epoch)
        np.testing.assert_array_equal(one.nav_T_body, other.nav_T_body)
        np.testing.assert_array_equal(one.covariance, other.covariance)
        np.testing.assert_array_equal(one.gyro_bias, other.gyro_bias)
