"""Motion of body while rolling shutters read images out, computed from the motions that the images measure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Float
from graphvio.frontend.tracking.rolling_shutter import ReadoutMotion
from graphvio.geometry import se3_inverse, so3_log

_MIN_READOUTS_BETWEEN = 2.0  # framesets, in readout times: nearer ones amplify errors of the velocity step by step
_LONGEST_NS = 500_000_000
_SIGMA_M_S = 0.05  # of a velocity by an IMU's acceleration
# Without an IMU, smallest standard deviations of angular (rad/s^2, rad/s^3) and linear (m/s^2, m/s^3) changes.
_ACCELERATION_SIGMAS = np.array([1.0, 3.0])
_JERK_SIGMAS = np.array([10.0, 30.0])


@dataclass(frozen=True, eq=False)
class _Frameset:
    """A frameset of the chain.

    Attributes:
        origin_T_body: (4, 4) pose of body relative to the chain's first frameset.
        by_imu: readout motion that an IMU measures, or None.
        accelerations: angular and linear acceleration (6,), or None where an IMU measures them, or before there is a
            frameset on both sides.
    """

    origin_T_body: Float
    by_imu: ReadoutMotion | None
    accelerations: Float | None = None


class MeasuredReadouts:
    """Chain of measured motions, from which the velocities at its framesets are computed.

    A velocity that the state estimator predicts depends on motions that were measured with earlier velocities. If these
    were wrong, it makes the next motion wrong, too, and the IMU and vision contradict each other more and more. A
    velocity that is computed from the measured poses is corrected together with them.

    Args:
        readout_ns: longest readout time of the rig's cameras.
    """

    def __init__(self, readout_ns: int) -> None:
        self._shortest_ns = round(_MIN_READOUTS_BETWEEN * readout_ns)
        self._framesets: dict[int, _Frameset] = {}  # in time order

    def note(
        self,
        reference_ns: int,
        stamp_ns: int,
        reference_T_body: Float,
        by_imu: tuple[ReadoutMotion | None, ReadoutMotion | None],
    ) -> None:
        """Add a measured motion, or replace it after it has been measured again.

        Args:
            reference_ns: stamp of the frameset that it is measured from.
            stamp_ns: stamp of the newest frameset.
            reference_T_body: (4, 4) pose of body at the newest frameset, in body at the reference.
            by_imu: readout motions that an IMU measured at the newest frameset and at the reference, or None.
        """
        if reference_ns not in self._framesets:
            self._framesets = {reference_ns: _Frameset(np.eye(4), by_imu[1])}
        origin_T_body = self._framesets[reference_ns].origin_T_body @ reference_T_body
        self._framesets[stamp_ns] = _Frameset(origin_T_body, by_imu[0])
        near_ns = self._shortest_ns + _LONGEST_NS
        self._framesets = {
            ns: each for ns, each in self._framesets.items() if min(stamp_ns - ns, abs(reference_ns - ns)) <= near_ns
        }
        for middle_ns in self._next_to(stamp_ns):
            middle, others = self._framesets[middle_ns], self._next_to(middle_ns)
            if middle.by_imu is None and len(others) == 2:
                accelerations = self._rates(middle_ns, others)[1]
                self._framesets[middle_ns] = replace(middle, accelerations=accelerations)

    def knows_both_sides_of(self, stamp_ns: int) -> bool:
        """Return whether the readout motion at a frameset is computed from framesets before and after it."""
        return stamp_ns in self._framesets and len(self._next_to(stamp_ns)) == 2

    def at(self, stamp_ns: int) -> ReadoutMotion | None:
        """Return the readout motion at a frameset, computed from one before and one after it, or from one of them.

        With an IMU, its acceleration converts the mean velocity between two framesets into the velocity at this one.
        Without an IMU, the motion from this frameset is a quadratic function of time if there are two others, and a
        linear one if there is one. Its errors are those that accelerations cause, or changes of accelerations; these
        are taken to be as large as the framesets show, and not below those of a walk.

        Returns:
            The motion, or None if the frameset is unknown or there is no other one near it.
        """
        here, others = self._framesets.get(stamp_ns), self._next_to(stamp_ns)
        if here is None or not others:
            return None
        seconds = 1e-9 * (np.array(others) - stamp_ns)
        if here.by_imu is None:
            rates = self._rates(stamp_ns, others)
            if len(others) == 2:
                sigmas = _JERK_SIGMAS * abs(seconds[0] * seconds[1]) / 6.0
            else:
                sigmas = _ACCELERATION_SIGMAS * abs(seconds[0]) / 2.0
            sigmas = sigmas * self._unsteadiness()
            return ReadoutMotion(
                rates[0, :3],
                rates[0, 3:],
                rates[1, :3],
                rates[1, 3:],
                velocity_covariance=sigmas[1] ** 2 * np.eye(3),
                angular_velocity_sigma=float(sigmas[0]),
            )
        ways = np.array([_way(self._between(stamp_ns, ns)) for ns in others])
        accelerations = np.array([self._acceleration(ns, stamp_ns) for ns in others])
        gained = seconds[:, None] * (here.by_imu.acceleration / 3.0 + accelerations / 6.0)
        velocities = ways[:, 3:] / seconds[:, None] - gained
        return replace(here.by_imu, velocity=velocities.mean(axis=0), velocity_covariance=_SIGMA_M_S**2 * np.eye(3))

    def _next_to(self, stamp_ns: int) -> list[int]:
        """Return the stamps of the nearest frameset before and after a stamp, neither too near nor too far, if any."""
        before = [ns for ns in self._framesets if self._shortest_ns <= stamp_ns - ns < _LONGEST_NS][-1:]
        after = [ns for ns in self._framesets if self._shortest_ns <= ns - stamp_ns < _LONGEST_NS][:1]
        return before + after

    def _rates(self, stamp_ns: int, others: list[int]) -> Float:
        """Return velocities and accelerations (2, 6), angular and linear, by the poses at one or two other stamps."""
        seconds, powers = 1e-9 * (np.array(others) - stamp_ns), np.arange(1, len(others) + 1)
        ways = np.array([_way(self._between(stamp_ns, ns)) for ns in others])
        rates = np.zeros((2, 6))
        rates[: len(others)] = np.linalg.solve(seconds[:, None] ** powers / powers, ways)
        return rates

    def _unsteadiness(self) -> Float:
        """Return by how much the angular and the linear accelerations (2,) exceed those of a walk, at least 1."""
        shown = [each.accelerations for each in self._framesets.values() if each.accelerations is not None]
        if not shown:
            return np.ones(2)
        rms = np.sqrt(np.mean(np.square(shown).reshape(-1, 2, 3), axis=(0, 2)))
        return np.asarray(np.maximum(rms / _ACCELERATION_SIGMAS, 1.0))

    def _between(self, here_ns: int, there_ns: int) -> Float:
        here, there = self._framesets[here_ns], self._framesets[there_ns]
        return np.asarray(se3_inverse(here.origin_T_body) @ there.origin_T_body)

    def _acceleration(self, there_ns: int, here_ns: int) -> Float:
        """Return the acceleration (3,) at ``there_ns``, in body at ``here_ns``; if unknown, that at ``here_ns``."""
        by_imu = self._framesets[there_ns].by_imu
        if by_imu is None:
            by_imu = self._framesets[here_ns].by_imu
            assert by_imu is not None
            return by_imu.acceleration
        return np.asarray(self._between(here_ns, there_ns)[:3, :3] @ by_imu.acceleration)


def _way(body_T_other: Float) -> Float:
    """Return a motion as rotation vector and translation (6,)."""
    return np.concatenate([so3_log(np.ascontiguousarray(body_T_other[:3, :3])), body_T_other[:3, 3]])
