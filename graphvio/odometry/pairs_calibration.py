"""The online calibration of a rig with stereo pairs, estimated beside the state and passed to the other stages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.estimator import ImuFaultTolerant, StateEstimator
from graphvio.config import Config
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.visual import VisualFrontend
from graphvio.geometry import so3_log
from graphvio.measurements.estimate import Status
from graphvio.measurements.events import CORRECTED, EventKind, Report
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.measurements.sensors import ImuSample
from graphvio.odometry.assembly import views_of
from graphvio.odometry.calibration_innovation_covariance import CalibrationInnovationCovariance
from graphvio.odometry.synchroniser import Synchroniser
from graphvio.rig import Rig
from graphvio.self_calibration.collector import FullWindow
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.findings import Finding, contradiction
from graphvio.self_calibration.imu_correction import ImuCorrection
from graphvio.self_calibration.online import SelfCalibration
from graphvio.self_calibration.parameters import n_camera_parameters

_MAX_TURN_RAD = np.deg2rad(0.3)  # a larger correction of the cameras' attitude begins a new keyframe
_DISTRUST_SIGMAS = 5.0  # if an IMU parameter changes by more than this, predictions made before are wrong
_AVERAGED = 100  # number of samples whose mean specific force is about that of gravity
_MAX_WAIT_NS = 500_000_000  # of a frameset with rolling shutters, for the motion after it


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A frameset that may become a keyframe of the calibration; see `SelfCalibration.add_frameset`."""

    stamp_ns: int
    instant_ns: int
    odom_T_body: Float
    frames: dict[int, TrackedFrame]
    are_contradicting: bool
    is_urgent: bool


class PairsCalibration:
    """An `OnlineCalibration` of a rig with at least one stereo pair, by `SelfCalibration`.

    Args:
        rig: The rig, with the calibration of the rig file.
        config: Configuration of all stages.
        frontend: Front-end, which has the tracks, and receives corrected cameras.
        synchroniser: Receives corrections of the IMU and its time offset.
        estimator: State estimator.
        report: Receives events.
    """

    def __init__(
        self,
        rig: Rig,
        config: Config,
        frontend: VisualFrontend,
        synchroniser: Synchroniser,
        estimator: StateEstimator,
        report: Report,
    ) -> None:
        self._rig = rig
        self._frontend = frontend
        self._synchroniser = synchroniser
        self._estimator = estimator
        self._imu_fault_tolerant = estimator if isinstance(estimator, ImuFaultTolerant) else None
        self._report = report
        self._corrects_time_offset = rig.imu is not None and not config.fusion.estimate_time_offset
        self._mean_force: Float = np.zeros(3)  # mean specific force of the first samples
        self._averaged = 0
        self._epoch = 0
        self._is_reported = False
        self._is_refusal_reported = False
        self._restarts = 0  # restarts of the calibration that were reported
        self._reported: set[str] = set()  # names of pairs
        self._calibration = SelfCalibration(rig)
        self._motion: RelativeMotion | None = None  # motion by vision at the newest frameset
        self._are_contradicting = False  # whether several motions are seen there
        self._waits_for_next_motion = rig.imu is None and any(camera.line_time_us for camera in rig.cameras)
        self._waiting: list[_Candidate] = []  # for the motion after them
        self._innovation_covariance = None if rig.imu is None else CalibrationInnovationCovariance(rig)
        self._body_R_first_left: Float = rig.pairs[0].left.body_T_cam[:3, :3]
        self._in_force = np.zeros_like(self.estimate.difference)  # difference of the calibration from the rig file
        self._margin_px = self._epipolar_margin_px()
        frontend.recalibrate(rig, self._margin_px)

    @property
    def estimate(self) -> CalibrationEstimate:
        """The present estimate of the calibration."""
        return self._calibration.estimate

    @property
    def findings(self) -> list[Finding]:
        """The present findings for each part; none is significant before a second window confirms the calibration."""
        found = self._calibration.findings()
        return found if self._calibration.is_confirmed else [replace(each, is_significant=False) for each in found]

    @property
    def warnings(self) -> list[str]:
        """Warnings where the images contradict the rig file and it is not corrected, a sentence each."""
        name = self._calibration.implausible_parameter
        if name is None:
            return []
        return [
            "rig file: the images ask for a calibration that is farther from it than any file is wrong, most of all in "
            f"{name}; it is not used, and poses are worse than their covariance says; calibrate again"
        ]

    def on_full_window(self, on_window: Callable[[FullWindow], None]) -> None:
        """Register a function that receives each window before it is adjusted for the last time."""
        self._calibration.on_full_window = on_window

    def add_sample(self, sample: ImuSample) -> None:
        """Add an IMU sample; the mean specific force of the first ones becomes the fixed force of `ImuCorrection`."""
        self._calibration.add_sample(sample)
        if self._averaged < _AVERAGED:
            self._averaged += 1
            self._mean_force = self._mean_force + (sample.linear_acceleration - self._mean_force) / self._averaged

    def restart_imu(self) -> None:
        """Discard the unfinished window: it contains samples from before the restart."""
        self._calibration.restart_imu()

    def with_calibration_covariance(self, visual: VisualResult) -> VisualResult:
        """Attach to each motion the innovation covariance that errors of the calibration add."""
        self._motion, self._are_contradicting = visual.motion, bool(visual.alternatives)
        calibration = self._calibration
        is_trusted = calibration.is_trusted and not calibration.is_first_window_doubted
        visual = replace(visual, is_calibration_trusted=is_trusted)
        if self._innovation_covariance is None:
            return visual
        return self._innovation_covariance.with_calibration_covariance(visual, self._estimator)

    def add(self, stamp_ns: int, quality: Quality, status: Status) -> None:
        """Add a frameset as a candidate for a keyframe, if its pose is usable."""
        calibration, estimator, references = self._calibration, self._estimator, self._frontend.reference_stamps_ns
        instant_ns = self._synchroniser.instant_ns(stamp_ns)
        if estimator.epoch != self._epoch:
            self._epoch = estimator.epoch
            self._waiting = []
            calibration.start_window()
        motion = self._motion if status in (Status.TRACKING, Status.INITIALISING) else None
        needed = references | {each.stamp_ns for each in self._waiting}
        calibration.add_motion(stamp_ns, instant_ns, estimator.state().nav_T_body, motion, needed)
        if self._innovation_covariance is not None:
            self._innovation_covariance.add_frameset(stamp_ns, estimator, references, calibration.upper_covariance)
        if self._motion is not None:
            calibration.note_contradiction(stamp_ns, self._are_contradicting)
        is_urgent = self._frontend.are_lines_off
        # Until the calibration is trusted, motions may be refused because of it.
        is_refused = status is Status.COASTING and not calibration.is_trusted
        is_usable = quality is not Quality.FAILED and (status in (Status.TRACKING, Status.INITIALISING) or is_refused)
        if not (is_usable or is_urgent) or not self._frontend.are_velocities_known:
            return
        if calibration.is_doubted and quality is Quality.WEAK and not self._are_contradicting:
            return  # the images are at fault, and not the calibration
        frames = self._frontend.compensated_frames_at(stamp_ns)
        tolerant = self._imu_fault_tolerant
        pose = estimator.state().nav_T_body if tolerant is None else tolerant.pose_by_vision()
        calibration.note_stamps(self._synchroniser.stamp_sigma_s)
        candidate = _Candidate(stamp_ns, instant_ns, pose, frames, quality is Quality.WEAK, is_urgent)
        for each in self._compensated(candidate) if self._waits_for_next_motion else [candidate]:
            views = views_of(each.frames)
            calibration.add_frameset(each.instant_ns, each.odom_T_body, views, each.are_contradicting, each.is_urgent)

    def update(self, stamp_ns: int) -> Float | None:
        """Pass cameras to the front-end, and the IMU's scale, axes and time offset to the synchroniser."""
        was_confirmed = self._calibration.is_confirmed
        has_changed = self._calibration.update()
        if self._calibration.restarts > self._restarts:
            self._restarts = self._calibration.restarts
            self._report(
                stamp_ns, EventKind.CALIBRATION_CHANGED, "the images contradict what was known: it is estimated again"
            )
        if self.warnings and not self._is_refusal_reported:
            self._is_refusal_reported = True
            self._report(stamp_ns, EventKind.CALIBRATION_REFUSED, self.warnings[0])
        margin_px = self._epipolar_margin_px()
        if not has_changed and margin_px == self._margin_px:
            return None
        self._margin_px = margin_px
        self._report_findings(stamp_ns)
        self._frontend.recalibrate(self.estimate.rig, margin_px, self._calibration.extrinsics)
        change, n = self.estimate.difference - self._in_force, n_camera_parameters(self._rig)
        self._in_force = self.estimate.difference
        if self._innovation_covariance is not None and self._innovation_covariance.recalibrate(change[:n]):
            self._frontend.start_keyframe()
        is_imu_changed = bool((np.abs(change) > _DISTRUST_SIGMAS * self.estimate.sigmas)[n:].any())
        if is_imu_changed and self._imu_fault_tolerant is not None:
            self._imu_fault_tolerant.distrust_prediction()
        self._correct_imu()
        if has_changed and not was_confirmed:
            self._hand_over_inertial_state()
        return self._turn()

    def correct_pose(self, turned: Float) -> None:
        """Remove the corrected error from that of the motions until now."""
        self._calibration.correct_pose(turned)

    def pose_covariance(self, odom_T_body: Float) -> Float:
        """Return the covariance (6, 6) that the remaining calibration errors have added to the motions until now."""
        return self._calibration.pose_covariance(odom_T_body)

    def close(self) -> None:
        """Stop the thread of the adjustments."""
        self._calibration.close()

    def _compensated(self, newest: _Candidate) -> list[_Candidate]:
        """Add a candidate to those that wait, and return those whose motion is known by now.

        Without an IMU, the velocity at a frameset, by which its rolling shutters are compensated, is only known well
        after the next one. At first it lags behind each acceleration; in the window, that looks like wrong cameras.
        """
        self._waiting = [each for each in self._waiting if newest.stamp_ns - each.stamp_ns <= _MAX_WAIT_NS] + [newest]
        known = []
        for each in self._waiting:
            frames = self._frontend.compensated_by_both_sides(each.stamp_ns, each.frames)
            if frames is None:
                break
            known.append(replace(each, frames=frames))
        del self._waiting[: len(known)]
        return known

    def _correct_imu(self) -> None:
        """Let the synchroniser correct samples with the calibration that is in force."""
        if self._rig.imu is None:
            return
        self._synchroniser.imu_correction = ImuCorrection(*self.estimate.imu_matrices, self._mean_force)
        if self._corrects_time_offset:
            wanted_s = self._rig.imu.time_offset_s + self.estimate.time_offset_s
            self._synchroniser.add_to_time_offset(wanted_s - self._synchroniser.time_offset_s)

    def _hand_over_inertial_state(self) -> None:
        """Pass velocity, biases and gravity from the window's adjustment to the estimator.

        Until now the estimator has attributed errors of the calibration to the motion; in the window they are unknowns.
        But the window treats views by rolling shutters, which were compensated, as those of global shutters: in a turn,
        an error of the IMU's clock, which is part of that compensation, then looks like one of gravity and biases. So
        nothing is passed on for a rig with rolling shutters.
        """
        known, tolerant = self._calibration.inertial_state, self._imu_fault_tolerant
        if known is None or tolerant is None or any(camera.line_time_us for camera in self._rig.cameras):
            return
        stamp_ns, force = self._synchroniser.stamp_ns(known.stamp_ns), -known.gravity
        bias = known.accel_bias + self._synchroniser.imu_correction.applied_force(force) - force
        if tolerant.use_inertial_state(replace(known, stamp_ns=stamp_ns, accel_bias=bias)):
            self._frontend.start_keyframe()

    def _turn(self) -> Float | None:
        """Return the rotation of body by the calibration in force, see `OnlineCalibration.update`."""
        old_R_left, new_R_left = self._body_R_first_left, self.estimate.rig.pairs[0].left.body_T_cam[:3, :3]
        self._body_R_first_left = new_R_left
        if self._restarts or np.array_equal(new_R_left, old_R_left):
            return None
        old_R_new: Float = old_R_left @ new_R_left.T
        if self._rig.imu is not None and np.linalg.norm(so3_log(old_R_new)) > _MAX_TURN_RAD:
            # Measured again from an older reference, the motion would have a jump that contradicts the IMU.
            self._frontend.start_keyframe()
        return old_R_new

    def _report_findings(self, stamp_ns: int) -> None:
        """Report once that the rig file is wrong beyond 5 sigma, and once each pair with wrong extrinsics in it."""
        found = self._calibration.findings()
        wrong = contradiction(found)
        if wrong is not None and self._calibration.is_confirmed and not self._is_reported:
            self._is_reported = True
            self._report(stamp_ns, EventKind.CALIBRATION_CORRECTED, f"{wrong}; corrected from now on")
        for finding in found:
            pair, _, kind = finding.part.partition(", ")
            if finding.is_significant and " against " in kind and pair not in self._reported:
                self._reported.add(pair)
                self._report(stamp_ns, EventKind.EXTRINSICS_OFF, f"{finding}; {CORRECTED}")

    def _epipolar_margin_px(self) -> float:
        """Return the margin for errors of epipolar lines by the rig file, px; zero once the calibration is trusted."""
        if self._calibration.is_trusted:
            return 0.0
        sigmas, focal_px = self._rig.calibration_sigmas, max(pair.left.focal_px for pair in self._rig.pairs)
        return sigmas.epipolar_margin_px(focal_px, sigmas.stereo_rotation_deg)
