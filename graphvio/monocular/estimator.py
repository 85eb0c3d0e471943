"""State estimator of a rig of single cameras and an IMU: a window of keyframes with landmarks, solved at each frameset.

Scale is part of the state: positions are in metres by the accelerometer, and their covariance includes the uncertainty
of the scale. There is no pose until an `Initialiser` has found the scale.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.estimator import MeasurementUpdate, StateUpdate
from graphvio.backend.initialisation import InitialAttitude, initial_attitude
from graphvio.backend.states import RigState, StateCovariance
from graphvio.config import Config
from graphvio.geometry import se3, se3_inverse
from graphvio.measurements.estimate import Status
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import CameraTracks, LocatedPoints, VisualResult
from graphvio.measurements.window_views import FirstWindow, WindowViews
from graphvio.monocular.calibration import WindowCalibration
from graphvio.monocular.initialiser import MAX_DURATION_NS, Initialiser, shared_points
from graphvio.monocular.overlap_trust import OverlapTrust, alone
from graphvio.monocular.reprojection import Cameras
from graphvio.monocular.sample_buffer import SampleBuffer
from graphvio.monocular.window import KeyframeWindow
from graphvio.monocular.window_solver import FIRST_MONOCULAR_SIGMA_PX, Solution, WindowSolver, newest_state
from graphvio.rig import Rig
from graphvio.self_calibration.estimate import CalibrationEstimate

_MAX_CONTRADICTION_NS = 1_000_000_000
_MAX_STAMP_SIGMA_S = 3e-4  # with less exact stamps, a window's errors come from these, not from the calibration
_MAX_IMU_ERROR2 = 150.0
_MAX_STANDSTILL_NS = 1_000_000_000  # from the initialisation until the images confirm the standstill
_REPORT_AFTER_NS = 5_000_000_000
_TURNS_OTHERWISE = "the IMU turns otherwise than the cameras"


class MonocularEstimator:
    """A `graphvio.backend.estimator.StateEstimator` for a rig of single cameras and an IMU.

    Args:
        rig: The rig, with single cameras and an IMU.
        config: Configuration of all stages.
        report: Function that receives events.
    """

    def __init__(self, rig: Rig, config: Config, report: Report) -> None:
        assert rig.imu is not None
        self.epoch = 0
        self.gate_results: dict[str, GateResult] = {}
        self.initialisations = 0
        self._config = config
        self._report = report
        self._cameras = Cameras.of(rig)
        self._rig = rig
        self._calibration = WindowCalibration(rig, config.estimates_calibration)
        self._samples = self._new_samples()
        self._solver = WindowSolver(self._cameras, self._calibration, self._samples)
        self._shift_ns = 0  # added to samples' stamps, to undo corrections of the time offset
        self._has_imu = self._is_initialised = self._is_imu_doubted = False
        self._collect_keyframes()
        self._has_overlaps, self._are_trusted = False, True
        self._window: KeyframeWindow | None = None
        self._latest_ns = 0
        self._since_ns = 0  # stamp of the initialisation, or of the end of the epoch before
        self._is_reported = False
        self._is_keyframe = True  # whether the newest state of the window is one
        self._before: tuple[int, Float] | None = None  # stamp and pose of the previous state, also once it has left
        self._camera_tracks: dict[int, CameraTracks] = {}
        self._is_stationary = False
        self._standstill: InitialAttitude | None = None  # by the IMU at the first frameset, if it shows a standstill
        self._tracked_sigma_m = 0.0
        self._contradicted_since_ns: int | None = None
        self._rate: Float | None = None

    # ------------------------------------------------------------------ what is known

    @property
    def is_initialised(self) -> bool:
        """Whether `initialise` has been called, so that at least keyframes are collected."""
        return self._is_initialised

    @property
    def has_pose(self) -> bool:
        """Whether the scale is known, and with it a pose."""
        return self._window is not None

    @property
    def has_imu(self) -> bool:
        """Whether there were IMU samples at the initialisation."""
        return self._has_imu

    @property
    def calibration(self) -> CalibrationEstimate | None:
        """The estimated calibration, updated once a second; None before the first pose, or if it is not estimated."""
        return self._calibration.latest

    @property
    def latest_ns(self) -> int:
        """Stamp of the newest frameset."""
        return self._latest_ns

    @property
    def covariance(self) -> StateCovariance:
        """Covariance of the newest state; zero while there is none."""
        return self._solver.covariance

    def state(self) -> RigState:
        """Return the newest state."""
        if self._window is None:
            return RigState(np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3))
        return newest_state(self._window.states)

    def latest_rate(self) -> Float | None:
        """Return the mean angular rate (3,) rad/s over the newest step, or None if it is not known."""
        return self._rate

    def motion_since(self, then_ns: int) -> Float | None:
        """Return ``now_T_then`` (4, 4) of body since a state of the window or the previous state, None if unknown."""
        if self._window is None:
            return None
        states = self._window.states
        found = np.flatnonzero(states.stamps_ns == then_ns)
        if len(found):
            then = states.poses[found[0]]
        elif self._before is not None and self._before[0] == then_ns:
            then = self._before[1]
        else:
            return None
        return np.ascontiguousarray(se3_inverse(states.poses[-1]) @ then)

    def covariance_since(self, then_ns: int) -> Float | None:
        """Return the covariance (6, 6) of the motion since a keyframe of the window, in the newest body frame."""
        return self._solver.covariance_since(then_ns)

    def covariance_of_turns(self, odom_T_body: Float) -> Float:
        """Return the covariance (6, 6) of a pose by changes of the frame, see `WindowSolver.covariance_of_turns`."""
        return self._solver.covariance_of_turns(odom_T_body)

    def located_points(self) -> dict[int, LocatedPoints]:
        """Return the points that the newest state sees, by camera."""
        return self._solver.located_points()

    def take_final(self) -> list[tuple[int, Float]]:
        """Return stamps and poses ``nav_T_body`` of keyframes that left the window since the last call."""
        return self._solver.take_final()

    def on_views(self, on_views: Callable[[WindowViews | FirstWindow], None]) -> None:
        """Register a function that gets the views of each landmark once, as it leaves the window or the window ends.

        What is known from before an epoch's first pose is handed over once, as a `FirstWindow`.

        Args:
            on_views: Function that is called within `update` and `finish`.
        """
        self._solver.on_views(on_views)

    def finish(self) -> None:
        """Declare all poses of the window final."""
        if self._window is None and self._is_initialised and not self._solver.first_pose_ns and not self._is_reported:
            self._report_not_initialised(self._latest_ns)
        if self._window is not None:
            self._solver.end(self._window)

    # ------------------------------------------------------------------ one frameset

    def add_sample(self, stamp_ns: int, values: Float) -> None:
        """Add an IMU sample (6,), stamped on the framesets' clock."""
        self._samples.add(stamp_ns + self._shift_ns, values)

    def shift_samples(self, shift_ns: int) -> None:
        """Record a correction of the time offset: it is undone for later samples, since the offset is a state here."""
        self._shift_ns += shift_ns

    def initialise(self, stamp_ns: int, imu: tuple[ImuInterval, float] | None) -> None:
        """Begin to collect keyframes."""
        if imu is None and not self._is_initialised:
            self._report(stamp_ns, EventKind.STARTED_WITHOUT_IMU, "no IMU samples came: the scale cannot be known")
        self._is_initialised, self._has_imu = True, imu is not None
        self._latest_ns = self._since_ns = stamp_ns
        if imu is not None:
            attitude = initial_attitude(*imu, self._config.initialisation)
            self._standstill = attitude if attitude.is_stationary else None

    def predict(self, stamp_ns: int, interval: ImuInterval | None) -> bool:
        """Add a state predicted by the IMU.

        Where the IMU has been silent for more than 5 s, the epoch ends. Before the first pose, any gap discards the
        keyframes that were collected.
        """
        self.gate_results = {}
        self._rate = None
        window, before_ns = self._window, self._latest_ns
        self._samples.collect(self._oldest_needed_ns(stamp_ns), stamp_ns)
        self._latest_ns = stamp_ns
        if not self._samples.covers(before_ns, stamp_ns, bridges=window is not None):
            self._lose(stamp_ns, "the IMU does not cover the step to this frameset", is_sound=True)
            return False
        if window is None:
            return False
        states = window.states
        step = self._samples.preintegrated(before_ns, stamp_ns, states.parameters)
        pose, velocity, dt = states.poses[-1], states.velocities[-1], step.duration_s
        moved = pose[:3, 3] + dt * velocity + 0.5 * dt**2 * states.gravity + pose[:3, :3] @ step.position
        if interval is not None:
            self._rate = interval.mean_rate - states.biases[:3]
        self._before = int(states.stamps_ns[-1]), pose
        window.add_state(
            stamp_ns,
            se3(pose[:3, :3] @ step.rotation, moved),
            velocity + dt * states.gravity + pose[:3, :3] @ step.velocity,
            instead=not self._is_keyframe,
        )
        return False

    def apply(self, visual: VisualResult, is_stationary: bool) -> MeasurementUpdate:
        """Record what the cameras see at the newest frameset; outliers are found when the window is solved."""
        self._has_overlaps |= shared_points(visual.camera_tracks) > 0
        seen = dict(visual.camera_tracks) if self._are_trusted else alone(visual.camera_tracks)
        self._camera_tracks, self._is_stationary = seen, is_stationary
        if is_stationary:
            self._use_standstill()
        return MeasurementUpdate(None)

    def _use_standstill(self) -> None:
        """Set the gyro bias prior from the IMU's standstill once images confirm it: a steady turn looks the same."""
        standstill, self._standstill = self._standstill, None
        if standstill is not None and self._latest_ns - self._since_ns <= _MAX_STANDSTILL_NS:
            self._initialiser.set_gyro_bias_prior(standstill.gyro_bias, standstill.gyro_bias_sigma)
            self._trust.set_gyro_bias_prior(standstill.gyro_bias, standstill.gyro_bias_sigma)

    def update(self, stamp_ns: int, is_constrained: bool, keep: frozenset[int]) -> StateUpdate:
        """Solve the window at the newest frameset or, before the first pose, look for the scale."""
        is_keyframe = stamp_ns in keep
        if self._window is None:
            return self._initialising(stamp_ns, is_keyframe)
        try:
            update = self._solve(self._window, stamp_ns, is_keyframe)
            instead = self._drop_wrong_overlaps(stamp_ns, self._window) if is_keyframe and self._window else None
            if instead is None:
                return update
            self._lose(stamp_ns, "overlapping views contradict the IMU")
            return self._begin(instead, stamp_ns, is_keyframe)
        except np.linalg.LinAlgError as error:
            self._lose(stamp_ns, str(error))
            return StateUpdate(Status.LOST)

    def _initialising(self, stamp_ns: int, is_keyframe: bool) -> StateUpdate:
        """Give the frameset to the initialiser if it is a keyframe, and begin the window once the scale is known."""
        if self._has_imu and not self._is_imu_doubted and (is_keyframe or self._is_stationary):
            window = self._initialiser.add(stamp_ns, self._camera_tracks, self._is_stationary)
            instead = self._drop_wrong_overlaps(stamp_ns, window)
            if instead is not None:
                return self._begin(instead, stamp_ns, is_keyframe)
            if window is not None:
                return self._begin(window, stamp_ns, is_keyframe)
        if not self._is_reported and stamp_ns - self._since_ns > _REPORT_AFTER_NS:
            self._report_not_initialised(stamp_ns)
        return StateUpdate(Status.INITIALISING)

    def _report_not_initialised(self, stamp_ns: int) -> None:
        self._is_reported = True
        why = f"{self._initialiser.reason}; go on moving: speed up, brake and turn"
        if self._is_imu_doubted:
            why = f"{_TURNS_OTHERWISE}; are its clock and its axes those of the rig?"
        self._report(
            stamp_ns,
            EventKind.NOT_INITIALISED,
            f"{(stamp_ns - self._since_ns) * 1e-9:.1f} s after the initialisation {why}",
        )

    def _begin(self, window: KeyframeWindow, stamp_ns: int, is_keyframe: bool) -> StateUpdate:
        """Begin with a window whose scale is known, and solve it at the newest frameset."""
        self._window, self._is_keyframe, self._before = window, True, None
        self._solver.begin(window, stamp_ns)
        self.initialisations += 1
        self._report(
            stamp_ns,
            EventKind.SCALE_KNOWN,
            f"the scale is known to 5 % after {(stamp_ns - self._since_ns) * 1e-9:.1f} s",
        )
        return self._solve(window, stamp_ns, is_keyframe, is_new=True)

    def _drop_wrong_overlaps(self, stamp_ns: int, window: KeyframeWindow | None) -> KeyframeWindow | None:
        """Stop using overlapping views once they prove wrong, and return a window without them; None if they are right.

        This is for an exact rig file only: once the calibration is estimated, the window itself estimates the rotations
        between the cameras.
        """
        is_exact = self._calibration.is_file_exact and (window is None or self._calibration.is_exact(window.factors))
        if not (self._has_overlaps and self._are_trusted and is_exact):
            return None
        states = None if window is None else window.states
        found = self._trust.add(stamp_ns, self._camera_tracks, self._is_stationary, states)
        if found is None:
            return None
        instead, why = found
        self._are_trusted = False
        self._report(
            stamp_ns, EventKind.EXTRINSICS_OFF, f"{why}: cameras are used each by itself; check their places in the rig"
        )
        return instead

    def _solve(self, window: KeyframeWindow, stamp_ns: int, is_keyframe: bool, is_new: bool = False) -> StateUpdate:
        if not is_new:
            window.add_views(self._camera_tracks, self._is_stationary)
        self._is_keyframe = is_keyframe
        solution = self._solver.solve(window, stamp_ns, is_keyframe)
        if solution.knocked:
            names = ", ".join(self._rig.singles[j].name for j in sorted(solution.knocked))
            why = f"views of cameras {names} have left their epipolar lines: the cameras' places are estimated again"
            self._report(stamp_ns, EventKind.CALIBRATION_CHANGED, why)
        return StateUpdate(self._judge(stamp_ns, solution), outliers=solution.dropped)

    def _judge(self, stamp_ns: int, solution: Solution) -> Status:
        """Return the status after a solution, and end the epoch where it is lost.

        It is lost where no possible calibration explains the measurements, where images and IMU have contradicted each
        other for 1 s, and where the position has become too uncertain since vision last constrained it.
        """
        if not solution.is_possible:
            self._solver.discard()
            self._lose(stamp_ns, "images and IMU contradict each other, whatever the calibration")
            return Status.LOST
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(self.covariance.pose[3:, 3:])[-1]))
        errors2 = solution.imu_errors2
        contradicts = bool(len(errors2) and not errors2[-1] < _MAX_IMU_ERROR2)
        if contradicts:
            since_ns = self._contradicted_since_ns or stamp_ns
            self._contradicted_since_ns = since_ns
            if stamp_ns - since_ns > _MAX_CONTRADICTION_NS:
                self._lose(stamp_ns, "images and IMU contradict each other")
                return Status.LOST
        else:
            self._contradicted_since_ns = None
        if solution.is_tracking:
            self._tracked_sigma_m = sigma_m
            return Status.TRACKING
        gained_m = float(np.sqrt(max(sigma_m**2 - self._tracked_sigma_m**2, 0.0)))
        if gained_m > self._config.smoother.lost_position_sigma_m:
            why = f"position uncertain by {gained_m:.2f} m since vision last constrained it"
            self._lose(stamp_ns, why, is_sound=True)
            return Status.LOST
        return Status.COASTING

    # ------------------------------------------------------------------ breaks, and the IMU

    def _lose(self, stamp_ns: int, why: str, is_sound: bool = False) -> None:
        """End the epoch: the next one begins once the scale is known again.

        What is known of the calibration is kept only if the window that ends is sound (``is_sound``).
        """
        if self._window is not None:
            self.finish()
            if is_sound:
                self._calibration.keep()
            self.epoch += 1
            self._report(stamp_ns, EventKind.LOST, why)
        self._window = self._before = self._contradicted_since_ns = self._standstill = None
        self._solver.forget()
        self._collect_keyframes()
        self._since_ns, self._is_reported = stamp_ns, False

    def restart_imu(self, stamp_ns: int) -> None:
        """End the epoch, and forget samples and calibration: until this frameset the IMU's clock was wrong."""
        self._lose(stamp_ns, "the IMU's clock is corrected")
        self._calibration = self._calibration.after_restart()
        self._samples, self._shift_ns = self._new_samples(), 0
        self._solver.calibration, self._solver.samples = self._calibration, self._samples
        self._are_trusted = True
        self._collect_keyframes()

    def note_stamps(self, sigma_s: float) -> None:
        """Set the current estimate of the standard deviation of the framesets' stamps, seconds."""
        self._calibration.are_stamps_exact = sigma_s < _MAX_STAMP_SIGMA_S

    def doubt_imu(self, stamp_ns: int, is_doubted: bool) -> None:
        """Record whether the IMU's rotation contradicts that of the cameras; while it does, there is no pose."""
        self._is_imu_doubted = is_doubted
        if is_doubted and self._window is not None:
            self._lose(stamp_ns, _TURNS_OTHERWISE)

    def _collect_keyframes(self) -> None:
        """Begin to look for the scale, without any keyframes yet."""
        self._initialiser = self._new_initialiser()
        self._trust = OverlapTrust(self._new_initialiser(doubts_file=False))

    def _new_samples(self) -> SampleBuffer:
        assert self._rig.imu is not None
        return SampleBuffer(self._rig.imu, self._config)

    def _new_initialiser(self, doubts_file: bool = True) -> Initialiser:
        samples_of = partial(self._samples.between, bridges=False)
        return Initialiser(self._cameras, self._calibration, samples_of, FIRST_MONOCULAR_SIGMA_PX, doubts_file)

    def _oldest_needed_ns(self, stamp_ns: int) -> int:
        """Return the stamp since which IMU samples are still needed at a frameset."""
        oldest_ns = self._latest_ns if self._window is None else int(self._window.states.stamps_ns[0])
        if self._window is None and self._initialiser.oldest_ns is not None:
            oldest_ns = self._initialiser.oldest_ns
        if self._trust.oldest_ns is not None:
            oldest_ns = min(oldest_ns, max(self._trust.oldest_ns, stamp_ns - MAX_DURATION_NS))
        return oldest_ns
