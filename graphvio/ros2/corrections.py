"""Corrections received as ROS 2 messages: poses of keyframes in the map."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from graphvio.errors import GraphvioError
from graphvio.ros2.frames import Frames
from graphvio.ros2.messages import CORRECTION, MAP
from graphvio.sessions import cdr
from graphvio.sessions.messages import stamp_of
from graphvio.slam.checks import check_covariance, check_pose
from graphvio.slam.interface import Served
from graphvio.slam.keyframe import Keyframe

_TOLERANCE_NS: Final = 500_000  # more than the error of a stamp that was converted to floating-point seconds
_MAX_KEYFRAMES: Final = 20_000
_MAX_NORM_ERROR: Final = 1e-3


@dataclass(frozen=True, slots=True)
class Outcomes:
    """Outcomes of the corrections so far."""

    accepted: int = 0  # number of accepted corrections
    refused: int = 0  # number of refused corrections
    is_refused: bool = False  # whether the newest correction was refused
    newest: str = "none received"  # outcome of the newest correction, a line of text


class Corrections:
    """Checks corrections and passes them to the odometry; keyframes may be added in another thread."""

    def __init__(self, served: Served, frames: Frames) -> None:
        self._served, self._frames = served, frames
        self._lock = threading.Lock()
        self._stamps: deque[tuple[int, int]] = deque(maxlen=_MAX_KEYFRAMES)  # stamp and id of each keyframe
        self.outcomes = Outcomes()

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Accept corrections of this keyframe from now on."""
        with self._lock:
            self._stamps.append((keyframe.stamp_ns, keyframe.id))

    def take(self, data: bytes) -> None:
        """Apply a correction, a ``geometry_msgs/PoseWithCovarianceStamped`` in CDR, and update ``outcomes``."""
        try:
            accepted = self._apply(data)
            self.outcomes = Outcomes(self.outcomes.accepted + 1, self.outcomes.refused, False, accepted)
        except GraphvioError as error:
            self.outcomes = Outcomes(self.outcomes.accepted, self.outcomes.refused + 1, True, str(error))

    def _apply(self, data: bytes) -> str:
        message = cdr.decode(data, CORRECTION, "a correction")
        frame = message.header.frame_id.lstrip("/")
        if frame != MAP:
            raise _RefusedError(f"a correction in frame {frame!r}; give the pose of {self._frames.base} in {MAP}")
        q = message.pose.pose.orientation
        norm = float(np.linalg.norm([q.x, q.y, q.z, q.w]))
        if not abs(norm - 1.0) < _MAX_NORM_ERROR:
            raise _RefusedError(f"a correction whose orientation has norm {norm:.3g}; give a unit quaternion")
        map_T_body, covariance = self._frames.correction_of(message)
        covariance = 0.5 * (covariance + covariance.T)
        check_pose(map_T_body, "a correction's pose")
        check_covariance(covariance, "a correction's covariance")
        keyframe_id = self._keyframe_at(stamp_of(message.header))
        result = self._served.correct(keyframe_id, map_T_body, covariance)
        if not result.accepted:
            raise _RefusedError(f"the correction of keyframe {keyframe_id}: {result.reason}")
        distance = "" if result.statistic is None else f", statistic {result.statistic:.3g} of {result.threshold:.3g}"
        return f"keyframe {keyframe_id} accepted{distance}"

    def _keyframe_at(self, stamp_ns: int) -> int:
        with self._lock:
            nearest = min(self._stamps, key=lambda each: abs(each[0] - stamp_ns), default=None)
        if nearest is None:
            raise _RefusedError("a correction before the first keyframe")
        if abs(nearest[0] - stamp_ns) > _TOLERANCE_NS:
            raise _RefusedError(
                f"a correction at {stamp_ns} ns: the nearest keyframe is {1e-6 * abs(nearest[0] - stamp_ns):.3g} ms "
                "off; give the stamp of a keyframe's landmarks"
            )
        return nearest[1]


class _RefusedError(GraphvioError):
    """Raised for a correction that is refused, by the checks of this module or by the odometry."""
