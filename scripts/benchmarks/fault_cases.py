"""The cases of the fault benchmark, and the measurements that the odometry receives in each of them."""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks import fault_delivery as delivery
from benchmarks import fault_images as images
from benchmarks import fault_planes as planes
from benchmarks.fault_images import Fault, Images, Moment
from benchmarks.fault_scenes import CORRIDOR_S
from graphvio.arrays import Float
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.simulation import build_scene
from graphvio.sources import Source

Intervals = tuple[tuple[float, float], ...]
"""Intervals (start, end) in seconds since the first frameset, in order of time."""

WALKS = ("room", "calibration", "stairs")
"""Scenes in which faults are simulated: seed k uses the scene at index k modulo their number."""

_FIRST_S = 2.5  # the rig is stationary for a second and then accelerates for another
_LASTS_S = (0.3, 2.2)
_PAUSE_S = (0.7, 1.6)
_KEPT = 80  # framesets before the present one that a fault may use


@dataclass(frozen=True)
class Case:
    """One hard case.

    Attributes:
        name: name in the table and for ``--cases``.
        title: description in the table.
        fault: function that alters images in some intervals of time; None if the scene itself is hard.
        scene: scene of the case; None for the walk that belongs to the seed.
    """

    name: str
    title: str
    fault: Fault | None = None
    scene: str | None = None

    def intervals(self, seed: int, duration_s: float) -> Intervals:
        """Return the intervals in which the case is hard.

        Faults come repeatedly, for 0.3 to 2.2 s each time. Hard scenes are hard all the time, except for the corridor,
        which has intervals of its own.
        """
        if self.name == "clean":
            return ()
        if self.scene == "corridor":
            measurements = build_scene("corridor", CORRIDOR_S).events.values()
            return tuple(sorted((a, b) for a, b in measurements if a < duration_s))
        if self.fault is None:
            return ((0.0, duration_s),)
        draw = np.random.default_rng(self.seed(seed))
        intervals, start = [], _FIRST_S
        while start < duration_s:
            end = start + draw.uniform(*_LASTS_S)
            intervals.append((start, min(end, duration_s)))
            start = end + draw.uniform(*_PAUSE_S)
        return tuple(intervals)

    def seed(self, seed: int) -> tuple[int, int]:
        """Return the seed of all random values of this case."""
        return seed, zlib.crc32(self.name.encode())


CASES = (
    Case("clean", "no fault"),
    Case("corridor", "corridor: door, crowd, blank bend, failing lamps", scene="corridor"),
    Case("bare", "blank walls, one picture on each", scene="bare"),
    Case("repeating", "repeating texture all over", scene="repeating"),
    Case("darkness", "darkness", images.darkness),
    Case("over_exposure", "over-exposure", images.over_exposure),
    Case("exposure_jumps", "exposure jumps, each camera its own", images.exposure_jumps),
    Case("motion_blur", "motion blur", images.motion_blur),
    Case("door", "a door fills one view and moves", planes.door_in_one_view),
    Case("people", "people cross one view", planes.people_before_one_pair),
    Case("people_around", "people cross all views", planes.people_all_around),
    Case("crowd", "a crowd walks as one in all views", planes.crowd_as_one),
    Case("glass", "a reflection in glass, one pair", images.glass),
    Case("water", "water in the lower half of all views", images.water),
    Case("cable", "one pair's cable pulled", delivery.no_pair),
    Case("cables", "all cables pulled", delivery.nothing),
    Case("black", "black images, one pair", delivery.black),
    Case("swapped", "left and right swapped, one pair", delivery.swapped),
    Case("all_swapped", "left and right swapped, all pairs", delivery.all_swapped),
    Case("exchanged", "pairs plugged in each other's place", delivery.pairs_exchanged),
    Case("frozen_camera", "one camera frozen", delivery.frozen_camera),
    Case("frozen_pair", "one pair frozen", delivery.frozen_pair),
    Case("frozen_all", "all cameras frozen", delivery.frozen_all),
    Case("late_camera", "a right camera late by a frameset", delivery.late_camera),
    Case("late_pair", "one pair late by two framesets", delivery.late_pair),
    Case("torn", "every other image torn", delivery.torn),
    Case("torn_pair", "one pair torn throughout", delivery.torn_pair),
    Case("garbage", "bands of garbage", delivery.garbage_bands),
    Case("salt", "salt and pepper", images.salt_and_pepper),
    Case("covered", "one pair's lenses half covered", images.covered_half),
    Case("dirt", "dirt on all lenses", images.dirty_lenses),
)


def hard_measurements(
    case: Case, seed: int, source: Source, truth: dict[int, Float], duration_s: float
) -> Iterator[tuple[Measurement, bool]]:
    """Yield the measurements of a recording with a case's faults, and whether each falls into a fault's interval.

    Args:
        case: the case.
        seed: seed of all random values.
        source: the recording; its length is ``duration_s``.
        truth: stamp -> ``world_T_body`` (4, 4), at the framesets' stamps.
        duration_s: length of the recording.
    """
    intervals = case.intervals(seed, duration_s)
    before: deque[Images] = deque(maxlen=_KEPT)
    stamps: list[int] = []
    began = (-1, 0)  # the current interval, and the index of its first frameset
    for measurement in source:
        since_s = (measurement.stamp_ns - source.start_ns) * 1e-9
        inside = next((k for k, (start, end) in enumerate(intervals) if start <= since_s < end), None)
        if not isinstance(measurement, FrameSet):
            yield measurement, inside is not None
            continue
        stamps.append(measurement.stamp_ns)
        images: Images = measurement.stereo
        if inside is not None and case.fault is not None:
            if began[0] != inside:
                began = inside, len(stamps) - 1
            images = case.fault(
                _moment(measurement, list(before), source, truth, stamps, began[1], (*case.seed(seed), inside))
            )
        before.append(measurement.stereo)
        if images:
            yield FrameSet(measurement.stamp_ns, images), inside is not None


def _moment(
    frameset: FrameSet,
    before: list[Images],
    source: Source,
    truth: dict[int, Float],
    stamps: list[int],
    first: int,
    seed: tuple[int, ...],
) -> Moment:
    then, earlier = truth[stamps[first]], truth[stamps[first - 1]]
    period_s = (stamps[first] - stamps[first - 1]) * 1e-9
    return Moment(
        images=frameset.stereo,
        before=before,
        rig=source.rig,
        world_T_body=truth[frameset.stamp_ns],
        world_T_body_then=then,
        velocity_then=(then[:3, 3] - earlier[:3, 3]) / period_s,
        number=len(stamps) - 1 - first,
        period_s=period_s,
        seed=seed,
    )
