"""How body moves while rolling shutters read images out, by the motion that the images themselves measure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Float
from graphvio.frontend.tracking.rolling_shutter import ReadoutMotion
from graphvio.geometry import se3_inverse, so3_log

_MIN_READOUTS_BETWEEN = 2.0  # framesets, or errors of one's velocity make larger ones of the next
_LONGEST_NS = 500_000_000
_SIGMA_M_S = 0.05  # of a velocity by framesets before and after, or with an IMU's acceleration
_ACCELERATION_SIGMA = 3.0  # m/s^2


@dataclass(frozen=True, eq=False)
class _Frameset:
    """Pose of body in the chain's first frameset, and the readout's motion by the IMU, if one measures it."""

    origin_T_body: Float
    by_imu: ReadoutMotion | None


class MeasuredReadouts:
    """Chain of measured motions, which shows the velocities at its framesets.

    A velocity that the state predicts depends on the motions that were measured with earlier ones: where these were
    wrong, it makes the next one wrong, and the IMU and vision contradict each other more and more. That of the measured
    poses is corrected with them.

    Args:
        readout_ns: the longest of the rig.
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
        """Note a motion, or that it is measured again.

        Args:
            reference_ns: stamp of the frameset that it is measured from.
            stamp_ns: stamp of the newest frameset.
            reference_T_body: (4, 4) pose of body at the newest frameset.
            by_imu: turn and acceleration by an IMU at the newest frameset and at the reference, or None.
        """
        if reference_ns not in self._framesets:
            self._framesets = {reference_ns: _Frameset(np.eye(4), by_imu[1])}
        origin_T_body = self._framesets[reference_ns].origin_T_body @ reference_T_body
        self._framesets[stamp_ns] = _Frameset(origin_T_body, by_imu[0])
        near_ns = self._shortest_ns + _LONGEST_NS
        self._framesets = {
            ns: each for ns, each in self._framesets.items() if min(stamp_ns - ns, abs(reference_ns - ns)) <= near_ns
        }

    def at(self, stamp_ns: int) -> ReadoutMotion | None:
        """Return the motion at a frameset, by one before and one after it, or by one of them; None if there is none.

        By an IMU's acceleration, the mean velocity between framesets becomes that at one of them. Without it, the way
        from the frameset is a quadratic function of time between two others, and a linear one to a single other.
        """
        here, others = self._framesets.get(stamp_ns), self._next_to(stamp_ns)
        if here is None or not others:
            return None
        seconds = 1e-9 * (np.array(others) - stamp_ns)
        ways = np.array([_way(self._between(stamp_ns, ns)) for ns in others])
        if here.by_imu is None:
            rates = np.zeros((2, 6))
            rates[: len(others)] = np.linalg.solve(seconds[:, None] ** np.arange(1, len(others) + 1), ways)
            sigma = _SIGMA_M_S if len(others) > 1 else 0.5 * _ACCELERATION_SIGMA * abs(seconds[0])
            return ReadoutMotion(
                rates[0, :3],
                rates[0, 3:],
                2.0 * rates[1, :3],
                2.0 * rates[1, 3:],
                velocity_covariance=sigma**2 * np.eye(3),
            )
        accelerations = np.array([self._acceleration(ns, stamp_ns) for ns in others])
        gained = seconds[:, None] * (here.by_imu.acceleration / 3.0 + accelerations / 6.0)
        velocities = ways[:, 3:] / seconds[:, None] - gained
        return replace(here.by_imu, velocity=velocities.mean(axis=0), velocity_covariance=_SIGMA_M_S**2 * np.eye(3))

    def _next_to(self, stamp_ns: int) -> list[int]:
        """Return the stamps of the next frameset before and after one that are not too near, if there are any."""
        before = [ns for ns in self._framesets if self._shortest_ns <= stamp_ns - ns < _LONGEST_NS][-1:]
        after = [ns for ns in self._framesets if self._shortest_ns <= ns - stamp_ns < _LONGEST_NS][:1]
        return before + after

    def _between(self, here_ns: int, there_ns: int) -> Float:
        here, there = self._framesets[here_ns], self._framesets[there_ns]
        return np.asarray(se3_inverse(here.origin_T_body) @ there.origin_T_body)

    def _acceleration(self, there_ns: int, here_ns: int) -> Float:
        """Return the acceleration (3,) at one frameset, in body at another; that of the other if it is not known."""
        by_imu = self._framesets[there_ns].by_imu
        if by_imu is None:
            by_imu = self._framesets[here_ns].by_imu
            assert by_imu is not None
            return by_imu.acceleration
        return np.asarray(self._between(here_ns, there_ns)[:3, :3] @ by_imu.acceleration)


def _way(body_T_other: Float) -> Float:
    """Return a motion as rotation vector and translation (6,)."""
    return np.concatenate([so3_log(np.ascontiguousarray(body_T_other[:3, :3])), body_T_other[:3, 3]])
