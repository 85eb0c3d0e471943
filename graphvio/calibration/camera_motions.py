"""Motions of each stereo pair by its own visual odometry, between any two instants, with covariance (section 4)."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.backend.noise import own_covariance
from graphvio.config import Config
from graphvio.frontend.tracking.steady_motion import SteadyMotion
from graphvio.frontend.visual import VisualFrontend
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log
from graphvio.measurements.motion import Quality, RelativeMotion
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Rig

_MAX_GAP_NS = 150_000_000  # longest time between two instants over which a motion is interpolated
_INTERPOLATION_SIGMA = 5e-5  # radians and metres, over 50 ms; a cubic's error grows with the fourth power


class CameraMotions:
    """Motions of a left camera, each measured from an earlier instant.

    Instants form a tree: the parent of each is its reference, as vision sees that one. The reference as seen differs
    from the reference itself by the error of its triangulated points, which all motions from it share; that error is
    counted once on the path between two instants, or not at all where both were measured from the same reference.

    Args:
        stamps_ns: stamps of N instants, with or without motions that end there.
        motions: motions of body.
        body_T_left: (4, 4) pose of the left camera in body.

    Attributes:
        stamps_ns: (N,) stamps of the instants, in order.
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
                covariance = own_covariance(covariance, self._view_covariance(motion.reference_stamp_ns, moved, shared))
            self._reference[motion.stamp_ns] = motion.reference_stamp_ns
            self._edge[motion.stamp_ns] = moved, covariance

    @property
    def count(self) -> int:
        """Number of measured motions."""
        return len(self._edge)

    def between(self, start_ns: int, end_ns: int) -> tuple[Float, Float] | None:
        """Chain motions from one instant to a later one; None where none connect the two.

        The covariance (6, 6) of the motion (4, 4) has the tangent in the camera's frame at the end.

        An instant between two of the camera's own, such as that of a pair that is triggered at other times, is
        interpolated.
        """
        start, end = self._placed(start_ns), self._placed(end_ns)
        if start is None or end is None:
            return None
        measured = self._between_own(start.near_ns, end.near_ns)
        if measured is None:
            return None
        motion, covariance = measured
        if start.near_ns != start_ns:
            covariance = covariance + _carried(start.covariance, se3_inverse(motion) @ start.near_T_instant)
            motion = se3_inverse(start.near_T_instant) @ motion
        if end.near_ns != end_ns:
            covariance = _carried(covariance, se3_inverse(end.near_T_instant)) + end.covariance
            motion = motion @ end.near_T_instant
        return motion, covariance

    def _placed(self, stamp_ns: int) -> _Placed | None:
        """Interpolate the camera's pose at any instant; None where its motion around that is unknown."""
        stamps = self.stamps_ns
        after = int(np.searchsorted(stamps, stamp_ns))
        if after < len(stamps) and stamps[after] == stamp_ns:
            return _Placed(stamp_ns, np.eye(4), np.zeros((6, 6)))
        if not 0 < after < len(stamps) or stamps[after] - stamps[after - 1] > _MAX_GAP_NS:
            return None
        near_ns, next_ns = int(stamps[after - 1]), int(stamps[after])
        step = self._between_own(near_ns, next_ns)
        if step is None:
            return None
        nodes_s, places = [0.0, (next_ns - near_ns) * 1e-9], [np.zeros(6), se3_log(step[0])]
        for index in (after - 2, after + 1):
            if 0 <= index < len(stamps) and abs(int(stamps[index]) - near_ns) <= 2 * _MAX_GAP_NS:
                ends = sorted((int(stamps[index]), near_ns))
                step_to = self._between_own(*ends)
                if step_to is not None:
                    nodes_s.append((int(stamps[index]) - near_ns) * 1e-9)
                    places.append(se3_log(step_to[0] if ends[0] == near_ns else se3_inverse(step_to[0])))
        at_s = (stamp_ns - near_ns) * 1e-9
        share = at_s / nodes_s[1]
        place = se3_exp(np.asarray(_polynomial(nodes_s, places, at_s)))
        return _Placed(
            near_ns, place, share**2 * step[1] + np.eye(6) * (_INTERPOLATION_SIGMA * (nodes_s[1] / 0.05) ** 4) ** 2
        )

    def _between_own(self, start_ns: int, end_ns: int) -> tuple[Float, Float] | None:
        ups: list[int] = []
        downs: list[int] = []
        up, down = start_ns, end_ns
        while up != down:  # a reference is earlier than motions from it: step back from the later of both
            path, later = (ups, up) if up > down else (downs, down)
            if later not in self._reference:
                return None
            path.append(later)
            if up > down:
                up = self._reference[later]
            else:
                down = self._reference[later]
        common = up
        motion, covariance = np.eye(4), np.zeros((6, 6))
        for i, stamp in enumerate(ups):
            if i:  # from the reference to the reference as seen
                covariance = covariance + self._shared_of(stamp)
            covariance = _carried(covariance + self._edge[stamp][1], self._edge[stamp][0])
            motion = motion @ se3_inverse(self._edge[stamp][0])
        if bool(ups) != bool(downs):  # the path begins or ends at the common reference itself
            covariance = covariance + self._shared_of(common)
        for i, stamp in enumerate(reversed(downs)):
            edge, own = self._edge[stamp]
            if i:
                covariance = covariance + self._shared_of(self._reference[stamp])
            covariance = _carried(covariance, se3_inverse(edge)) + own
            motion = motion @ edge
        return motion, covariance

    def _view_covariance(self, reference_ns: int, moved: Float, shared: Float) -> Float:
        """Return the covariance of a reference's view, given by its first motion, in the frame at a motion's end."""
        if reference_ns not in self._shared:
            self._shared[reference_ns] = _carried(shared, moved)
        return _carried(self._shared[reference_ns], se3_inverse(moved))

    def _shared_of(self, reference_ns: int) -> Float:
        return self._shared.get(reference_ns, np.zeros((6, 6)))


class _Placed(NamedTuple):
    """An interpolated pose: the camera's own instant before it, the pose relative to that, and covariance (6, 6)."""

    near_ns: int
    near_T_instant: Float
    covariance: Float


def _polynomial(nodes: list[float], values: list[Float], at: float) -> Float:
    """Evaluate the Lagrange polynomial through values at nodes."""
    total = np.zeros_like(values[0])
    for i, value in enumerate(values):
        total += value * np.prod([(at - other) / (nodes[i] - other) for k, other in enumerate(nodes) if k != i])
    return total


def _carried(covariance: Float, start_T_end: Float) -> Float:
    """Transport a covariance (6, 6) from the tangent in the frame at the end to that at the start."""
    adjoint = se3_adjoint(np.ascontiguousarray(start_T_end))
    return np.asarray(adjoint @ covariance @ adjoint.T)


class SeparateMotions:
    """Visual odometry of every pair of a rig by itself, independent of the poses of the pairs in the rig file."""

    def __init__(self, rig: Rig, config: Config) -> None:
        self._rig = rig
        self._pairs = [_PairOdometry(rig.with_pairs([j]).without_imu(), config) for j in range(len(rig.pairs))]
        self._workers = ThreadPoolExecutor(len(rig.pairs), thread_name_prefix="graphvio-calibration")

    def add(self, frameset: FrameSet) -> None:
        """Process the next frameset, all pairs in parallel."""
        list(self._workers.map(lambda j: self._pairs[j].add(j, frameset), sorted(frameset.stereo)))

    def motions(self) -> list[CameraMotions]:
        """Return the motions of each pair's left camera up to now."""
        pairs = zip(self._pairs, self._rig.pairs, strict=True)
        return [CameraMotions(each.stamps_ns, each.motions, pair.left.body_T_cam) for each, pair in pairs]

    def close(self) -> None:
        """Stop all threads."""
        for each in self._pairs:
            each.frontend.close()
        self._workers.shutdown()


class _PairOdometry:
    def __init__(self, rig: Rig, config: Config) -> None:
        self.frontend = VisualFrontend(rig, config)
        self.stamps_ns: list[int] = []
        self.motions: list[RelativeMotion] = []
        self._steady = SteadyMotion()

    def add(self, number: int, frameset: FrameSet) -> None:
        masks = {0: frameset.masks[number]} if number in frameset.masks else {}
        alone = FrameSet(frameset.stamp_ns, {0: frameset.images[number]}, masks)
        self._steady.begin(alone.stamp_ns)
        result = self.frontend.process(alone, self._steady.predict)
        motion = result.motion if result.quality is Quality.GOOD else None
        self._steady.end(motion)
        self.stamps_ns.append(alone.stamp_ns)
        if motion is not None:
            self.motions.append(motion)
