"""What is believed of the rig: predicted, corrected by motions that pass the gate, and begun anew after breaks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.gating import Verdict
from graphvio.backend.inertial import ImuSpan
from graphvio.backend.smoother import Smoother
from graphvio.backend.starts import MAX_UNBRIDGED_S, Start, after_failure, after_gap, after_lost, by_vision, first_start
from graphvio.backend.states import RigState
from graphvio.backend.window import WindowError
from graphvio.config import Config
from graphvio.events import Quality, Status
from graphvio.frontend.motion import RelativeMotion, VisualResult
from graphvio.geometry import se3_inverse, se3_log
from graphvio.rig import Rig
from graphvio.synchroniser import Report


class Belief:
    """The rig's state, from `start` on: for each frameset `predict`, `use` and `update`, in this order.

    Args:
        rig: cameras and IMU.
        config: of all stages.
        report: is told of refused motions, breaks and starts.
        rekey: is called where later motions must be measured from the newest frameset.

    Attributes:
        epoch: counts declared breaks.
        covariance: (6, 6) of the newest pose, tangent ``[rotation, translation]`` in body.
    """

    def __init__(self, rig: Rig, config: Config, report: Report, rekey: Callable[[], None]) -> None:
        self.epoch = 0
        self.covariance: Float = np.zeros((6, 6))
        self._rig = rig
        self._config = config
        self._report = report
        self._rekey = rekey
        self._smoother: Smoother | None = None
        self._settled_ns = 0  # from this stamp on, a start in motion is over
        self._tracked_ns = 0  # stamp of the last state that vision constrains
        self._refused: dict[int, Float] = {}  # stamp -> nav_T_body by the motions that the gate refused
        self._lost = False
        self._final: list[tuple[int, Float]] = []

    # ------------------------------------------------------------------ what is known

    @property
    def has_started(self) -> bool:
        """Whether there is a state."""
        return self._smoother is not None

    @property
    def has_imu(self) -> bool:
        """Whether it has started with an IMU."""
        return self._smoother is not None and self._smoother.has_imu

    @property
    def latest_ns(self) -> int:
        """Stamp of the newest state."""
        return self._running.latest_ns

    def state(self) -> RigState:
        """The newest state."""
        return self._running.state()

    def latest_rate(self) -> Float | None:
        """Mean angular rate (3,) rad/s of body between the two newest states, or None when there is one."""
        return self._running.latest_rate()

    def motion_since(self, then_ns: int) -> Float | None:
        """``now_T_then`` (4, 4) of body from a state in the window to the newest one, or None if it is not there."""
        smoother = self._smoother
        if smoother is None or not smoother.knows(then_ns):
            return None
        return se3_inverse(smoother.pose(smoother.latest_ns)) @ smoother.pose(then_ns)

    def take_final(self) -> list[tuple[int, Float]]:
        """Stamps and poses ``nav_T_body`` that became final since the last call; not always in time order."""
        taken, self._final = self._final, []
        return taken

    def end(self) -> None:
        """Nothing more will come: the window's poses are final."""
        if self._smoother is not None:
            self._final += self._smoother.all_poses()

    # ------------------------------------------------------------------ one frameset

    def start(self, stamp_ns: int, found: tuple[ImuSpan, float] | None) -> None:
        """Begin at a frameset, where the rig is thought to be, with what the IMU says of its attitude.

        Args:
            stamp_ns: of the frameset.
            found: the IMU around it, and its place in there in seconds; None starts without an IMU.
        """
        position = np.zeros(3)
        if self._smoother is not None:
            position = self.state().nav_T_body[:3, 3]
            self._final += self._smoother.all_poses()
            self.epoch += 1
            self._report(stamp_ns, "imu_came", f"the IMU has come: epoch {self.epoch} starts upright")
        elif self._rig.imu is not None and found is None:
            self._report(stamp_ns, "started_without_imu", "no IMU samples came: vision alone from here")
        self._smoother = Smoother(self._config.smoother, self._rig.imu if found else None)
        self._begin(first_start(stamp_ns, position, found, self._rig, self._config.initialisation))

    def predict(self, stamp_ns: int, span: ImuSpan | None) -> None:
        """Go on to a frameset's instant by the IMU, or without a span of it by constant velocity."""
        if span is None and stamp_ns - self.latest_ns > MAX_UNBRIDGED_S * 1e9:
            self._jump(stamp_ns)
        else:
            self._running.extend(stamp_ns, span)

    def use(self, visual: VisualResult) -> RelativeMotion | None:
        """Gate a measured motion and insert it; a gate that refuses for too long is itself at fault.

        Returns:
            The motion by which vision constrains the newest state, or None.
        """
        smoother, motion = self._running, visual.motion
        if motion is None:
            return None
        if not smoother.knows(motion.reference_stamp_ns):  # it started anew since then
            self._rekey()
            return None
        if self._lost and motion.reference_stamp_ns > self._tracked_ns:  # not from a state that was known
            self._recover(motion)
            return motion
        try:
            motion, verdict = self._judge(visual)
        except WindowError:
            return None  # `update` meets the same error, and rebuilds
        if verdict.accepted:
            smoother.accept(motion)
            self._refused.clear()
            self._lost = False
            return motion
        self._report(
            motion.stamp_ns,
            "vision_gated",
            f"innovation {verdict.statistic:.1f} beyond chi-square {verdict.threshold:.1f}, {motion.inliers} inliers",
        )
        if visual.quality is not Quality.GOOD:
            return None  # vision that contradicts itself cannot put the prediction in the wrong
        reference_ns = motion.reference_stamp_ns
        nav_T_reference = self._refused[reference_ns] if reference_ns in self._refused else smoother.pose(reference_ns)
        self._refused[motion.stamp_ns] = nav_T_reference @ motion.reference_T_current
        if motion.stamp_ns - min(self._refused) > self._config.smoother.max_gated_s * 1e9:
            self._believe_vision(motion)
            return motion
        return None

    def update(self, stamp_ns: int, used: bool, keep: frozenset[int]) -> Status:
        """Optimise and marginalise; a window without a solution is rebuilt around the prediction.

        Args:
            stamp_ns: of the newest state.
            used: whether vision constrains it, or it is a start.
            keep: stamps of states that later motions will be measured from.
        """
        smoother = self._running
        if used:
            self._tracked_ns = stamp_ns
        predicted = smoother.state()
        try:
            self._final += smoother.settle(keep | {self._tracked_ns})
            self.covariance = smoother.covariance()
            return self._status(stamp_ns, used)
        except WindowError as error:
            self._report(stamp_ns, "window_rebuilt", str(error))
            self._start_again(after_failure(stamp_ns, predicted, self.covariance), stamp_ns - 1)
            return Status.COASTING

    @property
    def _running(self) -> Smoother:
        assert self._smoother is not None, "it has started"
        return self._smoother

    def _judge(self, visual: VisualResult) -> tuple[RelativeMotion, Verdict]:
        """The motion and its test; where pairs contradict each other, the side that the prediction clearly prefers."""
        assert visual.motion is not None
        verdicts = [(self._running.test(motion), motion) for motion in visual.alternatives]
        verdicts.sort(key=lambda judged: judged[0].statistic)
        if verdicts:
            (likely, motion), (unlikely, _) = verdicts[:2]
            if likely.accepted and not unlikely.accepted and likely.is_clear and unlikely.is_clear:
                return motion, likely
        return visual.motion, self._running.test(visual.motion)

    def _status(self, stamp_ns: int, used: bool) -> Status:
        if used:
            return Status.INITIALISING if stamp_ns < self._settled_ns else Status.TRACKING
        covariance = self._running.covariance_since(self._tracked_ns)
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
        if not self._lost and sigma > self._config.smoother.lost_position_sigma_m:
            self._lost = True
            self._report(stamp_ns, "lost", f"position uncertain by {sigma:.2f} m since vision was last used")
        return Status.LOST if self._lost else Status.COASTING

    # ------------------------------------------------------------------ breaks

    def _jump(self, stamp_ns: int) -> None:
        """After a gap that nothing bridges, be it a pause or a jump of the clock: a new epoch at the last pose."""
        last_ns = self.latest_ns
        self._start_again(after_gap(stamp_ns, self.state(), self.covariance), last_ns)
        self.epoch += 1
        gap_s = (stamp_ns - last_ns) * 1e-9
        self._report(stamp_ns, "time_jump", f"{gap_s:.1f} s without data: epoch {self.epoch} starts at the last pose")

    def _recover(self, motion: RelativeMotion) -> None:
        """After lost: a new epoch that starts at the best guess, the prediction, with the velocity that vision sees."""
        smoother = self._running
        self._start_again(after_lost(motion, smoother.state(), smoother.covariance()), self._tracked_ns)
        self.epoch += 1
        self._report(motion.stamp_ns, "new_epoch", f"vision is back: epoch {self.epoch} starts at the best guess")

    def _believe_vision(self, motion: RelativeMotion) -> None:
        """Refused motions that go on agreeing with each other put the prediction in the wrong.

        Their chain, which begins at a state that was accepted, is the pose from here on; by as much as it differs from
        the prediction it is uncertain.
        """
        smoother, nav_T_body = self._running, self._refused[motion.stamp_ns]
        predicted = smoother.state()
        self._start_again(by_vision(motion, nav_T_body, predicted, smoother.covariance()), self._tracked_ns)
        apart_m = np.linalg.norm(se3_log(se3_inverse(nav_T_body) @ predicted.nav_T_body)[3:])
        self._report(
            motion.stamp_ns,
            "gate_reset",
            f"refused for too long, vision is believed now, {apart_m:.3f} m from the prediction",
        )

    def _start_again(self, start: Start, last_final_ns: int) -> None:
        """Begin anew; of the window's poses, those up to a stamp are final, and the later ones are given up."""
        self._final += [(ns, pose) for ns, pose in self._running.all_poses() if ns <= last_final_ns]
        self._begin(start)
        self._rekey()

    def _begin(self, start: Start) -> None:
        self._running.start(start.stamp_ns, start.state, start.uncertainty)
        self._settled_ns = max(self._settled_ns, start.settled_ns)
        self._tracked_ns = start.stamp_ns
        self._refused.clear()
        self._lost = False
