"""Estimation of the relation between two cameras' clocks on one rig, from the angular speeds of their trajectories.

The angular speed is the same for all cameras of a rig, so the offset is where the correlation of both speeds over time
has its maximum; nothing else needs to be known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.errors import CalibrationError
from graphvio.geometry import so3_log
from graphvio.trajectory import Trajectory

_RATE_HZ = 100.0
_OVER_S = 0.15  # angular speeds are averaged over this time
_MIN_OVERLAP_S = 5.0
_MIN_CORRELATION = 0.6
_PERFECT = 0.9999
_MAX_RIVALRY = 0.8  # likelihood of the second best offset over that of the best
_APART_S = 1.0  # minimum distance between these two
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class ClockRelation:
    """The offset and drift between the clocks of two trajectories."""

    offset_ns: int  # add it to a stamp of the first to get the second's of the same instant, at `at_ns`
    drift: float  # rate at which the offset grows, seconds per second
    at_ns: int  # an instant in the middle, by the first clock

    def of(self, stamps_ns: Int) -> Int:
        """Convert stamps (N,) of the first clock to the second."""
        since = stamps_ns - self.at_ns
        return np.asarray(stamps_ns + self.offset_ns + np.round(self.drift * since).astype(np.int64))

    def corrected(self, offset_s: float, drift: float) -> ClockRelation:
        """Return the relation with corrections added to offset and drift."""
        return replace(self, offset_ns=self.offset_ns + round(offset_s * _NS_PER_S), drift=self.drift + drift)


def first_relation(one: Trajectory, other: Trajectory, same_clock: bool) -> ClockRelation:
    """Estimate the offset from the angular speeds, or take it as zero for one clock; the drift is zero.

    Raises:
        CalibrationError: if no unique offset is found, or the trajectories do not overlap in time.
    """
    offset_ns = 0 if same_clock else find_offset(one, other).offset_ns
    begin = max(int(one.stamps_ns[0]), int(other.stamps_ns[0]) - offset_ns)
    end = min(int(one.stamps_ns[-1]), int(other.stamps_ns[-1]) - offset_ns)
    if end <= begin:
        raise CalibrationError(
            "the trajectories do not overlap in time; if each has a clock of its own, leave out --same-clock"
            if same_clock
            else "the trajectories do not overlap in time: they are not of the same recording"
        )
    return ClockRelation(offset_ns, 0.0, (begin + end) // 2)


class ClockOffset(NamedTuple):
    """The offset between two clocks."""

    offset_ns: int  # add it to a stamp of the first clock to get that of the second one at the same instant
    correlation: float  # correlation of the angular speeds at that offset, at most 1


def find_offset(one: Trajectory, other: Trajectory) -> ClockOffset:
    """Find the offset at which both trajectories' angular speeds agree best.

    Raises:
        CalibrationError: if they are too short, do not rotate, or agree at no offset or at more than one.
    """
    speeds_1, speeds_2 = (_angular_speeds(each) for each in (one, other))
    least = round(_MIN_OVERLAP_S * _RATE_HZ)
    for name, speeds in (("first", speeds_1), ("second", speeds_2)):
        if len(speeds) < least:
            raise CalibrationError(
                f"the {name} trajectory is {len(speeds) / _RATE_HZ:.1f} s long; to find the clocks' offset takes "
                f"{_MIN_OVERLAP_S:g} s or more"
            )
    correlations, lags = _correlations(speeds_1, speeds_2, least)
    overlaps = np.minimum(len(speeds_1), len(speeds_2) - lags) - np.maximum(0, -lags)
    # Fisher transform: a short overlap correlates well by chance.
    likelihood = np.arctanh(np.clip(correlations, -_PERFECT, _PERFECT)) * np.sqrt(overlaps)
    best = int(np.argmax(likelihood))
    elsewhere = np.flatnonzero(np.abs(lags - lags[best]) > _APART_S * _RATE_HZ)
    second = int(elsewhere[np.argmax(likelihood[elsewhere])]) if len(elsewhere) else best
    correlation, rival = float(correlations[best]), float(correlations[second])
    if correlation < _MIN_CORRELATION:
        raise CalibrationError(
            f"no offset between the clocks makes both cameras turn alike (correlation of angular speeds "
            f"{correlation:.2f} at best): are they on one rig, and do the trajectories overlap in time?"
        )
    if second != best and likelihood[second] > _MAX_RIVALRY * likelihood[best]:
        raise CalibrationError(
            f"the clocks' offset is ambiguous: angular speeds correlate by {correlation:.2f} at one and by {rival:.2f} "
            "at another; turn the rig at changing speeds, not evenly"
        )
    start_1, start_2 = (int(each.stamps_ns[0]) for each in (one, other))
    offset_ns = start_2 - start_1 + round((lags[best] + _vertex(correlations, best)) / _RATE_HZ * _NS_PER_S)
    return ClockOffset(offset_ns, correlation)


def _angular_speeds(trajectory: Trajectory) -> Float:
    """Return mean angular speeds (N,), rad/s, at instants 1 / `_RATE_HZ` apart, from half the averaging time on."""
    if trajectory.duration_s <= _OVER_S:
        return np.zeros(0)
    half_ns = round(0.5 * _OVER_S * _NS_PER_S)
    count = int((trajectory.duration_s - _OVER_S) * _RATE_HZ)
    stamps: Int = trajectory.stamps_ns[0] + half_ns + (np.arange(count) * (_NS_PER_S / _RATE_HZ)).astype(np.int64)
    any_gap_s = 2.0 * trajectory.duration_s
    (one, _), (other, _) = (trajectory.at(at, any_gap_s) for at in (stamps - half_ns, stamps + half_ns))
    turned = np.einsum("nji,njk->nik", one.rotations, other.rotations)
    angles = np.array([np.linalg.norm(so3_log(np.ascontiguousarray(turn))) for turn in turned])
    return np.asarray(angles / _OVER_S)


def _correlations(one: Float, other: Float, least: int) -> tuple[Float, Int]:
    """Return correlation coefficients (L,) and lags (L,) of the second series, for ``least`` common samples or more."""
    from scipy.signal import fftconvolve  # takes a second to import, and only trajectories need it

    def summed(a: Float, b: Float) -> Float:
        """Sum a(i) b(i + lag) over the overlap, for lags from 1 - len(a) on."""
        return np.asarray(fftconvolve(b, a[::-1]))

    ones_1, ones_2 = np.ones(len(one)), np.ones(len(other))
    count = np.round(summed(ones_1, ones_2))
    mean_1, mean_2 = summed(one, ones_2) / count, summed(ones_1, other) / count
    covariance = summed(one, other) / count - mean_1 * mean_2
    variance_1 = summed(one**2, ones_2) / count - mean_1**2
    variance_2 = summed(ones_1, other**2) / count - mean_2**2
    lags = np.arange(1 - len(one), len(other))
    enough = count >= least
    spread = np.sqrt(np.maximum(variance_1, 0.0) * np.maximum(variance_2, 0.0))
    correlations = np.divide(covariance, spread, out=np.zeros_like(spread), where=spread > 1e-9)
    return correlations[enough], lags[enough]


def _vertex(values: Float, best: int) -> float:
    """Return the vertex of a parabola through a maximum and its neighbours, in samples from the maximum."""
    if not 0 < best < len(values) - 1:
        return 0.0
    left, top, right = values[best - 1 : best + 2]
    curvature = left - 2.0 * top + right
    return 0.5 * (left - right) / curvature if curvature < 0.0 else 0.0
