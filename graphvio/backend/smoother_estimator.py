"""What the smoother believes of the rig: predicted, corrected by what passes the gates, begun anew after breaks."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.estimator import StateEstimator
from graphvio.backend.smoother import Smoother
from graphvio.backend.starts import (
    MAX_UNBRIDGED_S,
    Start,
    after_failure,
    after_gap,
    after_lost,
    by_vision,
    doubtful,
    first_start,
)
from graphvio.backend.states import RigState
from graphvio.backend.window import SOLVER_ERRORS
from graphvio.config import Config
from graphvio.geometry import se3_inverse, se3_log
from graphvio.measurements.estimate import Status
from graphvio.measurements.events import Report
from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.rig import Rig

_TRUSTED_AFTER = 20  # motions; what a start that ends sooner has found is not taken for known


class SmootherEstimator(StateEstimator):
    """The rig's state by the fixed-lag smoother; for arguments and attributes see `StateEstimator`."""

    def __init__(self, rig: Rig, config: Config, report: Report, rekey: Callable[[], None]) -> None:
        super().__init__(rig, config, report, rekey)
        self._smoother: Smoother | None = None
        self._reset_ns = 0
        self._accepted = 0  # motions since the start
        self._refused: dict[int, Float] = {}  # stamp -> nav_T_body by the motions that the gate refused
        self._imu_failed = False  # since the first of these
        self._tracked_covariance = np.zeros((6, 6))  # of the last pose that vision constrains
        self._sigma_m = 0.0  # of the position since vision was last used
        self._rebuilt_sigma_m = 0.0  # the same when the window was rebuilt since then

    # ------------------------------------------------------------------ what is known

    @property
    def has_started(self) -> bool:
        """See `StateEstimator`."""
        return self._smoother is not None

    @property
    def has_imu(self) -> bool:
        """See `StateEstimator`."""
        return self._smoother is not None and self._smoother.has_imu

    @property
    def latest_ns(self) -> int:
        """See `StateEstimator`."""
        return self._running.latest_ns

    def state(self) -> RigState:
        """See `StateEstimator`."""
        return self._running.state()

    def latest_rate(self) -> Float | None:
        """See `StateEstimator`."""
        return self._running.latest_rate()

    def motion_since(self, then_ns: int) -> Float | None:
        """See `StateEstimator`."""
        smoother = self._smoother
        if smoother is None or not smoother.knows(then_ns):
            return None
        return se3_inverse(smoother.pose(smoother.latest_ns)) @ smoother.pose(then_ns)

    def covariance_since(self, then_ns: int) -> Float | None:
        """See `StateEstimator`."""
        smoother = self._smoother
        if smoother is None or not smoother.knows(then_ns):
            return None
        try:
            return smoother.covariance_since(then_ns)
        except SOLVER_ERRORS:
            return None

    def end(self) -> None:
        """See `StateEstimator`."""
        if self._smoother is not None:
            self._final += self._smoother.all_poses()

    # ------------------------------------------------------------------ one frameset

    def start(self, stamp_ns: int, found: tuple[ImuInterval, float] | None) -> None:
        """See `StateEstimator`."""
        position = self._position_to_start_at(stamp_ns, found)
        if self._smoother is not None:
            self._final += self._smoother.all_poses()
        self._smoother = Smoother(self._config.smoother, self._rig.imu if found else None)
        self._begin(first_start(stamp_ns, position, found, self._rig, self._config.initialisation))

    def predict(self, stamp_ns: int, interval: ImuInterval | None) -> None:
        """See `StateEstimator`."""
        self.gate_results = {}
        if interval is None and stamp_ns - self.latest_ns > MAX_UNBRIDGED_S * 1e9:
            self._jump(stamp_ns)
            return
        self._imu_failed |= self.has_imu and interval is None and bool(self._refused)
        before = self.state()
        try:
            self._running.extend(stamp_ns, interval)
        except SOLVER_ERRORS as error:
            self._rebuild(stamp_ns, before, error)

    def use(self, visual: VisualResult, at_rest: bool) -> RelativeMotion | None:
        """See `StateEstimator`."""
        try:
            motion = self._use_motion(visual)
            if at_rest and self.has_imu:
                self._use_rest()
        except SOLVER_ERRORS as error:
            self._rebuild(self.latest_ns, self.state(), error)
            return None
        return motion

    def _use_rest(self) -> None:
        """Standing still: a velocity of zero, unless the prediction is sure of another."""
        gate_result = self._running.test_rest()
        self.gate_results["rest"] = gate_result
        if gate_result.accepted:
            self._running.accept_rest()
        else:
            self._report(self.latest_ns, "rest_gated", _beyond(gate_result))

    def _use_motion(self, visual: VisualResult) -> RelativeMotion | None:
        """Gate a measured motion and insert it."""
        smoother, motion = self._running, visual.motion
        if motion is None:
            return None
        if not smoother.knows(motion.reference_stamp_ns):  # it started anew since then
            self._rekey()
            return None
        if self._lost and (motion.reference_stamp_ns > self._tracked_ns or self._rebuilt_sigma_m):
            # It is not from a state that was known.
            self._recover(motion)
            return motion
        motion, gate_result = self._judge(visual)
        self.gate_results["vision"] = gate_result
        excess = smoother.excess_acceleration(motion)
        if gate_result.accepted and excess is None:
            if self._imu_failed and motion.reference_stamp_ns in self._refused:
                # It agrees with the prediction only because both start from a state that vision was not heard on.
                self._refused[motion.stamp_ns] = self._refused[motion.reference_stamp_ns] @ motion.reference_T_current
                self._believe_vision(motion, "the IMU failed while vision was refused")
                return motion
            smoother.accept(motion)
            self._accepted += 1
            self._forget_troubles()
            return motion
        why = _beyond(gate_result) if excess is None else f"asks for an acceleration of {excess:.0f} m/s^2"
        self._report(motion.stamp_ns, "vision_gated", f"{why}, {motion.inliers} inliers")
        if visual.quality is not Quality.GOOD:
            return None  # vision that contradicts itself cannot put the prediction in the wrong
        reference_ns = motion.reference_stamp_ns
        nav_T_reference = self._refused[reference_ns] if reference_ns in self._refused else smoother.pose(reference_ns)
        self._refused[motion.stamp_ns] = nav_T_reference @ motion.reference_T_current
        if motion.stamp_ns - min(self._refused) > self._config.smoother.max_gated_s * 1e9:
            self._believe_vision(motion, "refused for too long")
            return motion
        return None

    def update(self, stamp_ns: int, used: bool, keep: frozenset[int]) -> Status:
        """Optimise and marginalise; a window without a solution is rebuilt around the prediction."""
        smoother = self._running
        if used:
            self._tracked_ns = stamp_ns
        try:
            self._final += smoother.settle(keep | {self._tracked_ns})
            self._reset_position(stamp_ns)
            self.covariance = smoother.state_covariance()
            if used:
                self._tracked_covariance = self.covariance.pose
                self._sigma_m = self._rebuilt_sigma_m = 0.0
            else:
                since = smoother.covariance_since(self._tracked_ns)
                self._sigma_m = float(np.hypot(np.sqrt(np.linalg.eigvalsh(since[3:, 3:])[-1]), self._rebuilt_sigma_m))
        except SOLVER_ERRORS as error:
            self._rebuild(stamp_ns, smoother.state(), error)
            with suppress(*SOLVER_ERRORS):
                self.covariance = self._running.state_covariance()
            used = False
        return self._status(stamp_ns, used, self._sigma_m)

    @property
    def _running(self) -> Smoother:
        assert self._smoother is not None, "it has started"
        return self._smoother

    def _judge(self, visual: VisualResult) -> tuple[RelativeMotion, GateResult]:
        """The motion and its test; where pairs contradict each other, the side that the prediction clearly prefers."""
        assert visual.motion is not None
        gate_results = [(self._running.test(motion), motion) for motion in visual.alternatives]
        gate_results.sort(key=lambda judged: judged[0].statistic)
        if gate_results:
            (likely, motion), (unlikely, _) = gate_results[:2]
            if likely.accepted and not unlikely.accepted and likely.is_clear and unlikely.is_clear:
                return motion, likely
        return visual.motion, self._running.test(visual.motion)

    def _reset_position(self, stamp_ns: int) -> None:
        """From time to time, see `Smoother.reset_position`."""
        if stamp_ns - self._reset_ns >= self._config.smoother.reset_s * 1e9:
            self._running.reset_position()
            self._reset_ns = stamp_ns

    # ------------------------------------------------------------------ breaks

    def _rebuild(self, stamp_ns: int, state: RigState, error: Exception) -> None:
        """Go on from a state, or from the one before the prediction, with a new window: nothing else is changed by it.

        What is lost stays lost, and how long vision has been missed still counts.
        """
        self._report(stamp_ns, "window_rebuilt", str(error))
        was_lost, sigma_m = self._lost, self._sigma_m
        self._start_again(after_failure(stamp_ns, state, self.covariance.pose), stamp_ns - 1)
        self._lost, self._sigma_m, self._rebuilt_sigma_m = was_lost, sigma_m, sigma_m

    def _jump(self, stamp_ns: int) -> None:
        """After a gap that nothing bridges, be it a pause or a jump of the clock: a new epoch at the last pose."""
        last_ns = self.latest_ns
        self._start_again(after_gap(stamp_ns, self.state(), self.covariance.pose), last_ns)
        self.epoch += 1
        gap_s = (stamp_ns - last_ns) * 1e-9
        self._report(stamp_ns, "time_jump", f"{gap_s:.1f} s without data: epoch {self.epoch} starts at the last pose")

    def _recover(self, motion: RelativeMotion) -> None:
        """After lost: a new epoch that starts at the best guess, the prediction, with the velocity that vision sees."""
        smoother = self._running
        start = after_lost(motion, smoother.state(), smoother.covariance())
        if self.has_imu and self._accepted < _TRUSTED_AFTER:
            start = doubtful(start)
        self._start_again(start, self._tracked_ns)
        self.epoch += 1
        self._report(motion.stamp_ns, "new_epoch", f"vision is back: epoch {self.epoch} starts at the best guess")

    def _believe_vision(self, motion: RelativeMotion, why: str) -> None:
        """Motions that were refused and go on agreeing with each other put the prediction in the wrong.

        Their chain, which begins at a state that was accepted, is the pose from here on; unless the IMU is known to
        have failed, it is uncertain by as much as it differs from the prediction.
        """
        smoother, nav_T_body = self._running, self._refused[motion.stamp_ns]
        predicted = smoother.state()
        start = by_vision(motion, nav_T_body, predicted, self._tracked_covariance, self._imu_failed)
        self._start_again(start, self._tracked_ns)
        apart_m = np.linalg.norm(se3_log(se3_inverse(nav_T_body) @ predicted.nav_T_body)[3:])
        self._report(
            motion.stamp_ns,
            "gate_reset",
            f"{why}: vision is believed now, {apart_m:.3f} m from the prediction",
        )

    def _start_again(self, start: Start, last_final_ns: int) -> None:
        """Begin anew; of the window's poses, those up to a stamp are final, and the later ones are given up."""
        self._final += [(ns, pose) for ns, pose in self._running.all_poses() if ns <= last_final_ns]
        self._begin(start)
        self._rekey()

    def _begin(self, start: Start) -> None:
        self._accepted = 0
        self._running.start(start.stamp_ns, start.state, start.uncertainty)
        self._reset_ns = start.stamp_ns
        self._note_start(start)
        self._tracked_ns = start.stamp_ns
        self._sigma_m = self._rebuilt_sigma_m = 0.0
        self._forget_troubles()

    def _forget_troubles(self) -> None:
        self._refused.clear()
        self._imu_failed = False
        self._lost = False


def _beyond(gate_result: GateResult) -> str:
    return f"innovation {gate_result.statistic:.1f} beyond chi-square {gate_result.threshold:.1f}"
