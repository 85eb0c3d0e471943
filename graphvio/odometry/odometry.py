"""The odometry: IMU samples and framesets in, estimates out. The algorithm of the paper, and no I/O."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from time import perf_counter

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.ekf.estimator import FilterEstimator
from graphvio.backend.estimator import StateEstimator
from graphvio.backend.inertial import NO_SAMPLES
from graphvio.backend.initialisation import is_at_rest
from graphvio.backend.propagation import Propagator
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.config import Config
from graphvio.errors import ConfigError, MeasurementError
from graphvio.frontend.visual import VisualFrontend
from graphvio.geometry import se3_inverse
from graphvio.measurements.estimate import Estimate, Prediction, Status
from graphvio.measurements.events import Event
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement, checked_measurement
from graphvio.measurements.step import Step
from graphvio.odometry.angular_rates import AngularRates
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.odometry.time_offset_correction import OffsetCorrection
from graphvio.odometry.vision_events import VisionReports
from graphvio.rig import Rig
from graphvio.slam.keyframe import CorrectionResult, Keyframe
from graphvio.slam.keyframes import Keyframes


class Odometry:
    """Visual-inertial odometry of a rig of stereo pairs.

    Feed measurements in time order with `process`. It holds a frameset until the IMU samples that cover it have come.
    With more than one pair, OpenCV's own threads are switched off in this process: pairs run side by side instead.

    Args:
        rig: cameras and IMU; without an IMU, vision alone is used.
        config: of all stages.
        on_prediction: is called with what is predicted at each sample of the IMU as it comes, within `process`.
        on_step: is called with what went into each estimate that rests on a start, before it is returned.
    """

    def __init__(
        self,
        rig: Rig,
        config: Config | None = None,
        on_prediction: Callable[[Prediction], None] | None = None,
        on_step: Callable[[Step], None] | None = None,
    ) -> None:
        self.rig = rig
        self.config = config or Config()
        self._frontend = VisualFrontend(rig, self.config)
        self._synchroniser = Synchroniser(rig, self.config, self._report)
        kind = FilterEstimator if self.config.fusion.estimator == "filter" else SmootherEstimator
        self._estimator: StateEstimator = kind(rig, self.config, self._report, lambda: self._frontend.rekey())
        self._propagator = Propagator(self.config.timing.max_prediction_ms, self.config.timing.max_imu_gap_ms)
        self._on_prediction = on_prediction
        self._on_step = on_step
        self._time_offset = OffsetCorrection(rig, self.config, self._synchroniser, self._report)
        self._keyframes = Keyframes(rig, self.config)
        self._vision_reports = VisionReports(rig, self._report)
        self._rates = AngularRates()
        self._events: deque[Event] = deque()  # appended to by any thread that corrects
        self._first_ns: int | None = None
        self._newest_ns = 0  # stamp of the newest frameset that was worked on
        self._finished = False

    def process(self, measurement: Measurement) -> Estimate | None:
        """Take one measurement.

        Returns:
            The estimate of the oldest frameset that is due, or None while there is none. At most one frameset is
            worked on in a call; what is still held comes with later measurements or with `finish`.

        Raises:
            MeasurementError: if the measurement is malformed, or the odometry has been finished.
            RigError: if an image is not what the rig says.
        """
        if self._finished:
            raise MeasurementError("the odometry has been finished; make a new one for more measurements")
        measurement = checked_measurement(measurement)
        if isinstance(measurement, ImuSample):
            for sample in self._synchroniser.add_sample(measurement):
                self._go_on(sample)
        else:
            self._synchroniser.add_frameset(measurement)
        return self.process_due()

    def process_due(self) -> Estimate | None:
        """The estimate of the oldest frameset that is held though it is due, or None while there is none: after
        `process`, where several became due at once and later measurements are not to be waited for."""
        frameset = self._synchroniser.next_due(started=self._estimator.has_started)
        return None if frameset is None else self._estimate(frameset)

    @property
    def held_ns(self) -> int | None:
        """Stamp of the oldest frameset that is held until the IMU covers it, or None."""
        return self._synchroniser.held_ns

    def process_held(self) -> Estimate | None:
        """The estimate of the oldest frameset that is held, or None while there is none: for real time, where it cannot
        wait for the IMU any longer. Samples that come later are used for the motion from it on."""
        frameset = self._synchroniser.next_held()
        return None if frameset is None else self._estimate(frameset)

    def finish(self) -> list[Estimate]:
        """Estimates of the framesets still held when the input has ended; the window's poses are final then."""
        if self._finished:
            return []
        estimates = []
        while (frameset := self._synchroniser.next_held()) is not None:
            estimates.append(self._estimate(frameset))
        self._estimator.end()
        self._frontend.close()
        self._keyframes.log.close()
        self._finished = True
        return estimates

    def predict(self, stamp_ns: int) -> Prediction | None:
        """Where the rig is, by the newest estimate and the IMU since then; any thread may ask.

        Args:
            stamp_ns: on the framesets' clock: an IMU sample's stamp less the rig's time offset.

        Returns:
            None before the first pose and while lost, before the newest estimate's instant, and farther beyond the
            newest sample (without an IMU, beyond the newest estimate) than ``timing.max_prediction_ms``; after a gap
            of the samples and after 5 s without a frameset, until the next one.
        """
        return self._propagator.predict(stamp_ns)

    def take_events(self) -> list[Event]:
        """What happened since the last call that a person would want to know of."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def take_smoothed(self) -> list[tuple[int, Float]]:
        """Stamps and poses ``nav_T_body`` that became final since the last call; not always in time order."""
        return self._estimator.take_final()

    def limit_corners(self, share: float) -> None:
        """Follow only a share, above 0 and up to 1, of the corners that the configuration asks for, from now on: for
        real time, where time does not suffice. From the thread that calls `process`.

        Raises:
            ConfigError: if it is no such share.
        """
        if not 0.0 < share <= 1.0:
            raise ConfigError(f"a share of {share} of the corners cannot be followed; give more than 0, and at most 1")
        self._frontend.limit_corners(share)

    # ------------------------------------------------------------------ for SLAM

    def on_keyframe(self, callback: Callable[[Keyframe], None]) -> None:
        """Have each keyframe from now on handed to a callback, within `process`: it had better return soon."""
        self._keyframes.call(callback)

    def keyframes(self, from_id: int = 0) -> Iterator[Keyframe]:
        """Keyframes from now on as they come, each waited for, until `finish`; for a thread of its own.

        Args:
            from_id: where to begin, or to go on. Ids that are passed over were no longer kept: see `KeyframeLog`.
        """
        return self._keyframes.follow(from_id)

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """Say where a keyframe is in the map; any thread may. `map_T_odom` moves, and nothing else.

        Args:
            keyframe_id: of it, however long ago in this epoch: what came since then is carried forward.
            map_T_body: (4, 4) of body there.
            covariance: (6, 6), tangent ``[rotation, translation]`` in body.

        Returns:
            Whether it was believed. One that is far from expected is refused by chi-square and reported, until several
            in a row agree with each other.

        Raises:
            MeasurementError: if the pose is not rigid, or the covariance is none.
        """
        result = self._keyframes.map_frame.correct(keyframe_id, map_T_body, covariance)
        if result.reason:
            kind = "map_moved" if result.accepted else "correction_refused"
            self._report(self._newest_ns, kind, result.reason)
        return result

    @property
    def map_T_odom(self) -> Float | None:
        """(4, 4) of the newest epoch's odom frame, which is nav, in the map (REP 105), or None before a correction."""
        return self._keyframes.map_frame.map_T_odom

    def map_T_body(self, stamp_ns: int) -> Float | None:
        """Where the rig is in the map (4, 4), or None where `predict` has no pose or the map is not known."""
        prediction = self.predict(stamp_ns)
        map_T_odom = None if prediction is None else self._keyframes.map_frame.of_epoch(prediction.epoch)
        return None if prediction is None or map_T_odom is None else map_T_odom @ prediction.nav_T_body

    # ------------------------------------------------------------------ one frameset

    def _estimate(self, frameset: FrameSet) -> Estimate:
        """Start or predict, measure the motion, gate and insert it, update."""
        start = perf_counter()
        stamp_ns = self._newest_ns = frameset.stamp_ns
        if self._must_wait_for_imu(stamp_ns):
            return self._without_pose(stamp_ns, self._frontend.process(frameset, self._estimator.motion_since))
        starting, interval, starts = self._must_start(stamp_ns), None, self._estimator.starts
        if starting:
            self._estimator.start(stamp_ns, self._synchroniser.initial_interval(stamp_ns))
        else:
            interval = self._interval(self._estimator.latest_ns, stamp_ns)
            self._estimator.predict(stamp_ns, interval)
        predicted = perf_counter()
        visual = self._frontend.process(frameset, self._estimator.motion_since)
        measured = perf_counter()
        if not starting:
            self._vision_reports.update(stamp_ns, visual, self._frontend.misaligned)
        at_rest = visual.at_rest and self._imu_is_at_rest(interval)
        motion = self._estimator.use(visual, at_rest)
        used = motion is not None or starting
        before_ns = self._keyframes.previous_ns
        kept = self._frontend.reference_stamps_ns | (set() if before_ns is None else {before_ns})
        status = self._estimator.update(stamp_ns, used, kept)
        self._keyframes.map_frame.begin(self._estimator.epoch)
        references = self._frontend.reference_stamps_ns  # others than before where the window was rebuilt
        self._synchroniser.forget_before(stamp_ns)
        self._predict_from(stamp_ns, status)
        self._time_offset.update(stamp_ns, visual)
        stage_ms = {
            "predict": 1e3 * (predicted - start),
            **visual.stage_ms,
            "update": 1e3 * (perf_counter() - measured),
        }
        estimate = self._assemble(stamp_ns, status, visual, interval, at_rest, stage_ms)
        if self._on_step is not None:
            refused = None if visual.quality is not Quality.GOOD else visual.motion
            self._on_step(
                Step(
                    estimate,
                    refused if motion is None else motion,
                    used=motion is not None,
                    interval=interval,
                    started=self._estimator.starts != starts,
                    own={} if motion is None else visual.own,
                    references=references,
                )
            )
        if stamp_ns in references:
            self._add_keyframe(estimate, frameset, before_ns)
        return estimate

    def _add_keyframe(self, estimate: Estimate, frameset: FrameSet, before_ns: int | None) -> None:
        """A frameset from which later motions are measured, with the motion since the one before."""
        motion = None
        if before_ns is not None:
            now_T_before, covariance = (
                self._estimator.motion_since(before_ns),
                self._estimator.covariance_since(before_ns),
            )
            if now_T_before is not None and covariance is not None:
                motion = se3_inverse(now_T_before), covariance
        self._keyframes.add(
            estimate,
            self._frontend.frames_at(estimate.stamp_ns),
            frameset.images,
            self._frontend.body_T_left,
            motion,
        )

    def _imu_is_at_rest(self, interval: ImuInterval | None) -> bool:
        """What the IMU says of a standstill; it does not object where there is none, but where its samples lack."""
        if interval is None:
            return not self._estimator.has_imu
        return is_at_rest(interval, self.config.initialisation)

    def _must_wait_for_imu(self, stamp_ns: int) -> bool:
        """Before the IMU's first sample there is nothing to start from, unless it has been awaited for long."""
        if self._estimator.has_started:
            return False
        if self._first_ns is None:
            self._first_ns = stamp_ns
        longest_ns = self.config.timing.max_imu_start_wait_s * 1e9
        return self._synchroniser.precedes_imu(stamp_ns) and stamp_ns - self._first_ns < longest_ns

    def _must_start(self, stamp_ns: int) -> bool:
        """True at the first frameset, and where an IMU comes after a start without."""
        if self._estimator.has_imu:
            return False
        return not self._estimator.has_started or self._synchroniser.initial_interval(stamp_ns) is not None

    def _predict_from(self, stamp_ns: int, status: Status) -> None:
        """Predictions go on from a new estimate."""
        if status is Status.LOST:
            self._propagator.forget()
            return
        estimator, rate = self._estimator, self._estimator.latest_rate()
        samples = self._synchroniser.samples_since(stamp_ns) if estimator.has_imu else NO_SAMPLES
        self._propagator.restart(
            stamp_ns, estimator.state(), estimator.epoch, np.zeros(3) if rate is None else rate, *samples
        )

    def _go_on(self, sample: ImuSample) -> None:
        """Predictions go on by a sample."""
        values = np.concatenate([sample.angular_velocity, sample.linear_acceleration])
        prediction = self._propagator.add(sample.stamp_ns, values)
        if prediction is not None and self._on_prediction is not None:
            self._on_prediction(prediction)

    def _interval(self, start_ns: int, end_ns: int) -> ImuInterval | None:
        """The IMU between two framesets, or None where it does not cover them."""
        if not self._estimator.has_imu:
            return None
        interval = self._synchroniser.interval(start_ns, end_ns)
        if interval is None:
            self._report(end_ns, "imu_not_covering", "no IMU for this interval: constant velocity instead")
        return interval

    # ------------------------------------------------------------------ what is told

    def _without_pose(self, stamp_ns: int, visual: VisualResult) -> Estimate:
        return Estimate(
            stamp_ns,
            Status.INITIALISING,
            None,
            None,
            vision=visual.quality,
            vision_reason=visual.reason,
            pairs=visual.pairs,
            stage_ms=visual.stage_ms,
        )

    def _assemble(
        self,
        stamp_ns: int,
        status: Status,
        visual: VisualResult,
        interval: ImuInterval | None,
        at_rest: bool,
        stage_ms: dict[str, float],
    ) -> Estimate:
        estimator = self._estimator
        state, known = estimator.state(), estimator.covariance
        honest = status is not Status.LOST
        return Estimate(
            stamp_ns=stamp_ns,
            status=status,
            nav_T_body=state.nav_T_body if honest else None,
            covariance=known.pose if honest else None,
            epoch=estimator.epoch,
            velocity_nav=state.velocity_nav if honest else None,
            gyro_bias=state.gyro_bias if estimator.has_imu else None,
            accel_bias=state.accel_bias if estimator.has_imu else None,
            velocity_covariance=known.velocity if honest else None,
            gyro_bias_covariance=known.gyro_bias,
            accel_bias_covariance=known.accel_bias,
            time_offset_s=self._time_offset.offset_s,
            time_offset_sigma_s=self._time_offset.sigma_s,
            innovations=estimator.gate_results,
            rates=self._rates.update(visual.motion, interval, state.gyro_bias, estimator.latest_rate()),
            vision=visual.quality,
            vision_reason=visual.reason,
            vision_sigmas=None if visual.motion is None else visual.motion.weakest_sigmas,
            at_rest=at_rest,
            pairs=visual.pairs,
            stage_ms=stage_ms,
        )

    @property
    def rig_warnings(self) -> list[str]:
        """What the motions until now refute of the rig, a sentence each, with its size and one standard deviation."""
        return self._vision_reports.rig_warnings

    def _report(self, stamp_ns: int, kind: str, detail: str) -> None:
        self._events.append(Event(stamp_ns, kind, detail))
