"""The odometry: IMU samples and framesets in, estimates out. The algorithm of the paper, and no I/O."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.gating import Verdict
from graphvio.backend.inertial import ImuSpan
from graphvio.backend.initialisation import InitialAttitude, initial_attitude, is_at_rest, level
from graphvio.backend.smoother import RigState, Smoother, StartUncertainty, origin_covariance
from graphvio.backend.window import WindowError
from graphvio.config import Config
from graphvio.errors import EventError
from graphvio.events import Estimate, Event, FrameSet, ImuSample, Incident, Quality, Status, checked_event
from graphvio.frontend.motion import RelativeMotion, VisualResult
from graphvio.frontend.visual import VisualFrontend
from graphvio.geometry import se3, se3_inverse, se3_log
from graphvio.rates import AngularRates
from graphvio.rig import Rig
from graphvio.synchroniser import Synchroniser

_MAX_UNBRIDGED_S = 3.0
_UNKNOWN_SPEED_SIGMA = 30.0  # without an IMU the first motion is believed whatever it is, on foot or on the road
_MOVING_START_SPEED_SIGMA = 2.0
_RESTING_START_SPEED_SIGMA = 0.02
_RESTART_SPEED_SIGMA = 1.0
_GYRO_BIAS_SIGMA = 0.01
_WIDE_GYRO_BIAS_SIGMA = 0.1
_AFTER_REBUILD = np.diag([0.05] * 3 + [0.1] * 3) ** 2  # added to the pose's covariance, radians and metres
_AFTER_JUMP = np.diag([0.2] * 3 + [1.0] * 3) ** 2


class Odometry:
    """Visual-inertial odometry of a rig of stereo pairs.

    Feed it events in time order with `process`. It holds a frameset until the IMU samples that cover it have come.
    With more than one pair, OpenCV's own threads are switched off in this process: pairs run side by side instead.

    Args:
        rig: cameras and IMU; without an IMU, vision alone is used.
        config: of all stages.
    """

    def __init__(self, rig: Rig, config: Config | None = None) -> None:
        self.rig = rig
        self.config = config or Config()
        self._frontend = VisualFrontend(rig, self.config)
        self._synchroniser = Synchroniser(rig, self.config, self._report)
        self._smoother: Smoother | None = None
        self._settled_ns = 0  # from this stamp on, a start in motion is over
        self._tracked_ns = 0  # stamp of the last state that vision constrains
        self._refused: dict[int, Float] = {}  # stamp -> nav_T_body by the motions that the gate refused
        self._told_misaligned: set[int] = set()
        self._lost = False
        self._epoch = 0
        self._pose_covariance = np.zeros((6, 6))  # of the newest estimate
        self._rates = AngularRates()
        self._incidents: list[Incident] = []
        self._smoothed: list[tuple[int, Float]] = []
        self._first_ns: int | None = None
        self._finished = False

    def process(self, event: Event) -> Estimate | None:
        """Take one event.

        Returns:
            The estimate of the oldest frameset that is due, or None while there is none. At most one frameset is
            worked on in a call; what is still held comes with later events or with `finish`.

        Raises:
            EventError: if the event is malformed, or the odometry has been finished.
            RigError: if an image is not what the rig says.
        """
        if self._finished:
            raise EventError("the odometry has been finished; make a new one for more events")
        event = checked_event(event)
        if isinstance(event, ImuSample):
            self._synchroniser.add_sample(event)
        else:
            self._synchroniser.add_frameset(event)
        frameset = self._synchroniser.next_due(started=self._smoother is not None)
        return None if frameset is None else self._estimate(frameset)

    def finish(self) -> list[Estimate]:
        """Estimates of the framesets still held when the input has ended; the window's poses are final then."""
        if self._finished:
            return []
        estimates = []
        while (frameset := self._synchroniser.next_held()) is not None:
            estimates.append(self._estimate(frameset))
        if self._smoother is not None:
            self._smoothed += self._smoother.all_poses()
        self._frontend.close()
        self._finished = True
        return estimates

    def take_incidents(self) -> list[Incident]:
        """What happened since the last call that a person would want to know of."""
        taken, self._incidents = self._incidents, []
        return taken

    def take_smoothed(self) -> list[tuple[int, Float]]:
        """Stamps and poses ``nav_T_body`` that became final since the last call; not always in time order."""
        taken, self._smoothed = self._smoothed, []
        return taken

    # ------------------------------------------------------------------ one frameset

    @property
    def _running(self) -> Smoother:
        assert self._smoother is not None, "the odometry has started"
        return self._smoother

    def _estimate(self, frameset: FrameSet) -> Estimate:
        start = perf_counter()
        stamp_ns = frameset.stamp_ns
        if self._smoother is None and self._must_wait_for_imu(stamp_ns):
            visual = self._frontend.process(frameset, self._predicted_motion)
            return Estimate(stamp_ns, Status.INITIALISING, None, None, pairs=visual.pairs, stage_ms=visual.stage_ms)
        starting = self._must_start(stamp_ns)
        span = None
        if starting:
            self._start(stamp_ns)
        smoother = self._running
        if not starting:
            span = self._span(smoother.latest_ns, stamp_ns)
            if span is None and stamp_ns - smoother.latest_ns > _MAX_UNBRIDGED_S * 1e9:
                self._jump(stamp_ns)
            else:
                smoother.extend(stamp_ns, span)
        predicted = perf_counter()
        visual = self._frontend.process(frameset, self._predicted_motion)
        measured = perf_counter()
        if not starting:
            self._tell_of_vision(stamp_ns, visual)
        used = self._use(visual)
        status = self._update(stamp_ns, used, starting)
        stage_ms = {
            "predict": 1e3 * (predicted - start),
            **visual.stage_ms,
            "update": 1e3 * (perf_counter() - measured),
        }
        return self._assemble(stamp_ns, status, visual, span, stage_ms)

    def _predicted_motion(self, then_ns: int) -> Float | None:
        """``now_T_then`` of body between a state in the window and the newest one."""
        smoother = self._smoother
        if smoother is None or not smoother.knows(then_ns):
            return None
        return se3_inverse(smoother.pose(smoother.latest_ns)) @ smoother.pose(then_ns)

    def _use(self, visual: VisualResult) -> bool:
        """Gate a measured motion and insert it; a gate that refuses for too long is itself at fault."""
        smoother, motion = self._running, visual.motion
        if motion is None:
            return False
        if not smoother.knows(motion.reference_stamp_ns):  # it started anew since then
            self._frontend.rekey()
            return False
        if self._lost and motion.reference_stamp_ns > self._tracked_ns:  # not from a state that was known
            self._recover(motion)
            return True
        try:
            motion, verdict = self._judge(visual)
        except WindowError:
            return False  # `_update` meets the same error, and rebuilds
        if verdict.accepted:
            smoother.accept(motion)
            self._refused.clear()
            self._lost = False
            return True
        self._report(
            motion.stamp_ns,
            "vision_gated",
            f"innovation {verdict.statistic:.1f} beyond chi-square {verdict.threshold:.1f}, {motion.inliers} inliers",
        )
        if visual.quality is not Quality.GOOD:
            return False  # vision that contradicts itself cannot put the prediction in the wrong
        reference_ns = motion.reference_stamp_ns
        nav_T_reference = self._refused[reference_ns] if reference_ns in self._refused else smoother.pose(reference_ns)
        self._refused[motion.stamp_ns] = nav_T_reference @ motion.reference_T_current
        if motion.stamp_ns - min(self._refused) > self.config.smoother.max_gated_s * 1e9:
            self._believe_vision(motion)
            return True
        return False

    def _judge(self, visual: VisualResult) -> tuple[RelativeMotion, Verdict]:
        """The motion and its test; where pairs contradict each other, the side that the prediction clearly prefers."""
        assert visual.motion is not None
        verdicts = [(self._running.test(motion), motion) for motion in visual.alternatives]
        verdicts.sort(key=lambda judged: judged[0].statistic)
        if verdicts and verdicts[0][0].accepted and not verdicts[1][0].accepted:
            return verdicts[0][1], verdicts[0][0]
        return visual.motion, self._running.test(visual.motion)

    def _update(self, stamp_ns: int, used: bool, starting: bool) -> Status:
        """Optimise and marginalise; a window without a solution is rebuilt around the prediction."""
        smoother = self._running
        if used or starting:
            self._tracked_ns = stamp_ns
        state = smoother.state()
        try:
            self._smoothed += smoother.settle(self._frontend.reference_stamps_ns | {self._tracked_ns})
            self._pose_covariance = smoother.covariance()
            status = self._status(stamp_ns, used or starting)
        except WindowError as error:
            self._smoothed += [(ns, pose) for ns, pose in smoother.all_poses() if ns < stamp_ns]
            self._report(stamp_ns, "window_rebuilt", str(error))
            self._start_again(stamp_ns, state, self._pose_covariance + _AFTER_REBUILD)
            return Status.COASTING
        self._synchroniser.forget_before(stamp_ns)
        return status

    def _status(self, stamp_ns: int, used: bool) -> Status:
        if used:
            return Status.INITIALISING if stamp_ns < self._settled_ns else Status.TRACKING
        covariance = self._running.covariance_since(self._tracked_ns)
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
        if not self._lost and sigma > self.config.smoother.lost_position_sigma_m:
            self._lost = True
            self._report(stamp_ns, "lost", f"position uncertain by {sigma:.2f} m since vision was last used")
        return Status.LOST if self._lost else Status.COASTING

    # ------------------------------------------------------------------ starts and breaks

    def _must_start(self, stamp_ns: int) -> bool:
        """True at the first frameset, and where an IMU comes after a start without."""
        if self._smoother is None:
            return True
        if self._smoother.has_imu or self._synchroniser.initial_span(stamp_ns) is None:
            return False
        self._epoch += 1
        self._report(stamp_ns, "imu_came", f"the IMU has come: epoch {self._epoch} starts upright")
        return True

    def _start(self, stamp_ns: int) -> None:
        """Begin at a frameset, where the rig is thought to be, with what the IMU says of its attitude."""
        config = self.config.initialisation
        position = np.zeros(3)
        if self._smoother is not None:
            position = self._smoother.state().nav_T_body[:3, 3]
            self._smoothed += self._smoother.all_poses()
        found = self._synchroniser.initial_span(stamp_ns)
        if self.rig.imu is not None and found is None:
            self._report(stamp_ns, "started_without_imu", "no IMU samples came: vision alone from here")
        self._smoother = Smoother(self.config.smoother, self.rig.imu if found else None)
        if found is None:
            at = InitialAttitude(self._upright_camera(), 1e-3, np.zeros(3), 1.0, False)
            speed_sigma = _UNKNOWN_SPEED_SIGMA
            self._settled_ns = stamp_ns + 1  # the first frameset has no motion to track
        else:
            at = initial_attitude(*found, config)
            speed_sigma = _RESTING_START_SPEED_SIGMA if at.at_rest else _MOVING_START_SPEED_SIGMA
            if not at.at_rest:
                self._settled_ns = stamp_ns + round(config.settle_s * 1e9)
        self._smoother.start(
            stamp_ns,
            RigState(se3(at.nav_R_body, position), np.zeros(3), at.gyro_bias, np.zeros(3)),
            StartUncertainty(origin_covariance(at.nav_R_body, at.tilt_sigma_rad), speed_sigma, at.gyro_bias_sigma),
        )
        self._tracked_ns = stamp_ns
        self._refused.clear()
        self._lost = False

    def _upright_camera(self) -> Float:
        """``nav_R_body`` without an IMU: the first pair's left camera is taken to be upright."""
        return level(-self.rig.pairs[0].left.body_T_cam[:3, 1])

    def _must_wait_for_imu(self, stamp_ns: int) -> bool:
        """Before the IMU's first sample there is nothing to start from, unless it has been awaited for long."""
        if self._first_ns is None:
            self._first_ns = stamp_ns
        longest_ns = self.config.timing.max_imu_start_wait_s * 1e9
        return self._synchroniser.precedes_imu(stamp_ns) and stamp_ns - self._first_ns < longest_ns

    def _jump(self, stamp_ns: int) -> None:
        """After a gap that nothing bridges, be it a pause or a jump of the clock: a new epoch at the last pose."""
        smoother = self._running
        gap_s = (stamp_ns - smoother.latest_ns) * 1e-9
        self._smoothed += smoother.all_poses()
        self._start_again(stamp_ns, smoother.state(), self._pose_covariance + _AFTER_JUMP)
        self._epoch += 1
        self._report(stamp_ns, "time_jump", f"{gap_s:.1f} s without data: epoch {self._epoch} starts at the last pose")

    def _recover(self, motion: RelativeMotion) -> None:
        """After lost: a new epoch that starts at the best guess, the prediction, with the velocity that vision sees."""
        smoother = self._running
        self._smoothed += [(ns, pose) for ns, pose in smoother.all_poses() if ns <= self._tracked_ns]
        state = smoother.state()
        covariance = smoother.covariance()
        self._start_again(motion.stamp_ns, _with_velocity(state, motion), covariance)
        self._epoch += 1
        self._report(motion.stamp_ns, "new_epoch", f"vision is back: epoch {self._epoch} starts at the best guess")

    def _believe_vision(self, motion: RelativeMotion) -> None:
        """Refused motions that go on agreeing with each other put the prediction in the wrong.

        Their chain, which begins at a state that was accepted, is the pose from here on; by as much as it differs from
        the prediction it is uncertain.
        """
        smoother = self._running
        self._smoothed += [(ns, pose) for ns, pose in smoother.all_poses() if ns <= self._tracked_ns]
        predicted, by_vision = smoother.state(), self._refused[motion.stamp_ns]
        apart = se3_log(se3_inverse(by_vision) @ predicted.nav_T_body)
        covariance = smoother.covariance() + np.diag(apart**2)
        state = _with_velocity(replace(predicted, nav_T_body=by_vision), motion)
        self._start_again(motion.stamp_ns, state, covariance, _WIDE_GYRO_BIAS_SIGMA)
        self._report(
            motion.stamp_ns,
            "gate_reset",
            f"refused for too long, vision is believed now, {np.linalg.norm(apart[3:]):.3f} m from the prediction",
        )

    def _start_again(
        self, stamp_ns: int, state: RigState, pose_covariance: Float, gyro_bias_sigma: float = _GYRO_BIAS_SIGMA
    ) -> None:
        uncertainty = StartUncertainty(pose_covariance, _RESTART_SPEED_SIGMA, gyro_bias_sigma)
        self._running.start(stamp_ns, state, uncertainty)
        self._frontend.rekey()
        self._refused.clear()
        self._lost = False
        self._tracked_ns = stamp_ns

    # ------------------------------------------------------------------ what is told

    def _span(self, start_ns: int, end_ns: int) -> ImuSpan | None:
        if self._smoother is None or not self._smoother.has_imu:
            return None
        span = self._synchroniser.span(start_ns, end_ns)
        if span is None:
            self._report(end_ns, "imu_not_covering", "no IMU for this interval: constant velocity instead")
        return span

    def _assemble(
        self,
        stamp_ns: int,
        status: Status,
        visual: VisualResult,
        span: ImuSpan | None,
        stage_ms: dict[str, float],
    ) -> Estimate:
        smoother = self._running
        state = smoother.state()
        honest = status is not Status.LOST
        inertial = smoother.has_imu
        return Estimate(
            stamp_ns=stamp_ns,
            status=status,
            nav_T_body=state.nav_T_body if honest else None,
            covariance=self._pose_covariance if honest else None,
            epoch=self._epoch,
            velocity_nav=state.velocity_nav if honest else None,
            gyro_bias=state.gyro_bias if inertial else None,
            accel_bias=state.accel_bias if inertial else None,
            rates=self._rates.update(visual.motion, span, state.gyro_bias, smoother.latest_rate()),
            vision=visual.quality,
            vision_reason=visual.reason,
            at_rest=visual.at_rest and (span is None or is_at_rest(span, self.config.initialisation)),
            pairs=visual.pairs,
            stage_ms=stage_ms,
        )

    def _tell_of_vision(self, stamp_ns: int, visual: VisualResult) -> None:
        if visual.quality is not Quality.GOOD:
            self._report(stamp_ns, f"vision_{visual.quality}", visual.reason)
        for j, misalignment in self._frontend.misaligned.items():
            if j in self._told_misaligned:
                continue
            self._told_misaligned.add(j)
            d = misalignment.tangent
            self._report(
                stamp_ns,
                "extrinsics_off",
                f"pair {self.rig.pairs[j].name} is {np.rad2deg(np.linalg.norm(d[:3])):.2f} deg and "
                f"{np.linalg.norm(d[3:]):.3f} m from where the rig has it, as its motion against the first pair's "
                f"tells (chi-square {misalignment.statistic:.0f}); corrected for this run: calibrate the rig",
            )

    def _report(self, stamp_ns: int, kind: str, detail: str) -> None:
        self._incidents.append(Incident(stamp_ns, kind, detail))


def _with_velocity(state: RigState, motion: RelativeMotion) -> RigState:
    """The state with the mean velocity of a measured motion."""
    duration_s = (motion.stamp_ns - motion.reference_stamp_ns) * 1e-9
    nav_R_reference = state.nav_T_body[:3, :3] @ motion.reference_T_current[:3, :3].T
    return replace(state, velocity_nav=nav_R_reference @ motion.reference_T_current[:3, 3] / duration_s)
