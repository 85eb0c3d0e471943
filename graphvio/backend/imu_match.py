"""A test whether an IMU moves as the cameras do, from rotations and accelerations over some seconds of vision.

The mean difference between the angular rates is the gyro's bias, so that only changes of the rates can show an
agreement. The specific forces minus the cameras' accelerations must be gravity: one constant vector of known norm in a
fixed frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.backend.inertial import MeanReadings
from graphvio.geometry import so3_log
from graphvio.measurements.sensors import GRAVITY_M_S2

_MIN_STEPS = 20
_MIN_COVERED_S = 2.0
_SHIFT_STEP_S = 0.005
_COARSE = 4  # multiple of that step by which all shifts are compared first
_LOBE_S = 0.1  # shifts closer to each other than this belong to the same minimum
_DISTINCT = 2.0  # multiple of the least difference that all other shifts must reach
_MIN_CHANGE_RAD_S = 0.1  # RMS of the rates about their mean: with less, one shift fits as well as another
_RATE_NOISE_RAD_S = 0.02
_AVERAGED_S = 0.2  # moving average over this time, applied twice
_FORCE_NOISE_M_S2 = 0.5  # noise and bias of the specific force
_ERROR_SHARE = 0.1  # relative to the readings' change: errors of the calibration, and of means over a step
_MAX_GRAVITY_ERROR_M_S2 = 1.0


class VisualStep(NamedTuple):
    """A motion between two successive framesets, measured by vision."""

    begin_ns: int
    end_ns: int
    begin_T_end: Float  # (4, 4) motion of body


class RateMatch(NamedTuple):
    """The time shift and bias with which a gyro turns as the cameras do.

    Attributes:
        shift_s: Seconds by which the gyro's stamps are late.
        gyro_bias: (3,) rad/s.
        difference: RMS difference of the rates at this shift, as a share of what errors of gyro and vision explain.
    """

    shift_s: float
    gyro_bias: Float
    difference: float


class ImuMatch(NamedTuple):
    """The time shift, bias and gravity with which an IMU moves as the cameras do.

    Attributes:
        shift_s: Seconds by which the IMU's stamps are late.
        gyro_bias: (3,) rad/s.
        gravity_body: (3,) gravity in body at the end of the last step, m/s^2.
    """

    shift_s: float
    gyro_bias: Float
    gravity_body: Float


def match_imu(steps: Sequence[VisualStep], readings: MeanReadings, max_shift_s: float) -> ImuMatch | None:
    """Find the only shift of the IMU's stamps at which the IMU moves as the cameras do.

    Args:
        steps: The motions by vision, each beginning where the previous one ends.
        readings: The IMU's readings, with stamps of the framesets' clock.
        max_shift_s: Largest shift that is tried in either direction.

    Returns:
        The match, or None where there is no such shift, where vision and IMU have less than 2 s in common at it, or
        where the rig does not turn.
    """
    found = match_rates(steps, readings, max_shift_s)
    if found is None:
        return None
    gravity_body = _gravity(steps, readings, round(found.shift_s * 1e9))
    return None if gravity_body is None else ImuMatch(found.shift_s, found.gyro_bias, gravity_body)


def match_rates(steps: Sequence[VisualStep], readings: MeanReadings, max_shift_s: float) -> RateMatch | None:
    """Find the only shift of the gyro's stamps at which the gyro turns as the cameras do; see `match_imu`.

    The steps may overlap or leave gaps, and their translations are not used.
    """
    if not steps:
        return None
    count = round(max_shift_s / (_COARSE * _SHIFT_STEP_S))
    coarse = _COARSE * np.arange(-count, count + 1, dtype=np.float64)
    over_all = _compared(steps, readings, _SHIFT_STEP_S * coarse).differences
    near = coarse[np.argmin(over_all)] + np.arange(-_COARSE, _COARSE + 1, dtype=np.float64)
    compared = _compared(steps, readings, _SHIFT_STEP_S * near)
    differences = compared.differences
    best = int(np.argmin(differences))
    least = float(differences[best])
    # The least difference at an end of the shifts, or where the samples end, need not be a minimum.
    if not 0 < best < 2 * _COARSE or not np.isfinite(differences[best - 1 : best + 2]).all():
        return None
    if not compared.is_alike(best):
        return None
    others: Bool = np.abs(coarse - near[best]) * _SHIFT_STEP_S > _LOBE_S
    if (over_all[others] < _DISTINCT * max(least, _RATE_NOISE_RAD_S)).any():
        return None
    shift_s = _SHIFT_STEP_S * float(near[best]) + _beyond(differences[best - 1 : best + 2])
    gyro_bias = compared.errors[best][compared.is_known[best]].mean(axis=0)
    return RateMatch(shift_s, gyro_bias, least / compared.tolerance(best))


def turn_disagreement(steps: Sequence[VisualStep], readings: MeanReadings) -> float | None:
    """Return the difference of the gyro's and cameras' rates without a shift, relative to what errors of both explain.

    It is the median over the steps (at least one), so that a few that vision measured wrongly have no influence. None
    where the IMU does not cover the steps, or the rig hardly turns.
    """
    begins_ns, ends_ns, rates = _rates(steps)
    errors = readings.between(begins_ns, ends_ns)[:, :3] - rates
    change = _spread(rates)
    if np.isnan(errors).any() or change < _MIN_CHANGE_RAD_S:
        return None
    apart = np.linalg.norm(errors - np.median(errors, axis=0), axis=1)
    return float(np.median(apart)) / (_RATE_NOISE_RAD_S + _ERROR_SHARE * change)


class _Compared(NamedTuple):
    """Angular rates of N steps by vision and by the gyro, at S shifts of its stamps."""

    errors: Float  # (S, N, 3) rates of the gyro minus those of vision, rad/s
    is_known: Bool  # (S, N) whether the IMU covers the step
    differences: Float  # (S,) RMS of the errors about their mean, rad/s; infinite where too few are known
    changes: Float  # (S,) RMS of vision's rates about their mean, rad/s

    def tolerance(self, at: int) -> float:
        """Return the largest difference at a shift that errors of vision and gyro explain, rad/s."""
        return _RATE_NOISE_RAD_S + _ERROR_SHARE * float(self.changes[at])

    def is_alike(self, at: int) -> bool:
        """Whether, at a shift, vision's rates change and the gyro's rates change with them."""
        return bool(self.changes[at] >= _MIN_CHANGE_RAD_S and self.differences[at] <= self.tolerance(at))


def _compared(steps: Sequence[VisualStep], readings: MeanReadings, shifts: Float) -> _Compared:
    """Compare the rates of vision and gyro at shifts (S,), seconds."""
    begins_ns, ends_ns, rates = _rates(steps)
    shifts_ns = np.rint(shifts * 1e9).astype(np.int64)[:, None]
    by_gyro = readings.between((begins_ns + shifts_ns).ravel(), (ends_ns + shifts_ns).ravel())[:, :3]
    errors = by_gyro.reshape(len(shifts), len(steps), 3) - rates
    is_known = np.asarray(np.isfinite(errors).all(axis=2))
    covered_s = is_known @ ((ends_ns - begins_ns) * 1e-9)
    is_enough = (is_known.sum(axis=1) >= _MIN_STEPS) & (covered_s >= _MIN_COVERED_S)
    differences = np.where(is_enough, _spreads(errors, is_known), np.inf)
    return _Compared(errors, is_known, differences, _spreads(np.broadcast_to(rates, errors.shape), is_known))


def _rates(steps: Sequence[VisualStep]) -> tuple[Int, Int, Float]:
    """Return the stamps (N,) at which steps begin, those at which they end, and their angular rates (N, 3), rad/s."""
    begins_ns, ends_ns = (np.array([each[at] for each in steps], dtype=np.int64) for at in (0, 1))
    turns = np.array([so3_log(np.ascontiguousarray(each.begin_T_end[:3, :3])) for each in steps]).reshape(-1, 3)
    return begins_ns, ends_ns, turns / ((ends_ns - begins_ns) * 1e-9)[:, None]


def _gravity(steps: Sequence[VisualStep], readings: MeanReadings, shift_ns: int) -> Float | None:
    """Return gravity (3,) in body at the end of the steps from specific forces at a shift, or None where none fits."""
    first_R_end, against_gravity, accelerations = np.eye(3), [], []
    middles_ns = np.array([(each.begin_ns + each.end_ns) // 2 for each in steps])
    forces = readings.between(middles_ns[:-1] + shift_ns, middles_ns[1:] + shift_ns)[:, 3:]
    for one, other, force in zip(steps[:-1], steps[1:], forces, strict=True):
        first_R_end = first_R_end @ one.begin_T_end[:3, :3]
        before, after = (each.begin_T_end[:3, 3] / ((each.end_ns - each.begin_ns) * 1e-9) for each in (one, other))
        between_s = 0.5e-9 * (other.end_ns - one.begin_ns)
        acceleration = (after - one.begin_T_end[:3, :3].T @ before) / between_s  # in body between the two steps
        if not np.isnan(force).any():
            against_gravity.append(first_R_end @ (force - acceleration))
            accelerations.append(acceleration)
    if len(against_gravity) < _MIN_STEPS:
        return None
    # Second differences of the framesets' positions are mostly noise; their means over some tenths of a second are not.
    count = max(round(_AVERAGED_S * 1e9 / float(np.median(np.diff(middles_ns)))), 1)
    mean, change = np.mean(against_gravity, axis=0), _spread(_averaged(np.array(accelerations), count))
    if abs(np.linalg.norm(mean) - GRAVITY_M_S2) > _MAX_GRAVITY_ERROR_M_S2:
        return None
    if _spread(_averaged(np.array(against_gravity), count)) > _FORCE_NOISE_M_S2 + _ERROR_SHARE * change:
        return None
    first_R_end = first_R_end @ steps[-1].begin_T_end[:3, :3]
    return np.asarray(-GRAVITY_M_S2 * (first_R_end.T @ mean) / np.linalg.norm(mean))


def _averaged(vectors: Float, count: int) -> Float:
    """Return the moving average over ``count`` of the vectors (N, 3), applied twice (M, 3)."""
    for _ in range(2):
        vectors = np.lib.stride_tricks.sliding_window_view(vectors, min(count, len(vectors)), axis=0).mean(axis=-1)
    return vectors


def _spread(vectors: Float) -> float:
    """Return the RMS of vectors (N, 3) about their mean."""
    return float(_spreads(vectors[None], np.ones((1, len(vectors)), dtype=bool))[0])


def _spreads(vectors: Float, is_known: Bool) -> Float:
    """Return, for each of S sets of vectors (S, N, 3), the RMS of the known ones (S, N) about their mean."""
    count = np.maximum(is_known.sum(axis=1), 1)
    means = np.where(is_known[..., None], vectors, 0.0).sum(axis=1) / count[:, None]
    squares = ((vectors - means[:, None]) ** 2).sum(axis=2)
    return np.asarray(np.sqrt(np.where(is_known, squares, 0.0).sum(axis=1) / count))


def _beyond(differences: Float) -> float:
    """Return the distance from the middle of three shifts to the minimum of the parabola through the squares, s."""
    before, at, after = np.square(differences)
    curvature = before - 2.0 * at + after
    return float(0.5 * _SHIFT_STEP_S * (before - after) / curvature) if 0.0 < curvature < np.inf else 0.0
