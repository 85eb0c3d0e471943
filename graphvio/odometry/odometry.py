"""The odometry, which turns IMU samples and framesets into estimates, without I/O.

The main loop has the structure of the paper's figure 3; each of its stages may differ from the paper's."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.ekf.estimator import FilterEstimator
from graphvio.backend.estimator import MeasurementUpdate, StateEstimator
from graphvio.backend.inertial import NO_SAMPLES
from graphvio.backend.propagation import Propagator
from graphvio.backend.smoother_estimator import SmootherEstimator
from graphvio.config import Config
from graphvio.errors import ConfigError, MeasurementError
from graphvio.frontend.imaging.images import ImageMask
from graphvio.frontend.singles import SinglesFrontend
from graphvio.frontend.tracking_frontend import TrackingFrontend
from graphvio.frontend.visual import VisualFrontend
from graphvio.measurements.estimate import Estimate, Prediction, Status
from graphvio.measurements.events import CORRECTED, Event
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement, calibrated_sample, checked_measurement
from graphvio.measurements.window_views import FirstWindow, WindowViews
from graphvio.monocular.estimator import MonocularEstimator
from graphvio.odometry.angular_rates import AngularRates
from graphvio.odometry.assembly import (
    at_stamp,
    estimate_by_measurements,
    estimate_without_pose,
    keyframe_of,
    with_state,
)
from graphvio.odometry.fixed_calibration import FixedCalibration
from graphvio.odometry.frameset_imu import FramesetImu
from graphvio.odometry.group_clocks import GroupClocks
from graphvio.odometry.imu_clock import with_late_clock
from graphvio.odometry.nav_frame import NavFrame
from graphvio.odometry.online_calibration import OnlineCalibration
from graphvio.odometry.pairs_calibration import PairsCalibration
from graphvio.odometry.rig_mistakes import RigMistakes
from graphvio.odometry.singles_calibration import SinglesCalibration
from graphvio.odometry.step import Step
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.odometry.time_offset_correction import TimeOffsetCorrection
from graphvio.odometry.vision_events import VisionEvents
from graphvio.rig import Rig
from graphvio.self_calibration.collector import FullWindow
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.findings import Finding
from graphvio.timing import timed


class _Predicted(NamedTuple):
    """The origin of the state at a frameset's instant: an initialisation or a prediction."""

    stamp_ns: int
    is_initial: bool  # whether it was initialised there, not predicted
    interval: ImuInterval | None
    initialisations: int  # number of initialisations before it


def _check_config(rig: Rig, config: Config) -> None:
    """Check that the rig has what the configuration asks for.

    Raises:
        ConfigError: If the configuration asks for sensors that the rig does not have.
    """
    if not rig.pairs and (config.fusion.estimator == "filter" or config.fusion.estimate_time_offset):
        raise ConfigError(
            "the paper's filter and the estimation of the time offset need a stereo pair, and the rig has none; use "
            "fusion.estimator: smoother and fusion.estimate_time_offset: false"
        )


def _frontend_class(rig: Rig) -> type[VisualFrontend | SinglesFrontend]:
    return VisualFrontend if rig.pairs else SinglesFrontend


def _estimator_class(rig: Rig, config: Config) -> type[SmootherEstimator | FilterEstimator | MonocularEstimator]:
    if not rig.pairs:
        return MonocularEstimator
    return FilterEstimator if config.fusion.estimator == "filter" else SmootherEstimator


class Odometry:
    """Visual-inertial odometry of a rig of stereo pairs and single cameras.

    Feed measurements in time order with `process`. A frameset is held until the IMU samples that cover it have come; at
    the end, `finish` returns the estimates of those that are still held.

    Args:
        rig: Cameras and IMU; without an IMU, vision alone is used.
        config: Configuration of all stages.
        on_prediction: Called with the prediction at each IMU sample, within `process`.
        image_mask: Called with a camera's name and each of its images (height, width), from several threads; returns
            a mask of that size, whose zeros are not used, or None. No corners are detected in masked pixels, and tracks
            that enter them end.

    Attributes:
        rig: Cameras and IMU.
        config: Configuration of all stages.
        stage_ms: Processing time by stage of the newest frameset, milliseconds.
    """

    def __init__(
        self,
        rig: Rig,
        config: Config | None = None,
        on_prediction: Callable[[Prediction], None] | None = None,
        image_mask: ImageMask | None = None,
    ) -> None:
        self.rig = rig
        self.config = config or Config()
        _check_config(rig, self.config)
        self.stage_ms: dict[str, float] = {}
        self._frontend: TrackingFrontend = _frontend_class(rig)(rig, self.config, image_mask)
        self._synchroniser = Synchroniser(rig, self.config, self.report)
        self._estimator: StateEstimator = _estimator_class(rig, self.config)(rig, self.config, self.report)
        self._imu = FramesetImu(rig, self.config, self._synchroniser, self._estimator, self.report)
        self._propagator = Propagator(self.config.timing.max_prediction_ms, self.config.timing.max_imu_gap_ms)
        self._time_offset = TimeOffsetCorrection(rig, self.config, self._synchroniser, self.report)
        self._clocks = GroupClocks(rig, self.config, self._synchroniser, self.report)
        self._calibration = self._new_calibration()
        self._nav = NavFrame()
        self._vision_events = VisionEvents(rig, self.report)
        self._mistakes = RigMistakes(rig, self.config, self.report)
        self._rates = AngularRates()
        self._on_prediction = on_prediction
        self._on_step: list[Callable[[Step], None]] = []
        self._on_finish: list[Callable[[], None]] = []
        self._events: deque[Event] = deque()  # appended to by any thread
        self._keyframe_ns: int | None = None  # stamp of the newest frameset that motions are measured from
        self._finished = False

    def _new_calibration(self) -> OnlineCalibration:
        rig, frontend, estimator = self.rig, self._frontend, self._estimator
        if not self.config.estimates_calibration:
            return FixedCalibration()
        if isinstance(estimator, MonocularEstimator) and isinstance(frontend, SinglesFrontend):
            return SinglesCalibration(rig, frontend, self._synchroniser, estimator, self.report)
        assert isinstance(frontend, VisualFrontend)
        return PairsCalibration(rig, self.config, frontend, self._synchroniser, estimator, self.report)

    # ------------------------------------------------------------------ measurements in, estimates out

    def process(self, measurement: Measurement) -> Estimate | None:
        """Feed one IMU sample or frameset, and return at most one estimate.

        Args:
            measurement: An IMU sample or a frameset; those of each sensor in time order. The stamp of a frameset is
                taken as the instant of its images: the source has already added the cameras' ``stamp_offset_s``.

        Returns:
            The estimate of the oldest frameset that is due, or None while there is none. At most one frameset is
            processed in a call; the estimates of those still held come with later measurements or with `finish`.

        Raises:
            MeasurementError: If the measurement is malformed, or the odometry has been finished.
            RigError: If an image does not fit the rig.
        """
        if self._finished:
            raise MeasurementError("the odometry has been finished; make a new one for more measurements")
        measurement = checked_measurement(measurement)
        if isinstance(measurement, ImuSample):
            if self.rig.imu is not None and self.rig.imu.has_matrices:
                measurement = calibrated_sample(measurement, self.rig.imu)
            for sample in self._synchroniser.add_sample(measurement):
                self._add_sample(sample)
        else:
            self._synchroniser.add_frameset(measurement)
        return self.process_due()

    def process_due(self) -> Estimate | None:
        """Process the oldest held frameset that is due.

        `process` handles at most one frameset a call. To handle all that are due at once, call this until it returns
        None.

        Returns:
            Its estimate, or None if no frameset is due.
        """
        frameset = self._synchroniser.next_due(initialised=self._estimator.is_initialised)
        return None if frameset is None else self._estimate(frameset)

    @property
    def held_ns(self) -> int | None:
        """Stamp of the oldest frameset that is held until the IMU covers it, or None."""
        return self._synchroniser.held_ns

    def process_held(self) -> Estimate | None:
        """Process the oldest held frameset, without waiting for its IMU samples.

        This is meant for real time; samples that come later are used for the motion after it.

        Returns:
            Its estimate, or None if no frameset is held.
        """
        frameset = self._synchroniser.next_held()
        return None if frameset is None else self._estimate(frameset)

    def finish(self) -> list[Estimate]:
        """Return the estimates of the framesets still held when the input has ended; all poses are final then."""
        if self._finished:
            return []
        for sample in self._synchroniser.last_samples():
            self._add_sample(sample)
        estimates = []
        while (frameset := self._synchroniser.next_held()) is not None:
            estimates.append(self._estimate(frameset))
        self._synchroniser.finish()
        self._estimator.finish()
        self._frontend.close()
        self._calibration.close()
        for on_finish in self._on_finish:
            on_finish()
        self._finished = True
        return estimates

    def predict(self, stamp_ns: int) -> Prediction | None:
        """Predict the rig's state from the newest estimate and the IMU since then; thread-safe.

        Args:
            stamp_ns: Instant on the framesets' clock: an IMU sample's stamp less the rig's time offset.

        Returns:
            The state, or None: before the first pose, and while lost; for an instant before the newest estimate; for
            one more than ``timing.max_prediction_ms`` beyond the newest sample (without an IMU, the newest estimate);
            and after a gap in the samples, or 5 s without a frameset, until the next one.
        """
        return self._propagator.predict(stamp_ns)

    def take_events(self) -> list[Event]:
        """Return the events since the last call."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def take_smoothed(self) -> list[tuple[int, Float]]:
        """Return stamps and poses ``nav_T_body`` that became final since the last call, not always in time order."""
        return [
            (stamp_ns, self._nav.pose(stamp_ns, self._clocks.final_at_stamp(stamp_ns, pose)))
            for stamp_ns, pose in self._estimator.take_final()
        ]

    @property
    def rig_warnings(self) -> list[str]:
        """Warnings where the measurements contradict the rig: a sentence each, with size and what is done about it."""
        off = [f"{finding}; {CORRECTED}" for finding in self.calibration_findings if finding.is_significant]
        return (
            self._vision_events.rig_warnings
            + self._mistakes.warnings
            + off
            + self._calibration.warnings
            + self._imu.warnings
            + self._clocks.warnings
        )

    @property
    def calibration(self) -> CalibrationEstimate | None:
        """The present estimate of the calibration, or None where it is not estimated."""
        return self._calibration.estimate

    @property
    def calibration_findings(self) -> list[Finding]:
        """The present findings for each part of the calibration; empty where it is not estimated."""
        return self._calibration.findings

    @property
    def refined_rig(self) -> Rig | None:
        """The rig with the present estimate of its calibration; None where nothing is estimated, or known yet."""
        estimate = self._calibration.estimate
        if estimate is None and not self.clock_shift_s:
            return None
        return with_late_clock(self.rig if estimate is None else estimate.rig, self.clock_shift_s)

    @property
    def clock_shift_s(self) -> float:
        """Time, s, by which the IMU's stamps were found to be later than by the rig's time offset, see `ImuClock`."""
        return self._imu.clock_shift_s

    def on_full_window(self, on_window: Callable[[FullWindow], None]) -> None:
        """Register a function that receives the measurements of each full window of the self-calibration.

        Args:
            on_window: called within `process`.
        """
        self._calibration.on_full_window(on_window)

    def on_views(self, on_views: Callable[[WindowViews | FirstWindow], None]) -> None:
        """Register a function that receives each view of a landmark once; for rigs of single cameras only.

        Args:
            on_views: called within `process` and `finish`, when landmarks leave the window; and once in an epoch with
                what was known of its first states before its first pose.
        """
        if isinstance(self._estimator, MonocularEstimator):
            self._estimator.on_views(on_views)

    def limit_corners(self, share: float) -> None:
        """Track fewer corners from now on, where real time demands it; to be called from the thread of `process`.

        Args:
            share: Share of the corners that the configuration asks for, above 0 and up to 1.

        Raises:
            ConfigError: If ``share`` is not in this range.
        """
        if not 0.0 < share <= 1.0:
            raise ConfigError(f"share of the corners: is {share}; give more than 0, and at most 1")
        self._frontend.limit_corners(share)

    def subscribe(self, on_step: Callable[[Step], None], on_finish: Callable[[], None] | None = None) -> None:
        """Register functions that are called after each frameset, in the thread that calls `process`: keep them short.

        Args:
            on_step: Called with each step from now on, before its estimate is returned.
            on_finish: Called when no step follows.
        """
        self._on_step.append(on_step)
        if on_finish is not None:
            self._on_finish.append(on_finish)

    def report(self, stamp_ns: int, kind: str, detail: str) -> None:
        """Add an event to those that `take_events` returns; thread-safe.

        Args:
            stamp_ns: when it happened, nanoseconds.
            kind: one of `EventKind`, or a name of your own.
            detail: what happened, in one line.
        """
        self._events.append(Event(stamp_ns, kind, detail))

    # ------------------------------------------------------------------ one frameset

    def _estimate(self, frameset: FrameSet) -> Estimate:
        """Predict the state, measure the motion, gate it, update, recalibrate, and publish (sections 3 and 5)."""
        self.stage_ms = {}
        if self._imu.is_awaited(frameset.stamp_ns):
            return self._track_without_state(frameset)
        predicted = self._predict(frameset.stamp_ns)
        visual = self._track(frameset, predicted)
        is_stationary = visual.is_stationary and self._imu.shows_standstill(predicted.interval)
        applied = self._gate(visual, is_stationary)
        status = self._update(predicted, applied)
        self._watch_clocks(frameset, predicted, visual, applied)
        self._recalibrate(frameset.stamp_ns, visual, status)
        self._restart_prediction(frameset.stamp_ns, status)
        if not self._estimator.has_pose:
            return estimate_without_pose(frameset.stamp_ns, visual, self.stage_ms)
        return self._publish(frameset, predicted, visual, is_stationary, applied, status)

    def _track_without_state(self, frameset: FrameSet) -> Estimate:
        """Track the corners while the state cannot be initialised, since the IMU's first sample is awaited."""
        visual = self._frontend.process(frameset, self._estimator.motion_since)
        self.stage_ms.update(visual.stage_ms)
        return estimate_without_pose(frameset.stamp_ns, visual, self.stage_ms)

    @timed("predict")
    def _predict(self, stamp_ns: int) -> _Predicted:
        """Initialise the state at a frameset, or predict it there.

        The prediction is by preintegration, or without IMU samples by constant velocity (eq. 11, 12).
        """
        initialisations = self._estimator.initialisations
        if self._imu.begins(stamp_ns):
            self._estimator.initialise(stamp_ns, self._synchroniser.initial_interval(stamp_ns))
            return _Predicted(stamp_ns, True, None, initialisations)
        interval = self._imu.interval(self._estimator.latest_ns, stamp_ns)
        if self._estimator.predict(stamp_ns, interval):
            self._frontend.start_keyframe()
        return _Predicted(stamp_ns, False, interval, initialisations)

    def _track(self, frameset: FrameSet, predicted: _Predicted) -> VisualResult:
        """Track all pairs and measure the relative motion, eq. (1) to (4)."""
        readout = self._imu.readout_motion(frameset.stamp_ns)
        visual = self._frontend.process(frameset, self._estimator.motion_since, readout, self._imu.gyro_rotation_since)
        if not predicted.is_initial:
            self._vision_events.update(frameset.stamp_ns, visual, self._frontend.extrinsic_errors)
            self._mistakes.update(frameset, visual)
        self.stage_ms.update(visual.stage_ms)
        return visual

    @timed("update")
    def _gate(self, visual: VisualResult, is_stationary: bool) -> MeasurementUpdate:
        """Test the innovations, and insert the measurements that pass (section 5)."""
        applied = self._estimator.apply(self._calibration.with_calibration_covariance(visual), is_stationary)
        if applied.needs_keyframe:
            self._frontend.start_keyframe()
        return applied

    @timed("update")
    def _update(self, predicted: _Predicted, applied: MeasurementUpdate) -> Status:
        """Solve for the state, and drop the tracks of points that prove to move."""
        # `keyframe_of` asks for the motion since the previous keyframe, so its state must stay in the window.
        previous_keyframe = set() if self._keyframe_ns is None else {self._keyframe_ns}
        update = self._estimator.update(
            predicted.stamp_ns,
            is_constrained=predicted.is_initial or applied.motion is not None,
            keep=self._frontend.reference_stamps_ns | previous_keyframe,
        )
        if update.needs_keyframe:
            self._frontend.start_keyframe()
        self._frontend.drop(update.outliers)
        return update.status

    @timed("update")
    def _watch_clocks(
        self, frameset: FrameSet, predicted: _Predicted, visual: VisualResult, applied: MeasurementUpdate
    ) -> None:
        """Leave the IMU out while it contradicts vision, and update the time offsets."""
        stamp_ns = predicted.stamp_ns
        is_imu_changed = self._imu.watch(stamp_ns, predicted.interval, visual, applied.motion)
        if is_imu_changed:
            self._clocks.restart()
        if self._clocks.update(frameset, visual) or is_imu_changed:
            self._frontend.start_keyframe()
            self._calibration.restart_imu()
        self._synchroniser.forget_before(stamp_ns)
        self._time_offset.update(stamp_ns, visual)

    def _recalibrate(self, stamp_ns: int, visual: VisualResult, status: Status) -> None:
        """Update the calibration with a frameset, and use the new one if it has changed."""
        self._calibration.add(stamp_ns, visual.quality, status)
        old_R_new = self._calibration.update(stamp_ns)
        if old_R_new is not None:
            turned = self._nav.turn(stamp_ns, self._estimator.state().nav_T_body, old_R_new)
            self._calibration.correct_pose(turned)

    def _publish(
        self,
        frameset: FrameSet,
        predicted: _Predicted,
        visual: VisualResult,
        is_stationary: bool,
        applied: MeasurementUpdate,
        status: Status,
    ) -> Estimate:
        """Assemble the estimate, and pass the step to the subscribers."""
        estimator, interval = self._estimator, predicted.interval
        rates = self._rates.update(visual.motion, interval, estimator.state().gyro_bias, estimator.latest_rate())
        measured = estimate_by_measurements(
            frameset.stamp_ns, status, visual, is_stationary, rates, self._time_offset, self.stage_ms
        )
        estimate = with_state(measured, estimator, self._calibration, self._nav)
        to_stamp = self._clocks.motion_to_stamp(frameset.stamp_ns, estimator.state(), estimator.latest_rate())
        estimate = estimate if to_stamp is None else at_stamp(estimate, to_stamp)
        references = self._frontend.reference_stamps_ns
        keyframe = None
        if frameset.stamp_ns in references:
            keyframe = keyframe_of(frameset, self._frontend, estimator, self._nav, self._keyframe_ns)
            self._keyframe_ns = frameset.stamp_ns
        candidate = visual.motion if visual.quality is Quality.GOOD else None
        motion, partial_motion = applied.motion or candidate, applied.partial_motion
        step = Step(
            estimate,
            motion=None if motion is None else motion.with_any_velocity(),
            used=applied.motion is not None,
            interval=interval,
            initialised=estimator.initialisations != predicted.initialisations,
            references=references,
            own={} if applied.motion is None else visual.own,
            keyframe=keyframe,
            partial_motion=None if partial_motion is None else partial_motion.with_any_velocity(),
        )
        for on_step in self._on_step:
            on_step(step)
        return estimate

    # ------------------------------------------------------------------ prediction

    @timed("update")
    def _restart_prediction(self, stamp_ns: int, status: Status) -> None:
        """Predict from the new estimate from now on."""
        if status is Status.LOST or not self._estimator.has_pose:
            self._propagator.forget()
            return
        estimator, rate = self._estimator, self._estimator.latest_rate()
        has_imu = estimator.has_imu and not self._imu.is_left_out
        samples = self._synchroniser.samples_since(stamp_ns) if has_imu else NO_SAMPLES
        self._propagator.restart(
            self._synchroniser.instant_ns(stamp_ns),
            self._nav.state(estimator.state()),
            estimator.epoch,
            np.zeros(3) if rate is None else rate,
            *samples,
        )

    def _add_sample(self, sample: ImuSample) -> None:
        """Pass on a sample, and the prediction at it if one is asked for; by vision where the IMU is left out."""
        stamp_ns, values = self._synchroniser.corrected(sample)
        if self._imu.is_left_out:
            is_predicted = True
        else:
            self._calibration.add_sample(sample)
            self._estimator.add_sample(stamp_ns, values)
            is_predicted = self._propagator.add(stamp_ns, values)
        if is_predicted and self._on_prediction is not None:
            prediction = self._propagator.predict(stamp_ns)
            if prediction is not None:
                self._on_prediction(prediction)
