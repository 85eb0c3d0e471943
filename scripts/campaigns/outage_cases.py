"""The cases of ``scripts/campaign outages``: faults of a recording's data, and the required behaviour."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement

BEGIN_S = 3.0
"""Start of the faults, seconds after the recording's first frameset."""
_LENGTH_S, _LONGER_S = 12.0, 16.0  # lengths of the part of the recording that is run
_END_OF_VISION_S = 8.0
_NEVER_S = math.inf
_MS = 1_000_000

Change = Callable[[Measurement], list[Measurement]]
"""A function that returns the measurements that are delivered in place of a measurement."""


@dataclass(frozen=True)
class Case:
    """One fault, or two at once.

    Attributes:
        name: name in the tables.
        requirement: the required behaviour, in words for the table.
        make: returns a new change, which is applied to the measurements from ``begin_s`` on and before ``end_s``.
        begin_s: start in seconds after the first frameset; minus infinity to include all measurements before it, too.
        end_s: end in seconds after the first frameset; infinite if the fault never ends.
        late_s: time by which framesets are delivered later than the IMU samples of the same instant.
        jump_s: time by which the change moves the stamps.
        length_s: length of the part of the recording that is run.
    """

    name: str
    requirement: str
    make: Callable[[], Change]
    begin_s: float = BEGIN_S
    end_s: float = _NEVER_S
    late_s: float = 0.0
    jump_s: float = 0.0
    length_s: float = _LENGTH_S

    @property
    def over_s(self) -> float:
        """End of the fault, seconds; for a jump of the clock its start, since it has no duration."""
        return self.begin_s if self.jump_s > 0.0 else self.end_s

    def true_ns(self, stamp_ns: int, start_ns: int) -> int:
        """Return the stamp in the recording that belongs to a delivered stamp, nanoseconds."""
        jumped = self.jump_s > 0.0 and (stamp_ns - start_ns) * 1e-9 > self.begin_s + 0.5 * self.jump_s
        return stamp_ns - round(self.jump_s * 1e9) if jumped else stamp_ns


class Delivery:
    """Iterator over the measurements of a recording, as they are delivered in a case.

    Attributes:
        framesets: number of the recording's framesets that were delivered so far, each counted once.
    """

    def __init__(self, case: Case, measurements: Iterable[Measurement], start_ns: int) -> None:
        self.framesets = 0
        self._case, self._measurements, self._start_ns = case, measurements, start_ns

    def __iter__(self) -> Iterator[Measurement]:
        late_ns, held = round(self._case.late_s * 1e9), deque[FrameSet]()
        for measurement in self._changed():
            while held and held[0].stamp_ns + late_ns < measurement.stamp_ns:
                yield held.popleft()
            if late_ns and isinstance(measurement, FrameSet):
                held.append(measurement)
            else:
                yield measurement
        yield from held

    def _changed(self) -> Iterator[Measurement]:
        case, change = self._case, self._case.make()
        for measurement in self._measurements:
            time_s = (measurement.stamp_ns - self._start_ns) * 1e-9
            delivered = change(measurement) if case.begin_s - 1e-3 <= time_s < case.end_s - 1e-3 else [measurement]
            self.framesets += isinstance(measurement, FrameSet) and bool(delivered)
            yield from delivered


# ------------------------------------------------------------------ changes


def _unchanged() -> Change:
    return lambda measurement: [measurement]


def _of_framesets(change: Callable[[FrameSet], FrameSet | None]) -> Change:
    return lambda measurement: _present(change(measurement)) if isinstance(measurement, FrameSet) else [measurement]


def _of_samples(change: Callable[[ImuSample], ImuSample | None]) -> Change:
    return lambda measurement: _present(change(measurement)) if isinstance(measurement, ImuSample) else [measurement]


def _present(measurement: Measurement | None) -> list[Measurement]:
    return [] if measurement is None else [measurement]


def _black(*pairs: int) -> Callable[[], Change]:
    """Return a maker of a change that blackens the images of the given pairs, or of all pairs if none is given."""

    def blackened(frameset: FrameSet) -> FrameSet:
        dark = {j: (np.zeros_like(left), np.zeros_like(right)) for j, (left, right) in frameset.images.items()}
        chosen = {j: images for j, images in dark.items() if not pairs or j in pairs}
        return replace(frameset, images={**frameset.images, **chosen})

    return lambda: _of_framesets(blackened)


def _without_imu() -> Change:
    return _of_samples(lambda _: None)


def _stuck(axis: int) -> Callable[[], Change]:
    def held(sample: ImuSample) -> ImuSample:
        rate, force = sample.angular_velocity.copy(), sample.linear_acceleration.copy()
        rate[axis], force[axis] = 0.1, 0.5
        return ImuSample(sample.stamp_ns, rate, force)

    return lambda: _of_samples(held)


def _repeated() -> Change:
    seen: list[ImuSample] = []

    def first_again(sample: ImuSample) -> ImuSample:
        seen.append(sample)
        return replace(seen[0], stamp_ns=sample.stamp_ns)

    return _of_samples(first_again)


def _stuck_and_black() -> Change:
    stick, blacken = _stuck(2)(), _black()()
    return lambda measurement: blacken(measurement) if isinstance(measurement, FrameSet) else stick(measurement)


def _cut_off() -> Change:
    return _of_samples(lambda s: replace(s, angular_velocity=np.clip(s.angular_velocity, -0.15, 0.15)))


def _not_a_number() -> Change:
    numbers = iter(range(1_000_000))
    bad = np.array([np.nan, 0.0, 0.0])
    return _of_samples(lambda s: replace(s, linear_acceleration=bad) if next(numbers) % 4 == 0 else s)


def _muddled() -> Change:
    """Return a change that delivers every measurement twice, and once more with an earlier stamp."""

    def three(measurement: Measurement) -> list[Measurement]:
        back_ms = 20 if isinstance(measurement, ImuSample) else 200
        return [measurement, measurement, replace(measurement, stamp_ns=measurement.stamp_ns - back_ms * _MS)]

    return three


def _half() -> Change:
    rng = np.random.default_rng(0)
    return _of_framesets(lambda frameset: frameset if rng.random() < 0.5 else None)


def _by_another_clock(late_s: float) -> Callable[[], Change]:
    late_ns = round(late_s * 1e9)
    return lambda: _of_samples(lambda s: replace(s, stamp_ns=s.stamp_ns + late_ns))


def _turned() -> Change:
    """Return a change that turns the IMU's readings by 90 degrees about the z axis of body."""
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return _of_samples(lambda s: ImuSample(s.stamp_ns, turn @ s.angular_velocity, turn @ s.linear_acceleration))


def _jumped(jump_s: float) -> Callable[[], Change]:
    jump_ns = round(jump_s * 1e9)
    return lambda: lambda measurement: [replace(measurement, stamp_ns=measurement.stamp_ns + jump_ns)]


# ------------------------------------------------------------------ cases


def _after(duration_s: float) -> float:
    return BEGIN_S + duration_s


_GOES_ON = "the same epoch goes on when images are back"
_COASTED_ON = "coasts on the IMU with growing uncertainty"
_COASTED = f"{_COASTED_ON}; {_GOES_ON}"
_LOST = "coasts, then reports that it is lost and gives no pose; a new epoch when images are back"
_VISION_GOES_ON = "vision goes on without the IMU"
_LEFT_OUT = "the axis that sticks is reported; vision goes on without the IMU"
_CLOCK = "the IMU is left out after half a second, and its clock corrected"
_NEW_EPOCH = "a new epoch at the last pose"

CASES = (
    Case("none", "tracks", _unchanged),
    *(Case(f"all pairs black, {s:g} s", _COASTED, _black(), end_s=_after(s)) for s in (0.3, 1.0, 3.0, 5.0)),
    Case("all pairs black, 8 s", _LOST, _black(), end_s=_after(8.0), length_s=_LONGER_S),
    Case(f"all pairs black for good, the last {_LENGTH_S - _END_OF_VISION_S:g} s", _COASTED_ON, _black(),
         begin_s=_END_OF_VISION_S),
    Case("one pair black, 3 s", "the other pair goes on", _black(1), end_s=_after(3.0)),
    Case("half of the framesets missing, throughout", "tracks", _half, begin_s=0.5),
    Case("framesets 200 ms late, throughout", "are used at their instants: the same poses", _unchanged,
         begin_s=-math.inf, late_s=0.2),
    Case("no IMU, 0.2 s", _VISION_GOES_ON, _without_imu, end_s=_after(0.2)),
    Case("no IMU, 2 s", _VISION_GOES_ON, _without_imu, end_s=_after(2.0)),
    Case("no IMU for good", _VISION_GOES_ON, _without_imu),
    Case("NaN in a quarter of the samples, 3 s", "these are left out", _not_a_number, end_s=_after(3.0)),
    Case("axis 0 of gyro and accelerometer stuck, 2 s", _LEFT_OUT, _stuck(0), end_s=_after(2.0)),
    Case("axis 2 of gyro and accelerometer stuck, 2 s", _LEFT_OUT, _stuck(2), end_s=_after(2.0)),
    Case("one sample of the IMU repeated, 2 s", _LEFT_OUT, _repeated, end_s=_after(2.0)),
    Case("gyro cut off at 0.15 rad/s, 3 s", "vision is refused for a second at most, then used", _cut_off,
         end_s=_after(3.0)),
    Case("IMU 100 ms late by its stamps, throughout", _CLOCK, _by_another_clock(0.1), begin_s=-math.inf),
    Case("IMU's clock jumps by -0.1 s", _CLOCK, _by_another_clock(-0.1)),
    Case("IMU's axes turned by 90 degrees, throughout", "the IMU is left out after half a second", _turned,
         begin_s=-math.inf),
    Case("axis 2 stuck while all pairs are black, 0.5 s", "coasts with growing uncertainty; " + _GOES_ON,
         _stuck_and_black, end_s=_after(0.5)),
    Case("all twice and with backward stamps, throughout", "both are left out: the same poses", _muddled,
         begin_s=-math.inf),
    Case("all clocks jump by 7 s", _NEW_EPOCH, _jumped(7.0), jump_s=7.0),
    Case("all clocks jump by 10 000 s", _NEW_EPOCH, _jumped(10_000.0), jump_s=10_000.0),
)  # fmt: skip
"""All cases. The first has no fault, as a baseline."""
