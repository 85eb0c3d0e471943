"""How the newest pose depends on the cameras' calibration since an earlier keyframe.

`ConsiderCovariance` knows this up to the keyframe that was adjusted last. Keyframes are only made in motion, and are
adjusted some framesets later: a rig that begins to walk is half a metre away by then.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3_adjoint, se3_inverse
from graphvio.measurements.motion import RelativeMotion
from graphvio.rig import Rig
from graphvio.self_calibration.parameters import about_origin, depths_of_pair, extrinsics_of, n_camera_parameters

_MAX_KEYFRAMES = 64  # largest number of keyframes that wait for an adjustment


class PoseGain(NamedTuple):
    """Dependence of a pose's error on the calibration.

    Attributes:
        odom_T_body: (4, 4) the pose.
        by_cameras: (6, N) derivatives of its error, in its own frame, with respect to the cameras' parameters.
    """

    odom_T_body: Float
    by_cameras: Float


@dataclass
class _Frameset:
    instant_ns: int
    pose: PoseGain  # by errors of depths only, since the first frameset
    is_keyframe: bool = False


class MotionGains:
    """Sums the effect of wrong depths on the motions by vision, each from the frameset that it is measured from.

    Args:
        rig: Rig with the cameras of the calibration.
    """

    def __init__(self, rig: Rig) -> None:
        self._depths_by_cameras = np.array([depths_of_pair(rig, j) for j in range(len(rig.pairs))])
        self._about_origin, self._extrinsics = about_origin(rig, 0), extrinsics_of(rig, 0)
        self._n = n_camera_parameters(rig)
        self._framesets: dict[int, _Frameset] = {}  # by stamp, in time order

    def restart(self) -> None:
        """Forget all framesets: later poses are in another frame."""
        self._framesets = {}

    def add(
        self,
        stamp_ns: int,
        instant_ns: int,
        odom_T_body: Float,
        motion: RelativeMotion | None,
        references: Set[int],
        since_ns: int | None = None,
    ) -> None:
        """Add a frameset, and forget those that nothing is measured from any more.

        Args:
            stamp_ns: Stamp of the frameset.
            instant_ns: Instant of its images, by which keyframes are stamped.
            odom_T_body: (4, 4) its pose.
            motion: Motion by vision that the pose follows, or None.
            references: Stamps of the framesets that later motions are measured from.
            since_ns: Instant of the keyframe that was adjusted last, or None. While no adjustment comes into force, it
                may be long ago.
        """
        since = None if motion is None else self._framesets.get(motion.reference_stamp_ns)
        gain = np.zeros((6, self._n))
        if since is not None and motion is not None and motion.by_depth_errors is not None:
            by_depths = motion.by_depth_errors[: len(self._depths_by_cameras)]
            gain = -np.einsum("jkt,jkn->tn", by_depths, self._depths_by_cameras)
        elif self._framesets:
            since = next(reversed(self._framesets.values()))
        if since is not None:
            gain = error_transport(since.pose.odom_T_body, odom_T_body) @ since.pose.by_cameras + gain
        self._forget(references, since_ns)
        self._framesets[stamp_ns] = _Frameset(instant_ns, PoseGain(odom_T_body, gain))

    def note_keyframe(self, instant_ns: int) -> None:
        """Keep the frameset of an instant, which is a keyframe of the calibration."""
        for each in self._framesets.values():
            each.is_keyframe |= each.instant_ns == instant_ns

    def since(self, instant_ns: int) -> PoseGain | None:
        """Return how the newest pose depends on the calibration since a keyframe, or None if it is not known."""
        then = next((each for each in self._framesets.values() if each.instant_ns == instant_ns), None)
        if then is None:
            return None
        newest = next(reversed(self._framesets.values())).pose
        carried = error_transport(then.pose.odom_T_body, newest.odom_T_body)
        gain = newest.by_cameras - carried @ then.pose.by_cameras
        gain[:, self._extrinsics] += (carried - np.eye(6)) @ self._about_origin
        return PoseGain(newest.odom_T_body, gain)

    def _forget(self, references: Set[int], since_ns: int | None) -> None:
        keyframes = [stamp_ns for stamp_ns, each in self._framesets.items() if each.is_keyframe]
        kept = references | set(keyframes[-_MAX_KEYFRAMES:])
        self._framesets = {
            stamp_ns: each
            for stamp_ns, each in self._framesets.items()
            if stamp_ns in kept or each.instant_ns == since_ns
        }


def error_transport(then: Float, now: Float) -> Float:
    """Return the matrix (6, 6) that turns an error of one pose (4, 4) into the error of a later one (4, 4)."""
    return se3_adjoint(se3_inverse(now) @ then)
