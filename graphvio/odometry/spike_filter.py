"""A filter that leaves out single IMU samples far from both neighbours, such as transmission errors."""

from __future__ import annotations

from math import dist, isfinite

from graphvio.backend.inertial import value_fault
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.sensors import ImuSample

_OVER_MEAN, _OVER_NEIGHBOURS = 10.0, 4.0  # the vibration of real flights does not reach half of this
_MIN_RATE, _MIN_FORCE = 0.2, 1.0  # rad/s and m/s^2
_MIN_SAMPLES, _GAIN = 20, 0.02  # samples until the mean change is known, and gain of its filter
_MAX_STEP_NS = 8_000_000  # between samples: a real shock may be shorter than that
_MAX_LEFT_OUT = 0.1  # share of the samples: changes that frequent are real

_Readings = tuple[list[float], list[float]]  # rate and force
_Change = tuple[float, float]  # change of rate, rad/s, and of force, m/s^2
_NONE: _Change = (0.0, 0.0)


class SpikeFilter:
    """Passes IMU samples on; a sample far from the previous one is held until the next one shows which is wrong.

    A spike is much farther from both neighbours than these are from each other, than the last three samples before it
    are from each other, and than samples change on average: so shocks and vibrations, which last longer than one sample
    or recur, are not spikes. Where samples are more than 8 ms apart, nothing is held.

    Args:
        report: Receives an event for each sample that is left out.
    """

    def __init__(self, report: Report) -> None:
        self._report = report
        self._newest: ImuSample | None = None  # newest of the samples that were passed on
        self._readings: _Readings = ([], [])  # its readings as lists, as numpy is slow for three numbers
        self._suspect: ImuSample | None = None
        self._mean: _Change = _NONE  # mean change from sample to sample
        self._last: tuple[_Change, _Change] = (_NONE, _NONE)
        self._count, self._left_out = 0, 0.0  # samples, and the recent share of those that were left out

    def confirm(self, sample: ImuSample) -> list[ImuSample]:
        """Add a sample, and return those to be passed on now, in time order, including samples with a `value_fault`."""
        readings = _readings(sample)
        if self._newest is None:
            if not value_fault(sample):
                self._newest, self._readings = sample, readings
            return [sample]
        change = _change(self._readings, readings)
        is_far = self._are_far(change, _NONE)
        may_be_faulty = is_far or self._count < _MIN_SAMPLES or not isfinite(sum(change))
        if may_be_faulty and value_fault(sample):
            return [sample]
        if sample.stamp_ns <= self._newest.stamp_ns:
            return [sample]  # the buffer refuses it
        confirmed = []
        if self._suspect is not None:
            if sample.stamp_ns <= self._suspect.stamp_ns:  # it would be passed on before the held sample
                is_copy = sample.stamp_ns == self._suspect.stamp_ns
                kind = EventKind.IMU_DUPLICATE_STAMP if is_copy else EventKind.IMU_BACKWARD_STAMP
                self._report(sample.stamp_ns, kind, "sample left out")
                return []
            confirmed = self._judged(self._suspect, sample)
            change = _change(self._readings, readings)
            is_far = self._are_far(change, _NONE)
        if is_far and sample.stamp_ns - self._newest.stamp_ns <= _MAX_STEP_NS:
            self._suspect = sample
            return confirmed
        self._note(sample, readings, change)
        confirmed.append(sample)
        return confirmed

    def end(self) -> list[ImuSample]:
        """Return the sample that is held, if any, as no sample follows to decide about it."""
        suspect, self._suspect = self._suspect, None
        return [] if suspect is None else [suspect]

    def _judged(self, suspect: ImuSample, after: ImuSample) -> list[ImuSample]:
        """Return the held sample, or nothing where it is far from the next sample as well."""
        self._suspect = None
        readings, next_ones = _readings(suspect), _readings(after)
        into, out_of = _change(self._readings, readings), _change(readings, next_ones)
        past = _change(self._readings, next_ones)
        neighbours = _largest(past, *self._last)
        is_far = self._are_far((min(into[0], out_of[0]), min(into[1], out_of[1])), neighbours)
        is_spike = is_far and after.stamp_ns - suspect.stamp_ns <= _MAX_STEP_NS
        if is_spike and self._left_out < _MAX_LEFT_OUT:
            self._left_out += _GAIN
            self._report(suspect.stamp_ns, EventKind.IMU_SPIKE, "far from the samples before and after: left out")
            return []
        self._note(suspect, readings, into)
        return [suspect]

    def _are_far(self, change: _Change, neighbours: _Change) -> bool:
        """Whether rate or force change by much more than on average, and than the neighbours' changes."""
        if self._count < _MIN_SAMPLES:
            return False
        rate = max(_MIN_RATE, _OVER_MEAN * self._mean[0], _OVER_NEIGHBOURS * neighbours[0])
        force = max(_MIN_FORCE, _OVER_MEAN * self._mean[1], _OVER_NEIGHBOURS * neighbours[1])
        return change[0] > rate or change[1] > force

    def _note(self, sample: ImuSample, readings: _Readings, change: _Change) -> None:
        """Record a sample that is passed on, with its readings and their change from the previous ones."""
        self._count += 1
        gain = max(1.0 / self._count, _GAIN)
        rate, force = self._mean
        self._mean = rate + gain * (change[0] - rate), force + gain * (change[1] - force)
        self._left_out -= _GAIN * self._left_out
        self._newest, self._readings, self._last = sample, readings, (self._last[1], change)


def _readings(sample: ImuSample) -> _Readings:
    return sample.angular_velocity.tolist(), sample.linear_acceleration.tolist()


def _change(first: _Readings, second: _Readings) -> _Change:
    """Return the distances between two angular velocities and between two specific forces."""
    return dist(first[0], second[0]), dist(first[1], second[1])


def _largest(*changes: _Change) -> _Change:
    """Return the largest change of rate and that of force."""
    return max(rate for rate, _ in changes), max(force for _, force in changes)
