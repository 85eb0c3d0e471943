"""Estimation of the calibration during the run, and what follows from it for the other stages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.frontend.visual import VisualFrontend
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.measurements.sensors import ImuSample
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.findings import Finding, contradiction
from graphvio.self_calibration.imu_correction import ImuCorrection
from graphvio.self_calibration.innovation import InnovationErrors
from graphvio.self_calibration.online import FullWindow, SelfCalibration
from graphvio.self_calibration.window import View

_MARGIN_SIGMAS = 3.0  # of epipolar lines by the rig file
_MAX_MARGIN_PX = 5.0  # farther off, patches are not registered
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
        self._calibration = SelfCalibration(rig) if config.estimates_calibration else None
        self._margin_px = 0.0
        self._innovation: InnovationErrors | None = None
        self._innovation_of: Float | None = None  # covariance of the calibration
        self._velocities: dict[
            int, Float
        ] = {}  # (6,) of body, at framesets that motions are measured from, and the newest
        if self._calibration is not None:
            self._body_R_first_left: Float = rig.pairs[0].left.body_T_cam[:3, :3]
            self._margin_px = self._epipolar_margin_px()
            frontend.recalibrate(rig, self._margin_px)

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
        if self._rig.imu is not None and self._innovation_of is not self._calibration.widest:
            self._innovation_of = self._calibration.widest
            self._innovation = InnovationErrors(self._innovation_of, len(self._rig.pairs))
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
        return old_R_left @ self._body_R_first_left.T

    def with_innovation_errors(self, visual: VisualResult) -> VisualResult:
        """Return a frameset's result with what errors of the calibration add to the innovations of its motions."""
        errors = self._innovation
        if errors is None or visual.motion is None:
            return visual
        now = self._velocities[max(self._velocities)] if self._velocities else None

        def with_errors(motion: RelativeMotion) -> RelativeMotion:
            before = self._velocities.get(motion.reference_stamp_ns)
            added = errors.covariance(motion.reference_T_current, before, now)
            return replace(motion, calibration_covariance=added)

        alternatives = tuple(map(with_errors, visual.alternatives))
        return replace(visual, motion=with_errors(visual.motion), alternatives=alternatives)

    def correct_pose(self, turned: Float) -> None:
        """Take note that the newest pose has been changed by a tangent (6,) in body."""
        if self._calibration is not None:
            self._calibration.correct_pose(turned)

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

    def add(self, estimate: Estimate, odom_T_body: Float) -> None:
        """Take a frameset's estimate, and the tracks that belong to it.

        Args:
            estimate: of the frameset.
            odom_T_body: (4, 4) its pose in the frame of the estimator.
        """
        if self._calibration is None or estimate.nav_T_body is None:
            return
        self._note_velocity(estimate)
        if estimate.status not in (Status.TRACKING, Status.INITIALISING) or estimate.vision is Quality.FAILED:
            return
        if estimate.epoch != self._epoch:
            self._epoch = estimate.epoch
            self._calibration.start_window()
        views = {
            j: View(frame.ids, frame.pixels_at_stamp, frame.right_pixels_at_stamp, frame.has_depth, frame.points[:, 2])
            for j, frame in self._frontend.frames_at(estimate.stamp_ns).items()
            if not frame.is_single
        }
        self._calibration.add_frameset(estimate.stamp_ns, odom_T_body, views, estimate.vision is Quality.WEAK)

    def _note_velocity(self, estimate: Estimate) -> None:
        """Keep how body moves now, and at the framesets that motions are measured from."""
        references, rate = self._frontend.reference_stamps_ns, estimate.rates.get("fused")
        self._velocities = {ns: each for ns, each in self._velocities.items() if ns in references}
        if rate is not None and estimate.velocity_nav is not None and estimate.nav_T_body is not None:
            linear = estimate.nav_T_body[:3, :3].T @ estimate.velocity_nav
            self._velocities[estimate.stamp_ns] = np.concatenate([rate, linear])

    def close(self) -> None:
        """End the thread."""
        if self._calibration is not None:
            self._calibration.close()
