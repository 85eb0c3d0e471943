"""What one stereo pair alone tells of its own motion, between any two of its instants, with an honest covariance."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.backend.noise import own_covariance
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log
from graphvio.measurements.motion import RelativeMotion

_LONGEST_NS = 150_000_000  # from one instant to the next, over which a motion is interpolated
_INTERPOLATION_SIGMA = 5e-5  # radians and metres, over 50 ms; a cubic's error grows with the fourth power


class CameraMotions:
    """Motions of a left camera, each measured from an earlier instant.

    Instants form a tree: each hangs on the one that it was measured from, its reference, as vision sees that one. The
    reference as seen differs from the reference itself by the error of its triangulated points, which all motions from
    it share; that error is counted once on the way between two instants, or not at all where both were measured from
    the same reference.

    Args:
        stamps_ns: (N,) instants, with motions that end there or without.
        motions: of body.
        body_T_left: (4, 4).

    Attributes:
        stamps_ns: (N,).
    """

    def __init__(self, stamps_ns: Iterable[int], motions: Iterable[RelativeMotion], body_T_left: Float) -> None:
        self.stamps_ns: Int = np.array(sorted(set(stamps_ns)), dtype=np.int64)
        self._shared: dict[int, Float] = {}  # reference -> covariance (6, 6) of its view, in its own frame
        self._reference: dict[int, int] = {}
        self._edge: dict[int, tuple[Float, Float]] = {}  # instant -> motion from its reference's view, and covariance
        left_T_body = se3_inverse(np.ascontiguousarray(body_T_left))
        to_left = se3_adjoint(left_T_body)
        for motion in motions:
            moved = left_T_body @ motion.reference_T_current @ body_T_left
            covariance = to_left @ motion.covariance @ to_left.T
            if motion.shared_covariance.any():
                shared = to_left @ motion.shared_covariance @ to_left.T
                covariance = own_covariance(covariance, self._seen_from(motion.reference_stamp_ns, moved, shared))
            self._reference[motion.stamp_ns] = motion.reference_stamp_ns
            self._edge[motion.stamp_ns] = moved, covariance

    @property
    def count(self) -> int:
        """How many motions there are."""
        return len(self._edge)

    def between(self, start_ns: int, end_ns: int) -> tuple[Float, Float] | None:
        """The motion (4, 4) from one instant to a later one, and its covariance (6, 6), tangent in the camera's frame
        at the end; None where no motions lead from one to the other.

        An instant between two of the camera's own, such as another pair's that is triggered at other times, is
        interpolated.
        """
        start, end = self._placed(start_ns), self._placed(end_ns)
        if start is None or end is None:
            return None
        told = self._between_own(start.near_ns, end.near_ns)
        if told is None:
            return None
        motion, covariance = told
        if start.near_ns != start_ns:
            covariance = covariance + _carried(start.covariance, se3_inverse(motion) @ start.near_T_instant)
            motion = se3_inverse(start.near_T_instant) @ motion
        if end.near_ns != end_ns:
            covariance = _carried(covariance, se3_inverse(end.near_T_instant)) + end.covariance
            motion = motion @ end.near_T_instant
        return motion, covariance

    def _placed(self, stamp_ns: int) -> _Placed | None:
        """Where the camera is at any instant; None where it tells nothing of it."""
        stamps = self.stamps_ns
        after = int(np.searchsorted(stamps, stamp_ns))
        if after < len(stamps) and stamps[after] == stamp_ns:
            return _Placed(stamp_ns, np.eye(4), np.zeros((6, 6)))
        if not 0 < after < len(stamps) or stamps[after] - stamps[after - 1] > _LONGEST_NS:
            return None
        near_ns, next_ns = int(stamps[after - 1]), int(stamps[after])
        step = self._between_own(near_ns, next_ns)
        if step is None:
            return None
        nodes_s, places = [0.0, (next_ns - near_ns) * 1e-9], [np.zeros(6), se3_log(step[0])]
        for index in (after - 2, after + 1):
            if 0 <= index < len(stamps) and abs(int(stamps[index]) - near_ns) <= 2 * _LONGEST_NS:
                ends = sorted((int(stamps[index]), near_ns))
                further = self._between_own(*ends)
                if further is not None:
                    nodes_s.append((int(stamps[index]) - near_ns) * 1e-9)
                    places.append(se3_log(further[0] if ends[0] == near_ns else se3_inverse(further[0])))
        at_s = (stamp_ns - near_ns) * 1e-9
        share = at_s / nodes_s[1]
        place = se3_exp(np.asarray(_polynomial(nodes_s, places, at_s)))
        return _Placed(
            near_ns, place, share**2 * step[1] + np.eye(6) * (_INTERPOLATION_SIGMA * (nodes_s[1] / 0.05) ** 4) ** 2
        )

    def _between_own(self, start_ns: int, end_ns: int) -> tuple[Float, Float] | None:
        above_start, above_end = self._ancestors(start_ns), self._ancestors(end_ns)
        common = next((stamp for stamp in above_end if stamp in set(above_start)), None)
        if common is None:
            return None
        ups, downs = above_start[: above_start.index(common)], above_end[: above_end.index(common)]
        motion, covariance = np.eye(4), np.zeros((6, 6))
        for i, stamp in enumerate(ups):
            if i:  # from the reference to itself as seen
                covariance = covariance + self._shared_of(stamp)
            covariance = _carried(covariance + self._edge[stamp][1], self._edge[stamp][0])
            motion = motion @ se3_inverse(self._edge[stamp][0])
        if bool(ups) != bool(downs):  # not both were measured from its view: the way begins or ends at itself
            covariance = covariance + self._shared_of(common)
        for i, stamp in enumerate(reversed(downs)):
            edge, own = self._edge[stamp]
            if i:
                covariance = covariance + self._shared_of(self._reference[stamp])
            covariance = _carried(covariance, se3_inverse(edge)) + own
            motion = motion @ edge
        return motion, covariance

    def _seen_from(self, reference_ns: int, moved: Float, shared: Float) -> Float:
        """The covariance of a reference's view, which its first motion tells, in the frame at a motion's end."""
        if reference_ns not in self._shared:
            self._shared[reference_ns] = _carried(shared, moved)
        return _carried(self._shared[reference_ns], se3_inverse(moved))

    def _shared_of(self, reference_ns: int) -> Float:
        return self._shared.get(reference_ns, np.zeros((6, 6)))

    def _ancestors(self, stamp_ns: int) -> list[int]:
        """An instant, what it was measured from, and so on."""
        line = [stamp_ns]
        while line[-1] in self._reference:
            line.append(self._reference[line[-1]])
        return line


class _Placed(NamedTuple):
    """The camera at an instant: its own instant before it, the pose from there, and the covariance (6, 6) of that."""

    near_ns: int
    near_T_instant: Float
    covariance: Float


def _polynomial(nodes: list[float], values: list[Float], at: float) -> Float:
    """Lagrange's polynomial through values at nodes."""
    total = np.zeros_like(values[0])
    for i, value in enumerate(values):
        total += value * np.prod([(at - other) / (nodes[i] - other) for k, other in enumerate(nodes) if k != i])
    return total


def _carried(covariance: Float, start_T_end: Float) -> Float:
    """A covariance (6, 6), tangent in the frame at the end, in the frame at the start."""
    adjoint = se3_adjoint(np.ascontiguousarray(start_T_end))
    return np.asarray(adjoint @ covariance @ adjoint.T)
