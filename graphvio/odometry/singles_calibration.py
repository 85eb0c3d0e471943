"""The calibration of a rig of single cameras, passed on from the estimator's window."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from graphvio.arrays import Float
from graphvio.frontend.singles import SinglesFrontend
from graphvio.measurements.estimate import Status
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.measurements.sensors import ImuSample
from graphvio.monocular.estimator import MonocularEstimator
from graphvio.odometry.assembly import views_at
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig
from graphvio.self_calibration.collector import FIRST_WINDOW_SIGMA_PX, WINDOW, FullWindow, WindowCollector
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.findings import Finding, contradiction, findings
from graphvio.self_calibration.prior import file_prior

_KEYFRAME_INTERVAL_S = 0.25  # of the windows for a calibration from the whole recording


class SinglesCalibration:
    """An `OnlineCalibration` of a rig of single cameras and an IMU, whose `MonocularEstimator` estimates it.

    The cameras are passed on to the front-end, the time offset to the synchroniser, contradictions of the rig file to
    people. Innovation tests and the pose's covariance know of the calibration's errors, since these are states.

    Args:
        rig: Of the rig file.
        frontend: Has the tracks.
        synchroniser: Takes a corrected time offset.
        estimator: Estimates the calibration.
        report: Receives events.
    """

    def __init__(
        self,
        rig: Rig,
        frontend: SinglesFrontend,
        synchroniser: Synchroniser,
        estimator: MonocularEstimator,
        report: Report,
    ) -> None:
        assert rig.imu is not None
        self._rig, self._imu = rig, rig.imu
        self._frontend = frontend
        self._synchroniser = synchroniser
        self._estimator = estimator
        self._report = report
        self._file_covariance = file_prior(rig).covariance
        self._estimate: CalibrationEstimate | None = None
        self._was_wrong = self._is_reported = False
        self._epoch = 0
        self._collector = WindowCollector(rig)
        self._on_full_window: Callable[[FullWindow], None] | None = None
        self._use_rig_file()

    @property
    def estimate(self) -> CalibrationEstimate | None:
        """What is known of the calibration now, or None before the first pose."""
        return self._estimate

    @property
    def findings(self) -> list[Finding]:
        """What is known of each part of the calibration; empty before the first pose."""
        return [] if self._estimate is None else findings(self._estimate, self._file_covariance)

    @property
    def warnings(self) -> list[str]:
        """None: the estimator doubts a file that no motion fits."""
        return []

    def on_full_window(self, on_window: Callable[[FullWindow], None]) -> None:
        """Collect windows for a function from now on: the estimator's own are others."""
        self._on_full_window = on_window

    def add_sample(self, sample: ImuSample) -> None:
        """Add an IMU sample for the windows."""
        if self._on_full_window is not None:
            self._collector.add_sample(sample)

    def restart_imu(self) -> None:
        """Forget what was learnt by another clock."""
        self._use_rig_file()
        self._estimate, self._was_wrong = None, False
        self._collector.restart()
        self._collector.forget_samples()

    def with_calibration_covariance(self, visual: VisualResult) -> VisualResult:
        """Return what vision measured, as it is: the window allows for errors of the calibration."""
        return visual

    def add(self, stamp_ns: int, quality: Quality, status: Status) -> None:
        """Record how the stamps jitter, and add a frameset for the windows."""
        self._estimator.note_stamps(self._synchroniser.stamp_sigma_s)
        if self._on_full_window is None:
            return
        if len(self._collector.keyframes) >= WINDOW:  # by now the IMU covers the last one
            window, self._collector.keyframes = tuple(self._collector.keyframes), []
            self._on_full_window(FullWindow(window, self._collector.samples_of(window), FIRST_WINDOW_SIGMA_PX))
        if self._estimator.epoch != self._epoch:
            self._epoch = self._estimator.epoch
            self._collector.restart()
        if status is not Status.TRACKING or not self._estimator.has_pose:  # which a wrong clock may have ended since
            return
        views = views_at(self._frontend, stamp_ns)
        if self._collector.is_keyframe(stamp_ns, views, _KEYFRAME_INTERVAL_S):
            self._collector.add(stamp_ns, self._estimator.state().nav_T_body, views)

    def update(self, stamp_ns: int) -> None:
        """Pass on what has been found since the last call; body stays where it is."""
        estimate = self._estimator.calibration
        if estimate is None or estimate is self._estimate:
            return
        if self._estimate is None or not estimate.is_file_exact:
            self._frontend.recalibrate(estimate.rig, 0.0)
        self._estimate = estimate
        shift_s = self._imu.time_offset_s + estimate.time_offset_s - self._synchroniser.time_offset_s
        self._synchroniser.add_to_time_offset(shift_s)
        self._estimator.shift_samples(round(shift_s * 1e9))
        wrong = contradiction(self.findings)
        if wrong is not None and self._was_wrong and not self._is_reported:
            self._is_reported = True
            self._report(stamp_ns, EventKind.CALIBRATION_CORRECTED, f"{wrong}; corrected from now on")
        self._was_wrong = wrong is not None

    def correct_pose(self, turned: Float) -> None:
        """Do nothing: `update` asks for no change of the pose."""

    def pose_covariance(self, odom_T_body: Float) -> Float:
        """Return zero: the state's covariance already includes errors of the calibration."""
        return np.zeros((6, 6))

    def close(self) -> None:
        """Do nothing: nothing runs beside the odometry."""

    def _use_rig_file(self) -> None:
        """Let the front-end track by the rig file, and find points of other cameras as far off as that may be wrong."""
        sigmas = self._rig.calibration_sigmas
        focal_px = max(single.left.focal_px for single in self._rig.singles)
        self._frontend.recalibrate(self._rig, sigmas.epipolar_margin_px(focal_px, sigmas.pair_rotation_deg))
