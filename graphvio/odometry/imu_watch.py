"""A check whether the IMU agrees with vision, which leaves the IMU out while it does not.

The innovation test trusts the prediction: where vision is refused for a moment, a crowd or a reflection has misled it.
An IMU whose clock jumps, or whose axes, units or time offset are not those of the rig, contradicts vision permanently,
and would distort the whole path. When vision of good quality has been refused for so long that the estimator considers
it correct, the IMU is therefore left out, until it moves as the cameras do. If it does so with a time shift, its clock
is corrected.
"""

from __future__ import annotations

from collections import deque

from graphvio.backend.imu_match import ImuMatch, VisualStep, match_imu
from graphvio.geometry import se3_inverse
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.motion import PairReport, Quality, RelativeMotion, VisualResult
from graphvio.odometry.imu_clock import MAX_SHIFT_S, ImuClock
from graphvio.odometry.synchroniser import Synchroniser

_COMPARED_NS = 4_000_000_000  # time over which rotations are compared
_MAX_STEP_NS = 500_000_000  # between framesets whose rotation is compared
_CHECK_NS = 1_000_000_000  # time from one comparison to the next
_FIRST_WAIT_NS = 1_000_000_000  # until the first comparison; each time four times as long
_MAX_WAIT_NS = 60_000_000_000
_TRUSTED_AGAIN = 10  # if the IMU was right for so many waits, the next wait has the first value again
_MIN_INLIERS = 20
_MAX_WITNESSES = 2  # pairs that see the same motion: what misleads one hardly misleads the other
_MIN_SHIFT_S = 0.005  # smaller shifts are left to the calibration


def _bears_out(report: PairReport) -> bool:
    """Whether the motion explains most of a pair's points."""
    return report.inliers >= max(_MIN_INLIERS, 0.5 * report.points)


class ImuWatch:
    """Decides whether the IMU is used, and by which clock.

    Args:
        max_refused_s: If vision of good quality is refused for longer than this, within twice the time, vision is right
            and the IMU wrong. Where two pairs see the same motion, half of the time is enough.
        clock: Receives corrections.
        synchroniser: Has the samples.
        report: Receives events.

    Attributes:
        is_left_out: Whether the IMU is left out now.
    """

    def __init__(self, max_refused_s: float, clock: ImuClock, synchroniser: Synchroniser, report: Report) -> None:
        self.is_left_out = False
        self._max_refused_ns = round(max_refused_s * 1e9)
        self._clock = clock
        self._synchroniser = synchroniser
        self._report = report
        self._refused: deque[tuple[int, int]] = deque()  # stamp, and the weight of a refused motion, ns, or 0
        self._steps: deque[VisualStep] = deque()  # each begins where the previous one ends
        self._before: RelativeMotion | None = None
        self._before_ns = 0
        self._since_ns = 0  # stamp of the first refused motion
        self._next_ns = 0  # stamp of the next comparison
        self._wait_ns = _FIRST_WAIT_NS
        self._used_since_ns = 0  # stamp until which it was left out

    @property
    def warnings(self) -> list[str]:
        """Warnings where the IMU contradicts the rig, a sentence each."""
        found = self._clock.warnings
        if self.is_left_out and not self._clock.is_too_late:
            found.append("IMU: it contradicts the cameras, and is left out; check its clock, its axes and its units")
        return found

    def update(
        self, stamp_ns: int, visual: VisualResult, gate_result: GateResult | None, is_applied: bool
    ) -> ImuMatch | None:
        """Update the test whether the IMU agrees with vision, by a frameset.

        Args:
            stamp_ns: Stamp of the frameset.
            visual: The front-end's result for it.
            gate_result: Result of the test of vision against a prediction by the IMU; None where there was none.
            is_applied: Whether the state has been updated by a motion of vision.

        Returns:
            The match if the IMU is used again from now on, possibly with a corrected clock; the biases in the state are
            then no longer valid. None otherwise.
        """
        step_ns, self._before_ns = stamp_ns - self._before_ns, stamp_ns
        motion = visual.motion if visual.quality is Quality.GOOD else None
        self._add_step(step_ns, motion)
        if self.is_left_out:
            is_due = is_applied and motion is not None and stamp_ns >= self._next_ns
            return self._compare(stamp_ns) if is_due else None
        if motion is not None and gate_result is not None and step_ns < _MAX_STEP_NS:
            witnesses = min(sum(_bears_out(report) for report in visual.pairs.values()), _MAX_WITNESSES)
            self._refused.append((stamp_ns, 0 if gate_result.accepted else step_ns * max(witnesses, 1)))
        while self._refused and stamp_ns - self._refused[0][0] >= 2 * self._max_refused_ns:
            self._refused.popleft()
        if sum(refused_ns for _, refused_ns in self._refused) >= self._max_refused_ns:
            self._leave_out(stamp_ns)
        return None

    def _leave_out(self, stamp_ns: int) -> None:
        """Leave the IMU out until its rotations since vision was first refused can be compared with the cameras'."""
        self._since_ns = next(ns for ns, refused_ns in self._refused if refused_ns)
        self._refused.clear()
        if stamp_ns - self._used_since_ns >= _TRUSTED_AGAIN * self._wait_ns:
            self._wait_ns = _FIRST_WAIT_NS
        self.is_left_out, self._next_ns = True, stamp_ns + self._wait_ns
        self._wait_ns = min(4 * self._wait_ns, _MAX_WAIT_NS)
        self._report(
            stamp_ns,
            EventKind.IMU_LEFT_OUT,
            "it contradicts good images: is its clock right, and are its axes and units those of the rig?",
        )

    def _compare(self, stamp_ns: int) -> ImuMatch | None:
        """Use the IMU again if it moves as the cameras do, possibly with a time shift."""
        self._next_ns = stamp_ns + _CHECK_NS
        steps = [step for step in self._steps if step.begin_ns >= self._since_ns]
        match = match_imu(steps, self._synchroniser.mean_readings(), MAX_SHIFT_S)
        if match is None:
            return None
        if abs(match.shift_s) < _MIN_SHIFT_S:
            self._clock.keep()
            self._report(stamp_ns, EventKind.IMU_USED_AGAIN, "it moves as the cameras do")
        elif not self._clock.correct(stamp_ns, match.shift_s):
            return None
        self.is_left_out, self._used_since_ns = False, stamp_ns
        return match

    def _add_step(self, step_ns: int, motion: RelativeMotion | None) -> None:
        """Add the motion since the previous frameset; if it is not known, discard the earlier steps."""
        before, self._before = self._before, motion
        begin_T_end = None
        if motion is not None and 0 < step_ns < _MAX_STEP_NS:
            if motion.reference_stamp_ns == motion.stamp_ns - step_ns:
                begin_T_end = motion.reference_T_current
            elif before is not None and before.reference_stamp_ns == motion.reference_stamp_ns:
                begin_T_end = se3_inverse(before.reference_T_current) @ motion.reference_T_current
        if motion is None or begin_T_end is None:
            self._steps.clear()
            return
        self._steps.append(VisualStep(motion.stamp_ns - step_ns, motion.stamp_ns, begin_T_end))
        while motion.stamp_ns - self._steps[0].begin_ns > _COMPARED_NS:
            self._steps.popleft()
