"""The online calibration of a rig of single cameras, which the state estimator's window estimates."""

from __future__ import annotations

from collections.abc import Callable

from graphvio.arrays import Float
from graphvio.frontend.singles import SinglesFrontend
from graphvio.measurements.estimate import Status
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.measurements.sensors import ImuSample
from graphvio.monocular.estimator import MonocularEstimator
from graphvio.odometry.assembly import views_of
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig
from graphvio.self_calibration.collector import FIRST_WINDOW_SIGMA_PX, WINDOW, FullWindow, WindowCollector
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.findings import Finding, contradiction, findings
from graphvio.self_calibration.prior import file_prior

_KEYFRAME_INTERVAL_S = 0.25  # least interval in windows for a calibration from the whole recording


class SinglesCalibration:
    """An `OnlineCalibration` of a rig of single cameras and an IMU, whose `MonocularEstimator` estimates it.

    It passes the cameras on to the front-end and the time offset to the synchroniser, and reports contradictions to the
    rig file. Innovation tests and the pose's covariance already include the calibration's errors, which are states.

    Args:
        rig: The rig, with the calibration of the rig file.
        frontend: Front-end, which has the tracks.
        synchroniser: Receives a corrected time offset.
        estimator: State estimator, which also estimates the calibration.
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
        """The present estimate of the calibration, or None before the first pose."""
        return self._estimate

    @property
    def findings(self) -> list[Finding]:
        """The present findings for each part of the calibration; empty before the first pose."""
        return [] if self._estimate is None else findings(self._estimate, self._file_covariance)

    @property
    def warnings(self) -> list[str]:
        """An empty list: the estimator itself doubts a file that no motion fits."""
        return []

    def on_full_window(self, on_window: Callable[[FullWindow], None]) -> None:
        """Collect windows for a function from now on; they are not the windows of the estimator."""
        self._on_full_window = on_window

    def add_sample(self, sample: ImuSample) -> None:
        """Add an IMU sample for the windows."""
        if self._on_full_window is not None:
            self._collector.add_sample(sample)

    def restart_imu(self) -> None:
        """Forget the calibration and samples of the wrong clock, and use the rig file's calibration again."""
        self._use_rig_file()
        self._estimate, self._was_wrong = None, False
        self._collector.restart()
        self._collector.forget_samples()

    def with_calibration_covariance(self, visual: VisualResult) -> VisualResult:
        """Return the front-end's result unchanged: the window allows for errors of the calibration."""
        return visual

    def add(self, stamp_ns: int, quality: Quality, status: Status) -> None:
        """Pass the stamps' jitter to the estimator, and add a frameset to the windows."""
        self._estimator.note_stamps(self._synchroniser.stamp_sigma_s)
        if self._on_full_window is None:
            return
        if len(self._collector.keyframes) >= WINDOW:  # by now the IMU covers the last one
            window, self._collector.keyframes = tuple(self._collector.keyframes), []
            self._on_full_window(FullWindow(window, self._collector.samples_of(window), FIRST_WINDOW_SIGMA_PX))
        if self._estimator.epoch != self._epoch:
            self._epoch = self._estimator.epoch
            self._collector.restart()
        if status is not Status.TRACKING or not self._estimator.has_pose:  # a wrong clock may have ended the pose since
            return
        views = views_of(self._frontend.frames_at(stamp_ns))
        if self._collector.is_keyframe(stamp_ns, views, _KEYFRAME_INTERVAL_S):
            self._collector.add(stamp_ns, self._estimator.state().nav_T_body, views)

    def update(self, stamp_ns: int) -> None:
        """Pass on the calibration if it has changed since the last call; body is not turned."""
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
        """Do nothing: `update` never changes the pose."""

    def pose_covariance(self, odom_T_body: Float) -> Float:
        """Return the covariance by changes of the frame; the state's includes the errors of the calibration."""
        return self._estimator.covariance_of_turns(odom_T_body)

    def close(self) -> None:
        """Do nothing: nothing runs beside the odometry."""

    def _use_rig_file(self) -> None:
        """Let the front-end use the rig file, and search matches in other cameras within the file's possible error."""
        sigmas = self._rig.calibration_sigmas
        focal_px = max(single.left.focal_px for single in self._rig.singles)
        self._frontend.recalibrate(self._rig, sigmas.epipolar_margin_px(focal_px, sigmas.pair_rotation_deg))
