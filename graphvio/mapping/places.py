"""Selection of places among the keyframes, and the keyframes' poses relative to them."""

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
    """A keyframe that was selected as a place."""

    keyframe: Keyframe  # the keyframe
    previous_T_body: Float | None  # (4, 4) motion from the previous place, or None for the first place of a fragment
    # (6, 6) of the motion, tangent ``[rotation, translation]`` in body at this place, or None with it
    covariance: Float | None


@dataclass(frozen=True, eq=False)
class KeyframeAtPlace:
    """A keyframe's pose relative to the last place before it."""

    stamp_ns: int  # stamp of the keyframe
    place: int  # index of the place
    place_T_body: Float  # (4, 4) from the odometry; closures move only the place


class PlaceChooser:
    """Selects places in a chain of keyframes, at a minimal distance or rotation from the previous place."""

    def __init__(self, distance_m: float, angle_deg: float) -> None:
        self._distance_m = distance_m
        self._angle_deg = angle_deg
        self._last: Keyframe | None = None
        self._begins = True
        self._count = 0  # number of places
        self._motion = np.eye(4)
        self._covariance = np.zeros((6, 6))

    def add(self, keyframe: Keyframe, share: float = 1.0, has_room: bool = True) -> tuple[NewPlace | None, bool]:
        """Add the next keyframe; returns the place, if it becomes one, and whether it qualifies, regardless of room.

        Args:
            keyframe: The keyframe; ids increase.
            share: Share of the configured distance or angle that suffices: less than one for denser places.
            has_room: Whether a place can be queued; if not, the next keyframe can become one.
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

    def newest(self) -> KeyframeAtPlace | None:
        """Return the newest keyframe's pose relative to its place; None as long as its fragment has no place."""
        if self._last is None or self._begins:
            return None
        return KeyframeAtPlace(self._last.stamp_ns, self._count - 1, self._motion)

    def _is_far(self, share: float) -> bool:
        angle_deg = np.rad2deg(np.linalg.norm(so3_log(np.ascontiguousarray(self._motion[:3, :3]))))
        distance_m = np.linalg.norm(self._motion[:3, 3])
        return bool(distance_m >= share * self._distance_m or angle_deg >= share * self._angle_deg)


def motion_between(last: Keyframe, keyframe: Keyframe) -> tuple[Float, Float]:
    """Return ``last_T_body`` (4, 4) of two keyframes of an epoch, and its covariance (6, 6) in body at the second.

    If keyframes between them are lost, or the odometry reports no motion, the motion follows from their poses in odom,
    whose errors are assumed to be independent. This is pessimistic, as errors in common would cancel out.
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
    """Return ``a_T_c`` (4, 4) and its covariance (6, 6) in c, of two motions with independent errors.

    Args:
        a_T_b: (4, 4) first motion.
        a_covariance: (6, 6) covariance of ``a_T_b``, in b; with ``begins``, that of the pose of a, in a.
        b_T_c: (4, 4) second motion.
        b_covariance: (6, 6) covariance of ``b_T_c``, in c.
        begins: Whether the first covariance is that of the pose of a.
    """
    adjoint = se3_adjoint(se3_inverse(a_T_b if begins else b_T_c))
    return a_T_b @ b_T_c, adjoint @ a_covariance @ adjoint.T + b_covariance


def spread_keyframes(
    keyframes: Sequence[KeyframeAtPlace],
    poses: Sequence[Float | None],
    motions: Sequence[Float],
    begins: Collection[int],
) -> Trajectory:
    """Return the trajectory of all keyframes, given the places' poses.

    Between two places, the odometry's chain is kept, and its error at the second place is distributed over time. A pose
    is None if the place is not in the map; ``motions`` are those from the previous place to each place, and ``begins``
    the fragments' first places.
    """
    stamp_of: dict[int, int] = {}
    for each in keyframes:
        stamp_of.setdefault(each.place, each.stamp_ns)
    errors: dict[int, Float] = {}
    stamps: list[int] = []
    corrected: list[Float] = []
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
        corrected.append(pose @ each.place_T_body @ se3_exp(share))
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(corrected).reshape(-1, 4, 4))
