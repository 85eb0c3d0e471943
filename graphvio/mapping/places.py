"""Which keyframes are places, and how each lies to the one before it by the odometry's own chain."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log, so3_log
from graphvio.slam.keyframe import Keyframe
from graphvio.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class NewPlace:
    """A keyframe at which the rig looks around.

    Attributes:
        keyframe: of it.
        previous_T_body: (4, 4) from the place before it, or None where a fragment begins.
        covariance: (6, 6) of that, tangent ``[rotation, translation]`` in body here, or None with it.
    """

    keyframe: Keyframe
    previous_T_body: Float | None
    covariance: Float | None


@dataclass(frozen=True, eq=False)
class Anchored:
    """Where a keyframe is.

    Attributes:
        stamp_ns: of it.
        place: how many places were chosen before the one that it is measured from.
        place_T_body: (4, 4) by the odometry's chain; what closures say later moves the place.
    """

    stamp_ns: int
    place: int
    place_T_body: Float


class PlaceChooser:
    """Follows the chain of keyframes, and tells which of them are places.

    Args:
        distance_m: a keyframe so far from the place before it is one,
        angle_deg: or turned by so much.
    """

    def __init__(self, distance_m: float, angle_deg: float) -> None:
        self._distance_m = distance_m
        self._angle_deg = angle_deg
        self._last: Keyframe | None = None
        self._begins = True
        self._count = 0  # of places
        self._motion = np.eye(4)
        self._covariance = np.zeros((6, 6))

    def add(self, keyframe: Keyframe, share: float = 1.0, has_room: bool = True) -> tuple[NewPlace | None, bool]:
        """Take the next keyframe.

        Args:
            keyframe: of increasing ids.
            share: of distance and angle that is enough: less than one where places are wanted densely.
            has_room: whether a place can be taken; if not, the next keyframe can be one.

        Returns:
            The place that it is, or None; and whether it would have been one, had there been room.
        """
        last = self._last
        self._last = keyframe
        if last is None or keyframe.epoch != last.epoch or keyframe.id <= last.id:
            self._begins = True
        elif not self._begins:
            motion, covariance = motion_between(last, keyframe)
            self._motion, self._covariance = composed(self._motion, self._covariance, motion, covariance)
        if not keyframe.images or not (self._begins or self._is_far(share)):
            return None, False
        if not has_room:
            return None, True
        place = NewPlace(keyframe, None, None)
        if not self._begins:
            place = NewPlace(keyframe, self._motion, self._covariance)
        self._begins, self._count = False, self._count + 1
        self._motion, self._covariance = np.eye(4), np.zeros((6, 6))
        return place, True

    def anchored(self) -> Anchored | None:
        """Where the newest keyframe is; None as long as its fragment has no place."""
        if self._last is None or self._begins:
            return None
        return Anchored(self._last.stamp_ns, self._count - 1, self._motion)

    def _is_far(self, share: float) -> bool:
        angle_deg = np.rad2deg(np.linalg.norm(so3_log(np.ascontiguousarray(self._motion[:3, :3]))))
        distance_m = np.linalg.norm(self._motion[:3, 3])
        return bool(distance_m >= share * self._distance_m or angle_deg >= share * self._angle_deg)


def motion_between(last: Keyframe, keyframe: Keyframe) -> tuple[Float, Float]:
    """``last_T_body`` (4, 4) of two keyframes of an epoch, and its covariance (6, 6), in body at the second.

    Where keyframes between them are lost, or the odometry does not tell, the poses in the epoch's frame do. Their
    errors are then taken for independent: those that are in common make the motion only better than that.
    """
    motion = se3_inverse(last.odom_T_body) @ keyframe.odom_T_body
    covariance = keyframe.relative_covariance
    if keyframe.previous_id == last.id and keyframe.previous_T_body is not None:
        motion = keyframe.previous_T_body
        if covariance is not None:
            return motion, covariance
    return composed(motion, last.covariance, np.eye(4), keyframe.covariance, begins=True)


def composed(
    a_T_b: Float, a_covariance: Float, b_T_c: Float, b_covariance: Float, begins: bool = False
) -> tuple[Float, Float]:
    """``a_T_c`` and its covariance (6, 6) in c, of two motions whose errors are independent.

    Args:
        a_T_b: (4, 4).
        a_covariance: (6, 6) of it, in b; with ``begins`` of a pose of a, in a.
        b_T_c: (4, 4).
        b_covariance: (6, 6) of it, in c.
        begins: whether the first covariance is of the motion's beginning.
    """
    adjoint = se3_adjoint(se3_inverse(a_T_b if begins else b_T_c))
    return a_T_b @ b_T_c, adjoint @ a_covariance @ adjoint.T + b_covariance


def spread_keyframes(
    keyframes: Sequence[Anchored], poses: Sequence[Float | None], motions: Sequence[Float], begins: Collection[int]
) -> Trajectory:
    """The odometry's chain from place to place is kept, and what it differs by at the next place shared out by time.

    Args:
        keyframes: in the order of time.
        poses: (4, 4) of the places, as far as they are worked on; None of those that are not in the map.
        motions: (4, 4) by the odometry from the place before to each place.
        begins: places that have none before.
    """
    stamp_of: dict[int, int] = {}
    for each in keyframes:
        stamp_of.setdefault(each.place, each.stamp_ns)
    errors: dict[int, Float] = {}
    stamps: list[int] = []
    made: list[Float] = []
    for each in keyframes:
        k = each.place
        pose = poses[k] if k < len(poses) else None
        if pose is None or (stamps and each.stamp_ns <= stamps[-1]):
            continue
        after = poses[k + 1] if k + 1 < len(poses) and k + 1 not in begins else None
        share = np.zeros(6)
        if after is not None:
            if k not in errors:
                errors[k] = se3_log(se3_inverse(motions[k + 1]) @ se3_inverse(pose) @ after)
            share = errors[k] * (each.stamp_ns - stamp_of[k]) / (stamp_of[k + 1] - stamp_of[k])
        stamps.append(each.stamp_ns)
        made.append(pose @ each.place_T_body @ se3_exp(share))
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(made).reshape(-1, 4, 4))
