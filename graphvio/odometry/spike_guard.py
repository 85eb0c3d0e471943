"""Leaves out single IMU samples that are far from both neighbours, such as errors of a transmission."""

from __future__ import annotations

from math import dist, isfinite

from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.sensors import ImuSample

_OVER_MEAN, _OVER_NEIGHBOURS = 10.0, 4.0  # real flights do not reach half of this, with all their vibration
_MIN_RATE, _MIN_FORCE = 0.2, 1.0  # rad/s and m/s^2
_MIN_SAMPLES, _GAIN = 20, 0.02  # of the mean change from sample to sample
_MAX_NS = 100_000_000  # from the sample before to the one after


class SpikeGuard:
    """Passes IMU samples on; one that is far from the one before is held until the next one shows which is wrong.

    A spike is much farther from both neighbours than these are from each other, and than samples change in the mean:
    shocks and vibrations, which last for longer than a sample or come again, are none.

    Args:
        report: Receives an event for each spike.
    """

    def __init__(self, report: Report) -> None:
        self._report = report
        self._newest: ImuSample | None = None  # of those that were passed on
        self._suspect: ImuSample | None = None
        self._rate_change = self._force_change = 0.0  # from sample to sample, the mean
        self._count = 0

    def confirm(self, sample: ImuSample) -> list[ImuSample]:
        """Take a sample, and return those that may be used now, in time order."""
        rate, force = _change(self._newest or sample, sample)
        if not isfinite(rate + force):  # others refuse it
            return [sample]
        if self._newest is None:
            self._newest = sample
            return [sample]
        confirmed = []
        if self._suspect is not None:
            confirmed = self._judged(self._suspect, sample)
            rate, force = _change(self._newest, sample)
        if self._is_far(rate, force):
            self._suspect = sample
            return confirmed
        self._note(sample, rate, force)
        confirmed.append(sample)
        return confirmed

    def _judged(self, suspect: ImuSample, after: ImuSample) -> list[ImuSample]:
        """Return a sample that is far from the one before, or nothing where it is far from the one after as well."""
        self._suspect, before = None, self._newest
        assert before is not None
        rate, force = _change(before, suspect)
        rate_after, force_after = _change(suspect, after)
        is_near_in_time = after.stamp_ns - before.stamp_ns <= _MAX_NS
        if is_near_in_time and self._is_far(min(rate, rate_after), min(force, force_after), *_change(before, after)):
            self._report(suspect.stamp_ns, EventKind.IMU_SPIKE, "far from the samples before and after: left out")
            return []
        self._note(suspect, rate, force)
        return [suspect]

    def _is_far(self, rate: float, force: float, between_rates: float = 0.0, between_forces: float = 0.0) -> bool:
        """Whether rate or force change by much more than they do in the mean, and than between neighbours."""
        if self._count < _MIN_SAMPLES:
            return False
        return rate > max(_MIN_RATE, _OVER_MEAN * self._rate_change, _OVER_NEIGHBOURS * between_rates) or force > max(
            _MIN_FORCE, _OVER_MEAN * self._force_change, _OVER_NEIGHBOURS * between_forces
        )

    def _note(self, sample: ImuSample, rate: float, force: float) -> None:
        """Pass a sample on, with its change from the one before."""
        self._count += 1
        gain = max(1.0 / self._count, _GAIN)
        self._rate_change += gain * (rate - self._rate_change)
        self._force_change += gain * (force - self._force_change)
        self._newest = sample


def _change(first: ImuSample, second: ImuSample) -> tuple[float, float]:
    """Return by how much angular velocity and specific force differ."""
    rate = dist(first.angular_velocity.tolist(), second.angular_velocity.tolist())
    return rate, dist(first.linear_acceleration.tolist(), second.linear_acceleration.tolist())
