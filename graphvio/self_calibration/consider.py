"""What errors of the calibration add to the pose's covariance: consider states.

A wrong calibration has the same effect on all motions. As noise of each motion it would average out, and the pose would
seem far better known than it is. Here the pose's error is instead ``e = G c + m``. `c` is the error of the calibration
that is in force now, and `G` the sum of its effects on all motions; `m` is the error that earlier calibrations left
behind, since poses are not corrected when the calibration is. Neither is estimated, both are considered (S. F. Schmidt,
*Application of state-space methods to navigation problems*, 1966; B. D. Tapley et al., *Statistical orbit
determination*, 2004, section 6).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphvio.arrays import Float
from graphvio.self_calibration.motion_gains import PoseGain, error_transport
from graphvio.self_calibration.window import Keyframe

_GAIN_ERROR = 0.2  # relative error of a `PoseGain`, in all directions: it is an approximation


class ConsiderCovariance:
    """Covariance of the pose that is due to the calibration of the cameras.

    Errors of a pose are in its own frame (tangent ``[rotation, translation]``).

    Args:
        n: number of the cameras' parameters.
    """

    def __init__(self, n: int) -> None:
        self._newest: Keyframe | None = None
        self._gain = np.zeros((6, n))  # G, at the newest keyframe
        self._left_behind = np.zeros(6)  # m
        self._before_knock = np.zeros((6, 6))  # covariance of the error from before a knock, independent of c now
        self._difference = np.zeros(n)  # difference of the calibration in force from the rig file
        self._covariance = np.zeros((n, n))  # covariance of c

    def extend(self, keyframes: Sequence[Keyframe], by_cameras: Float) -> None:
        """Carry the pose's error on to the newest keyframe of a window.

        Args:
            keyframes: K keyframes of the window. The motion up to the newest one that is already known is not counted
                again. If that is not among them, the first of them is taken to be as far from it as they are from each
                other.
            by_cameras: (K, 6, N) derivatives of the window's poses, of which the first is fixed, with respect to the
                calibration.
        """
        newest = keyframes[-1]
        known = keyframes[0] if self._newest is None else self._newest
        first = next((k for k, keyframe in enumerate(keyframes) if keyframe.stamp_ns == known.stamp_ns), -1)
        first_pose = keyframes[max(first, 0)].odom_T_body
        motion = by_cameras[-1] - error_transport(first_pose, newest.odom_T_body) @ by_cameras[max(first, 0)]
        if first < 0 and len(keyframes) > 1:
            motion = motion * len(keyframes) / (len(keyframes) - 1)
        carried = error_transport(known.odom_T_body, newest.odom_T_body)
        self._gain = carried @ self._gain + motion
        self._left_behind = carried @ self._left_behind
        self._before_knock = carried @ self._before_knock @ carried.T
        self._newest = newest

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest keyframe of `extend`, or None."""
        return None if self._newest is None else self._newest.stamp_ns

    def set_calibration_in_force(self, difference: Float, covariance: Float, since: PoseGain | None = None) -> None:
        """Set the calibration that is in force from now on.

        Args:
            difference: (N,) difference of this calibration from the rig file.
            covariance: (N, N) covariance of its error.
            since: how the newest pose depends on the calibration since `newest_ns`, or None if that is not known: the
                motions until now were measured with the calibration before.
        """
        gain = self._gain
        if self._newest is not None and since is not None:
            gain = gain + error_transport(since.odom_T_body, self._newest.odom_T_body) @ since.by_cameras
        self._left_behind = self._left_behind + gain @ (difference - self._difference)
        self._difference, self._covariance = difference, covariance

    def correct(self, change: Float) -> None:
        """Record that the newest pose has been changed by a tangent (6,) in its own frame."""
        self._left_behind = self._left_behind - change

    def forget(self) -> None:
        """Freeze the covariance until now, after a knock: the calibration's error from now on is independent of it."""
        self._before_knock = self._at_newest
        self._gain, self._left_behind = np.zeros_like(self._gain), np.zeros(6)

    def at(self, odom_T_body: Float, since: PoseGain | None = None) -> Float:
        """Return the covariance (6, 6) that errors of the calibration add to a pose.

        Args:
            odom_T_body: (4, 4) pose, not far from the newest keyframe.
            since: how it depends on the calibration since `newest_ns`, or None if that is not known.
        """
        if self._newest is None:
            return np.zeros((6, 6))
        carried, by_error = error_transport(self._newest.odom_T_body, odom_T_body), np.zeros((6, 6))
        gain = carried @ self._gain
        if since is not None:
            added = error_transport(since.odom_T_body, odom_T_body) @ since.by_cameras
            variances = np.diag(added @ self._covariance @ added.T).reshape(2, 3).mean(axis=1)
            gain, by_error = gain + added, np.diag(np.repeat(_GAIN_ERROR**2 * variances, 3))
        return np.asarray(gain @ self._covariance @ gain.T + carried @ self._uncorrelated @ carried.T + by_error)

    @property
    def _at_newest(self) -> Float:
        return np.asarray(self._gain @ self._covariance @ self._gain.T + self._uncorrelated)

    @property
    def _uncorrelated(self) -> Float:
        """Covariance at the newest keyframe of what does not depend on the error of the calibration in force."""
        left_behind = np.outer(self._left_behind, self._left_behind) + _second_order(self._left_behind)
        return np.asarray(left_behind + self._before_knock)


def _second_order(error: Float) -> Float:
    """Return the covariance (6, 6) of the second-order terms of a pose's error (6,), as its size bounds them.

    The derivatives were taken at poses that were themselves turned by that error.
    """
    angle, distance = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
    return np.diag(np.repeat([angle * angle, angle * distance], 3) ** 2)
