"""Estimation of the calibration during the run, and what follows from it for the other stages."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.estimator import StateEstimator
from graphvio.config import Config
from graphvio.frontend.visual import VisualFrontend
from graphvio.geometry import so3_log
from graphvio.measurements.estimate import Status
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.measurements.sensors import ImuSample
from graphvio.odometry.innovation_allowance import InnovationAllowance
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig
from graphvio.self_calibration.collector import FullWindow
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.findings import Finding, contradiction
from graphvio.self_calibration.imu_correction import ImuCorrection
from graphvio.self_calibration.online import SelfCalibration
from graphvio.self_calibration.window import View

_MARGIN_SIGMAS = 3.0  # of epipolar lines by the rig file
_MAX_MARGIN_PX = 5.0  # farther off, patches are not registered
_MAX_TURN_RAD = np.deg2rad(0.3)  # of the cameras in body, up to which motions are measured from references as before
_AVERAGED = 100  # samples, whose mean specific force is about that of gravity


class OnlineCalibration:
    """Brings the self-calibration and the stages that use its results together; does nothing where it is off.

    Args:
        rig: of the rig file.
        config: says whether the calibration is estimated.
        frontend: has the tracks, and takes corrected cameras.
        synchroniser: takes a corrected time offset.
        report: receives events.
    """

    def __init__(
        self, rig: Rig, config: Config, frontend: VisualFrontend, synchroniser: Synchroniser, report: Report
    ) -> None:
        self._rig = rig
        self._frontend = frontend
        self._synchroniser = synchroniser
        self._report = report
        self._corrects_time_offset = rig.imu is not None and not config.fusion.estimate_time_offset
        self._mean_force: Float = np.zeros(3)  # of the first samples
        self._averaged = 0
        self._epoch = 0
        self._is_reported = False
        self._restarts = 0  # of the calibration, that were reported
        self._reported: set[str] = set()  # pairs
        self._calibration = SelfCalibration(rig) if config.estimates_calibration and rig.pairs else None
        self._margin_px = 0.0
        if self._calibration is not None:
            self._body_R_first_left: Float = rig.pairs[0].left.body_T_cam[:3, :3]
            self._margin_px = self._epipolar_margin_px()
            frontend.recalibrate(rig, self._margin_px)
        has_allowance = self._calibration is not None and rig.imu is not None
        self._allowance = InnovationAllowance(rig) if has_allowance else None

    @property
    def estimate(self) -> CalibrationEstimate | None:
        """What is known of the calibration now, or None where it is not estimated."""
        return None if self._calibration is None else self._calibration.estimate

    @property
    def findings(self) -> list[Finding]:
        """What is known of each part of the calibration; empty where it is not estimated."""
        return [] if self._calibration is None else self._calibration.findings()

    def pose_covariance(self, odom_T_body: Float) -> Float:
        """Return the covariance (6, 6) that errors of the calibration add to the newest pose (4, 4)."""
        return np.zeros((6, 6)) if self._calibration is None else self._calibration.pose_covariance(odom_T_body)

    def on_full_window(self, on_window: Callable[[FullWindow], None]) -> None:
        """Register a function that gets each full window; where the calibration is not estimated there are none."""
        if self._calibration is not None:
            self._calibration.on_full_window = on_window

    def add_sample(self, sample: ImuSample) -> None:
        """Take an IMU sample as it was measured."""
        if self._calibration is None:
            return
        self._calibration.add_sample(sample)
        if self._averaged < _AVERAGED:
            self._averaged += 1
            self._mean_force = self._mean_force + (sample.linear_acceleration - self._mean_force) / self._averaged

    def add(self, stamp_ns: int, quality: Quality, status: Status, estimator: StateEstimator) -> None:
        """Take a frameset's pose, and the tracks that belong to it.

        Args:
            stamp_ns: of the frameset.
            quality: of vision.
            status: what the pose is based on.
            estimator: has been updated by the frameset.
        """
        if self._calibration is None:
            return
        if self._allowance is not None:
            self._allowance.add(stamp_ns, estimator, self._frontend.reference_stamps_ns, self._calibration.widest)
        if status not in (Status.TRACKING, Status.INITIALISING) or quality is Quality.FAILED:
            return
        if estimator.epoch != self._epoch:
            self._epoch = estimator.epoch
            self._calibration.start_window()
        pose, views = estimator.state().nav_T_body, self._views_at(stamp_ns)
        self._calibration.add_frameset(stamp_ns, pose, views, quality is Quality.WEAK)

    def update(self, stamp_ns: int) -> Float | None:
        """Let the other stages use the calibration that comes into force after a frameset.

        Returns:
            (3, 3) attitude ``old_R_new`` of the body frame to come in the one until now, as the first pair has it; None
            where that stays, and after a knock: then the cameras have turned in body, and not the body.
        """
        if self._calibration is None:
            return None
        old_R_left = self._body_R_first_left
        has_changed = self._calibration.update()
        if self._calibration.restarts > self._restarts:
            self._restarts = self._calibration.restarts
            self._report(
                stamp_ns, EventKind.CALIBRATION_CHANGED, "the images contradict what was known: it is estimated again"
            )
        margin_px = self._epipolar_margin_px()
        if not has_changed and margin_px == self._margin_px:
            return None
        self._margin_px = margin_px
        estimate = self._calibration.estimate
        self._report_findings(stamp_ns)
        self._frontend.recalibrate(estimate.rig, margin_px, self._calibration.extrinsics)
        if self._rig.imu is not None:
            self._synchroniser.imu_correction = ImuCorrection(*estimate.imu_matrices, self._mean_force)
            if self._corrects_time_offset:
                wanted_s = self._rig.imu.time_offset_s + estimate.time_offset_s
                self._synchroniser.shift_imu(wanted_s - self._synchroniser.time_offset_s)
        self._body_R_first_left = estimate.rig.pairs[0].left.body_T_cam[:3, :3]
        if self._restarts or np.array_equal(self._body_R_first_left, old_R_left):
            return None
        old_R_new: Float = old_R_left @ self._body_R_first_left.T
        if self._rig.imu is not None and np.linalg.norm(so3_log(old_R_new)) > _MAX_TURN_RAD:
            # Measured again from an older reference, the way would have a jump that no IMU can follow.
            self._frontend.start_keyframe()
        return old_R_new

    def with_allowance(self, visual: VisualResult, estimator: StateEstimator) -> VisualResult:
        """Return a frameset's result with what innovation tests of its motions allow for errors of the calibration."""
        return visual if self._allowance is None else self._allowance.allow(visual, estimator)

    def correct_pose(self, turned: Float) -> None:
        """Take note that the newest pose has been changed by a tangent (6,) in body."""
        if self._calibration is not None:
            self._calibration.correct_pose(turned)

    def _views_at(self, stamp_ns: int) -> dict[int, View]:
        """Return what pairs and single cameras see at the newest frameset."""
        return {
            j: View(frame.ids, frame.pixels_at_stamp, frame.right_pixels_at_stamp, frame.has_right, frame.points[:, 2])
            for j, frame in self._frontend.frames_at(stamp_ns).items()
        }

    def _report_findings(self, stamp_ns: int) -> None:
        """Report once that the rig file is wrong beyond 5 sigma, and each pair that is not where the file has it."""
        assert self._calibration is not None
        found = self._calibration.findings()
        wrong = contradiction(found)
        if wrong is not None and self._calibration.is_confirmed and not self._is_reported:
            self._is_reported = True
            self._report(stamp_ns, EventKind.CALIBRATION_CORRECTED, f"{wrong}; corrected from now on")
        for finding in found:
            pair, _, kind = finding.part.partition(", ")
            if finding.is_significant and " against " in kind and pair not in self._reported:
                self._reported.add(pair)
                self._report(stamp_ns, EventKind.EXTRINSICS_OFF, f"{finding}; corrected for this run")

    def _epipolar_margin_px(self) -> float:
        """Return by how much epipolar lines may be off: by the rig file's errors until these are estimated."""
        assert self._calibration is not None
        if self._calibration.is_trusted:
            return 0.0
        sigma_px = max(self._rig.calibration_sigmas.epipolar_px(pair.left.focal_px) for pair in self._rig.pairs)
        return min(_MARGIN_SIGMAS * sigma_px, _MAX_MARGIN_PX)

    def close(self) -> None:
        """End the thread."""
        if self._calibration is not None:
            self._calibration.close()
