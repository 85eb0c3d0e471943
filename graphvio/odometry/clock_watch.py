"""A check whether the IMU of single cameras turns when they do; if it turns at another time, its clock is corrected.

Without a pair there is no motion by vision that an IMU could contradict: scale, velocity and gravity are estimated from
both together, and an IMU with a wrong clock distorts the path, or fits no motion. But the rotation of a camera follows
from its tracks alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from graphvio.backend.imu_match import VisualStep, match_rates, turn_disagreement
from graphvio.backend.inertial import MeanReadings
from graphvio.frontend.tracking.turn import turn_between
from graphvio.geometry import se3
from graphvio.measurements.motion import CameraTracks
from graphvio.monocular.sample_buffer import MAX_TIME_OFFSET_NS
from graphvio.odometry.imu_clock import MAX_SHIFT_S, ImuClock
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig

_INTERVAL_NS = 90_000_000  # time from one step to the next
_STEP_NS = 190_000_000  # time over which a turn is measured; less where tracks are too short
_MAX_STEP_NS = 500_000_000
_COMPARED = 25  # number of newest steps that are compared
_JUDGED_WITHOUT_POSE = 10  # number of them without a pose: a false alarm, as by an opening door, costs nothing then
_MAX_DISAGREEMENT = 1.0  # median turn difference over its expected error: 0.1 with a right clock, 0.3 at 8 ms of offset
_MAX_DISAGREEMENT_AT_FIRST = 0.5  # until there are `_COMPARED` steps
_MIN_DISAGREEMENT_TO_SEARCH = 0.3  # above this, other clock shifts are tried; before a pose always
_MAX_DIFFERENCE = 0.4  # largest RateMatch.difference that is accepted; a clock that jumped between the steps gives more
_CHECK_NS = 250_000_000  # time from one comparison to the next
_SAME_S = 0.005  # largest difference of the shifts by two comparisons that confirm each other
_MIN_SHIFT_S = 0.015  # for a correction that ends an epoch; smaller shifts are left to the calibration
_MIN_SHIFT_WITHOUT_POSE_S = 0.01


class ClockWatch:
    """Compares the turns of single cameras with those of the gyro.

    Args:
        rig: Single cameras and an IMU.
        clock: Receives corrections.
        synchroniser: Has the samples, and the estimated time offset.

    Attributes:
        is_doubted: Whether the gyro turns differently from the cameras, so that no pose can be right.
    """

    def __init__(self, rig: Rig, clock: ImuClock, synchroniser: Synchroniser) -> None:
        assert rig.imu is not None
        self.is_doubted = False
        self._rig = rig
        self._file_offset_s = rig.imu.time_offset_s
        self._clock = clock
        self._synchroniser = synchroniser
        self._steps: deque[VisualStep] = deque(maxlen=_COMPARED)
        self._seen: deque[tuple[int, Mapping[int, CameraTracks]]] = deque()  # at stamps at which a step may begin
        self._next_ns = 0  # stamp of the next comparison at all shifts
        self._found_s: float | None = None  # shift by the last comparison

    def update(self, stamp_ns: int, camera_tracks: Mapping[int, CameraTracks], has_pose: bool) -> bool:
        """Update the comparison of the gyro's turns with those of the cameras by a frameset.

        Args:
            stamp_ns: Stamp of the frameset.
            camera_tracks: Camera index -> its tracks at the frameset.
            has_pose: Whether there is a pose, so that a correction ends an epoch.

        Returns:
            Whether the clock has been corrected: whatever was learnt from the IMU until now is then invalid.
        """
        judged = _COMPARED if has_pose else _JUDGED_WITHOUT_POSE
        if not self._add_step(stamp_ns, camera_tracks) or len(self._steps) < judged:
            return False
        readings = self._synchroniser.mean_readings()
        disagreement = turn_disagreement(list(self._steps)[-judged:], readings)
        is_good = disagreement is None or disagreement < _MIN_DISAGREEMENT_TO_SEARCH
        shift_s = None
        if stamp_ns >= self._next_ns and not (has_pose and is_good and not self._is_beyond):
            self._next_ns = stamp_ns + _CHECK_NS
            shift_s = self._confirmed_shift_s(readings)
        min_shift_s = _MIN_SHIFT_S if has_pose else _MIN_SHIFT_WITHOUT_POSE_S
        if shift_s is not None:
            if abs(shift_s) > min_shift_s or self._is_beyond:
                return self._correct(stamp_ns, shift_s)
            self._clock.keep()
        is_calibrations = self._found_s is not None and abs(self._found_s) <= min_shift_s
        if disagreement is not None:
            limit = _MAX_DISAGREEMENT if len(self._steps) == _COMPARED else _MAX_DISAGREEMENT_AT_FIRST
            self.is_doubted = disagreement > limit and not is_calibrations
        return False

    def _confirmed_shift_s(self, readings: MeanReadings) -> float | None:
        """Return the shift at which the gyro turns as the cameras do, if the previous comparison found the same."""
        match = match_rates(self._steps, readings, MAX_SHIFT_S)
        before_s, self._found_s = self._found_s, None
        if match is None or match.difference > _MAX_DIFFERENCE:
            return None
        self._found_s = match.shift_s
        return match.shift_s if before_s is not None and abs(match.shift_s - before_s) < _SAME_S else None

    @property
    def _learnt_s(self) -> float:
        """Difference of the estimated time offset from that of the rig file, s."""
        return self._synchroniser.time_offset_s - self._file_offset_s

    @property
    def _is_beyond(self) -> bool:
        """Whether `_learnt_s` exceeds the range of the estimator's samples."""
        return abs(self._learnt_s) > 1e-9 * MAX_TIME_OFFSET_NS

    def _correct(self, stamp_ns: int, shift_s: float) -> bool:
        """Correct the clock, and undo the estimated time offset, which belongs to the wrong clock."""
        learnt_s = self._learnt_s
        if not self._clock.correct(stamp_ns, shift_s + learnt_s):
            return False
        self._synchroniser.add_to_time_offset(-learnt_s)
        self._steps.clear()
        self._found_s, self.is_doubted = None, False
        return True

    def _add_step(self, stamp_ns: int, camera_tracks: Mapping[int, CameraTracks]) -> bool:
        """Add the turn over the newest step, if one is due, and return whether a turn was added."""
        if self._seen and stamp_ns - self._seen[-1][0] < _INTERVAL_NS:
            return False
        self._seen.append((stamp_ns, camera_tracks))
        while len(self._seen) > 1 and stamp_ns - self._seen[1][0] >= _STEP_NS:
            self._seen.popleft()
        for begin_ns, then in list(self._seen)[:-1]:
            then_R_now = turn_between(self._rig, then, camera_tracks) if stamp_ns - begin_ns < _MAX_STEP_NS else None
            if then_R_now is not None:
                self._steps.append(VisualStep(begin_ns, stamp_ns, se3(then_R_now, np.zeros(3))))
                return True
        return False
