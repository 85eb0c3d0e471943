"""Calibration of a rig of single cameras: the estimator's window knows it, and other stages and people learn of it."""

from __future__ import annotations

from collections.abc import Callable

from graphvio.arrays import Float
from graphvio.backend.estimator import StateEstimator
from graphvio.config import Config
from graphvio.frontend.visual import VisualFrontend
from graphvio.measurements.estimate import Status
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.motion import Quality
from graphvio.measurements.sensors import ImuSample
from graphvio.monocular.estimator import MonocularEstimator
from graphvio.odometry.online_calibration import OnlineCalibration
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig
from graphvio.self_calibration.collector import FIRST_SIGMA_PX, WINDOW, FullWindow, WindowCollector
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.findings import Finding, contradiction, findings
from graphvio.self_calibration.prior import file_prior

_KEYFRAME_INTERVAL_S = 0.25  # of the windows for a calibration from the whole recording


class SinglesCalibration(OnlineCalibration):
    """Passes on what a `MonocularEstimator` finds: the time offset to the synchroniser, contradictions as events."""

    def __init__(
        self, rig: Rig, config: Config, frontend: VisualFrontend, synchroniser: Synchroniser, report: Report
    ) -> None:
        super().__init__(rig, config, frontend, synchroniser, report)
        self._file_covariance = file_prior(rig).covariance
        self._estimate: CalibrationEstimate | None = None
        self._estimator: MonocularEstimator | None = None
        self._was_wrong = False
        self._on_full_window: Callable[[FullWindow], None] | None = None
        self._collector = WindowCollector(rig)

    @property
    def estimate(self) -> CalibrationEstimate | None:
        """What is known of the calibration now, or None before the first pose and where it is not estimated."""
        return self._estimate

    @property
    def findings(self) -> list[Finding]:
        """What is known of each part of the calibration; empty before the first pose, and where it is not estimated."""
        return [] if self._estimate is None else findings(self._estimate, self._file_covariance)

    def on_full_window(self, on_window: Callable[[FullWindow], None]) -> None:
        """Register a function that gets windows of keyframes, for a calibration from the whole recording."""
        self._on_full_window = on_window

    def add_sample(self, sample: ImuSample) -> None:
        """Take an IMU sample as it was measured."""
        if self._on_full_window is not None:
            self._collector.add_sample(sample)

    def add(self, stamp_ns: int, quality: Quality, status: Status, estimator: StateEstimator) -> None:
        """Take note of the estimator, which has been updated by the newest frameset, and of what the cameras see."""
        assert isinstance(estimator, MonocularEstimator)
        self._estimator = estimator
        if self._on_full_window is None:
            return
        if len(self._collector.keyframes) >= WINDOW:  # by now the IMU covers the last one
            window, self._collector.keyframes = tuple(self._collector.keyframes), []
            self._on_full_window(FullWindow(window, self._collector.samples_of(window), FIRST_SIGMA_PX))
        if estimator.epoch != self._epoch:
            self._epoch = estimator.epoch
            self._collector.restart()
        if status is not Status.TRACKING:
            return
        views = self._views_at(stamp_ns)
        if self._collector.is_keyframe(stamp_ns, views, _KEYFRAME_INTERVAL_S):
            self._collector.add(stamp_ns, estimator.state().nav_T_body, views)

    def update(self, stamp_ns: int) -> Float | None:
        """Pass on what has been found since the last call; returns None, since body stays where it is."""
        assert self._estimator is not None
        estimate = self._estimator.calibration
        if estimate is None or estimate is self._estimate:
            return None
        self._estimate = estimate
        assert self._rig.imu is not None
        shift_s = self._rig.imu.time_offset_s + estimate.time_offset_s - self._synchroniser.time_offset_s
        self._synchroniser.shift_imu(shift_s)
        self._estimator.shift_samples(round(shift_s * 1e9))
        wrong = contradiction(self.findings)
        if wrong is not None and self._was_wrong and not self._is_reported:
            self._is_reported = True
            self._report(stamp_ns, EventKind.CALIBRATION_CORRECTED, f"{wrong}; corrected from now on")
        self._was_wrong = wrong is not None
        return None
