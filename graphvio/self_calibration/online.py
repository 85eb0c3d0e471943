"""Self-calibration while the odometry runs: keyframes and IMU samples in, calibrations out.

Keyframes are collected in windows. Each window is adjusted several times while it grows, in a thread of its own; once
it is full, its evidence about the calibration is kept, and the next window begins. Windows share no observation. A
result comes into force a fixed number of framesets after its adjustment began, so that a run does not depend on timing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Set
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.kernels import await_compilers
from graphvio.measurements.inertial_state import InertialState
from graphvio.measurements.motion import RelativeMotion
from graphvio.measurements.sensors import ImuSample
from graphvio.rig import Rig
from graphvio.self_calibration.collector import FIRST_WINDOW_SIGMA_PX, WINDOW, FullWindow, WindowCollector
from graphvio.self_calibration.consider import ConsiderCovariance
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.evidence import MAX_FACTOR, Evidence, Gaussian
from graphvio.self_calibration.findings import Finding, findings
from graphvio.self_calibration.knock import Contradiction, KnockDetector, knock_covariance
from graphvio.self_calibration.motion_gains import MotionGains, PoseGain
from graphvio.self_calibration.parameters import RigCalibration, n_camera_parameters, parameter_names
from graphvio.self_calibration.pixel_noise import pixel_noise
from graphvio.self_calibration.prior import file_prior, walk_per_second
from graphvio.self_calibration.window import View
from graphvio.self_calibration.window_adjustment import AdjustedWindow, WindowAdjustment

_MIN_KEYFRAMES_OF_NOISE, _MIN_OBSERVATIONS_OF_NOISE = 3, 100
_MAX_SIGMAS = 4.0  # of a parameter, in the file's standard deviations times the largest factor
_MIN_AGREEING = 3  # keyframes whose pairs agreed: later contradictions are attributed to the scene
_MAX_REFUSED = 3  # full windows
_MIN_CONFIRMING = 2  # full windows; one is at times off by more than its covariance says
WALK = 0.01  # random walk in one second, as a share of the prior's standard deviations
_MAX_WALK_S = 10.0  # longest duration of the random walk over one window


class _Pace(NamedTuple):
    """How a window is collected and adjusted: the first ones quickly, since the rig file may be far off."""

    adjusted_at: tuple[int, ...]  # keyframes
    interval_s: float  # at least, between keyframes
    delay_framesets: int  # until a result comes into force


_PACES = (
    _Pace((1, 3, 6, 10, WINDOW), 0.1, 2),
    _Pace((5, 10, WINDOW), 0.1, 4),
    _Pace((5, 10, WINDOW), 0.15, 4),
    _Pace((8, WINDOW), 0.25, 8),
)
"""Paces of the first windows; the last one is also that of all later windows."""
_MAX_NOISE_RATIO = 1.4  # of a window that its calibration explains, to the noise of the windows before
_PACE_IN_DOUBT = 1  # of windows that are to show whether cameras have been moved


class SelfCalibration:
    """Estimates how the calibration of a rig differs from its rig file.

    Args:
        rig: rig of the rig file, with the standard deviations of its calibration.

    Attributes:
        estimate: current estimate of the calibration.
        extrinsics: index of a pair or single camera -> covariance (6, 6) of its pose relative to the first pair, see
            `graphvio.self_calibration.prior.extrinsic_covariances`; empty while the rig file is as good as exact. It is
            computed for the largest errors that a file may have: a few windows may show that it is wrong long before
            they show how wrong.
        upper_covariance: (C, C) covariance of the calibration if the rig file's standard deviations are all scaled by
            `MAX_FACTOR`; used by the innovation test.
        inertial_state: velocity, biases and gravity at the newest keyframe that the calibration in force is based on,
            or None without an IMU, or while the rig file is as good as exact.
        restarts: how often estimated extrinsics have been forgotten, after a knock or since later windows contradicted
            them.
        on_full_window: called with each window that is full, before it is adjusted.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._nominal = RigCalibration.of(rig)
        self._prior = file_prior(rig)
        upper_covariance = self._prior.with_factors(np.full(self._prior.n_groups, MAX_FACTOR))
        self._largest = np.where(self._prior.group < 0, np.inf, _MAX_SIGMAS * np.sqrt(np.diag(upper_covariance)))
        self._walk = walk_per_second(rig, self._prior, WALK)
        self._evidence = Evidence.none(len(self._walk))  # evidence of the full windows
        n_groups = self._prior.n_groups
        posterior = self._evidence.given(self._prior, np.ones(n_groups))
        at_first = self._prior.smallest_factors
        self.estimate = CalibrationEstimate(rig, posterior, np.zeros_like(posterior.mean), at_first)
        self.extrinsics: dict[int, Float] = {}
        self.upper_covariance = upper_covariance
        self.inertial_state: InertialState | None = None
        self.restarts = 0
        self.on_full_window: Callable[[FullWindow], None] = lambda _: None
        self._in_force = self._nominal
        self._in_force_covariance = self._prior.covariance[: self._n_camera_parameters, : self._n_camera_parameters]
        self._knocks = KnockDetector()
        self._agreeing = 0  # keyframes whose pairs agreed, before the first window or since
        self._contradiction = Contradiction()
        self._refused = 0  # full windows, one after the other
        self._implausible: list[Gaussian] = []  # calibrations of full windows by which the file is implausibly wrong
        self._are_cameras_beyond_any = False  # whether two full windows agree that the file's cameras are so wrong
        self._sigma_px = FIRST_WINDOW_SIGMA_PX
        self._collector = WindowCollector(rig)
        self._full_windows = 0
        self._used_windows = 0  # full windows that were not left out
        self._adjusted_at = 0  # number of this window's keyframes at its last adjustment
        self._pending: Future[AdjustedWindow | None] | None = None
        self._due_in = 0  # framesets until a result comes into force
        self._consider = ConsiderCovariance(self._n_camera_parameters)
        self._gains = MotionGains(rig)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="graphvio-calibration")

    def close(self) -> None:
        """End the thread."""
        self._worker.shutdown()

    def findings(self) -> list[Finding]:
        """Return what is known of each part of the calibration."""
        return findings(self.estimate, self._prior.covariance)

    def add_sample(self, sample: ImuSample) -> None:
        """Add an IMU sample as it was measured, in time order."""
        self._collector.add_sample(sample)

    def note_stamps(self, sigma_s: float) -> None:
        """Set the current estimate of the standard deviation of the framesets' stamps, seconds."""
        self._collector.stamp_sigma_s = sigma_s

    def add_motion(
        self, stamp_ns: int, instant_ns: int, odom_T_body: Float, motion: RelativeMotion | None, references: Set[int]
    ) -> None:
        """Add the motion of a frameset, before `add_frameset`; for arguments see `MotionGains.add`."""
        self._gains.add(stamp_ns, instant_ns, odom_T_body, motion, references, self._consider.newest_ns)

    def note_contradiction(self, stamp_ns: int, are_contradicting: bool) -> None:
        """Record whether the pairs contradict each other at a frameset: if that lasts, cameras may have been moved.

        This is considered only once full windows have confirmed the calibration. When a contradiction begins to last,
        or ends, the unfinished window is discarded, so that none has keyframes of both times.
        """
        lasted = self._is_contradiction_lasting
        self._contradiction.update(stamp_ns, are_contradicting)
        if self._is_contradiction_lasting != lasted:
            self._discard_window()

    def add_frameset(
        self,
        stamp_ns: int,
        odom_T_body: Float,
        views: Mapping[int, View],
        are_contradicting: bool = False,
        is_urgent: bool = False,
    ) -> None:
        """Add the views of a frameset, which becomes a keyframe if the images have moved.

        Args:
            stamp_ns: stamp of the frameset.
            odom_T_body: (4, 4) its estimated pose.
            views: index of the pair or single camera -> tracks.
            are_contradicting: whether the pairs' motions contradict each other. If they always did under this
                calibration, this is attributed to the calibration; if they agreed for some keyframes, to the scene.
            is_urgent: whether motions cannot be measured with the calibration in force: an adjustment that is due comes
                into force with this frameset then. Its left and right images alone show how far epipolar lines are off.
        """
        self._adjust_when_due()
        if not self._collector.is_keyframe(stamp_ns, views, self._pace.interval_s):
            return
        if self.is_trusted:
            if knocked := self._knocked(views):
                self._forget_extrinsics(knocked)
            elif are_contradicting and not self.is_doubted:
                return
        self._agreeing += not are_contradicting
        self._collector.add(stamp_ns, odom_T_body, views)
        self._gains.note_keyframe(stamp_ns)
        if is_urgent:
            self._adjust_when_due()
            self._due_in = 0

    def pose_covariance(self, odom_T_body: Float) -> Float:
        """Return the covariance (6, 6) that errors of the calibration add to the newest pose (4, 4)."""
        return self._consider.at(odom_T_body, self._since_newest())

    def correct_pose(self, turned: Float) -> None:
        """Record that the newest pose has been changed by a tangent (6,) in body, since the calibration has changed."""
        self._consider.correct(turned)

    def start_window(self) -> None:
        """Discard the unfinished window: later poses are in another frame."""
        self._contradiction = Contradiction()
        self._gains.restart()
        self._discard_window()

    def restart_imu(self) -> None:
        """Discard everything that has earlier IMU samples: later ones are of another clock."""
        self._pending = None
        self._discard_window()
        self._collector.forget_samples()

    def update(self) -> bool:
        """Take the result that comes into force after this frameset, if there is one.

        Returns:
            Whether the calibration in force has changed.
        """
        if self._pending is None:
            return False
        if self._due_in > 0:
            self._due_in -= 1
            return False
        adjusted, self._pending = self._pending.result(), None
        if adjusted is None or not self._is_acceptable(adjusted):
            return False
        was_exact = self.estimate.is_file_exact
        self._put_in_force(adjusted)
        return not (was_exact and self.estimate.is_file_exact)

    @property
    def is_trusted(self) -> bool:
        """Whether contradictions of pairs are attributed to the scene, and no longer to the calibration."""
        if self.has_full_window:
            return True
        return self.estimate.is_file_exact and self._agreeing >= _MIN_AGREEING

    @property
    def is_first_window_doubted(self) -> bool:
        """Whether the pairs have hardly agreed under the calibration of the first window, which may then be wrong."""
        return len(self._rig.groups) > 1 and self._used_windows == 1 and self._agreeing < _MIN_AGREEING

    @property
    def _is_contradiction_lasting(self) -> bool:
        """Whether pairs contradict each other for so long, by a confirmed calibration, that cameras may have moved."""
        return self.is_confirmed and self._contradiction.lasts

    @property
    def is_doubted(self) -> bool:
        """Whether contradictions of pairs are attributed to the calibration although it is trusted.

        The first window may be wrong, or cameras may have been moved.
        """
        return self.is_first_window_doubted or self._is_contradiction_lasting

    @property
    def _n_camera_parameters(self) -> int:
        """Number of the cameras' parameters, the first ones of all."""
        return n_camera_parameters(self._rig)

    @property
    def implausible_parameter(self) -> str | None:
        """Name of the parameter that is farthest off, where windows find the rig file more wrong than any file may be.

        None while there is but one such window, and once two have agreed, as the calibration is corrected then.
        """
        if len(self._implausible) < _MIN_CONFIRMING:
            return None
        mean = self._implausible[-1].mean
        excess = np.divide(np.abs(mean), self._largest, out=np.zeros_like(mean), where=self._largest > 0.0)
        return parameter_names(self._rig)[int(np.argmax(excess))]

    @property
    def has_full_window(self) -> bool:
        """Whether the estimate is based on at least one full window."""
        return self._used_windows > 0

    @property
    def is_confirmed(self) -> bool:
        """Whether the estimate is based on at least two full windows, which share no observation."""
        return self._used_windows >= _MIN_CONFIRMING

    @property
    def _pace(self) -> _Pace:
        latest = _PACE_IN_DOUBT if self._is_contradiction_lasting else len(_PACES) - 1
        return _PACES[min(self._full_windows, latest)]

    def _is_acceptable(self, adjusted: AdjustedWindow) -> bool:
        """Return whether an adjustment may come into force; one that contradicts those before it counts as refused."""
        calibration = adjusted.solution.calibration
        if self.has_full_window and not adjusted.prior.is_confirmed_by(calibration):
            # While pairs contradict each other, the cause may be what moves in a view: it fits no calibration.
            self._refuse(adjusted.is_full and (not self._is_contradiction_lasting or self._fits(adjusted)))
            return False
        if not self._is_plausible(calibration, adjusted.is_full):
            return False
        # An unfinished window does not refute what a full one has confirmed: the scene may be at fault.
        is_confirmed = self.has_full_window and self.estimate.is_file_exact
        return adjusted.is_full or adjusted.estimate.is_file_exact or not is_confirmed

    def _is_plausible(self, calibration: Gaussian, is_full: bool) -> bool:
        """Return whether the rig file can be as wrong as a window says.

        If that is more than any file may be, the window is at fault, unless the full one before says the same of the
        cameras. An IMU that is so wrong is not calibrated.
        """
        if not np.isfinite(calibration.mean).all():
            return False
        is_usual = np.abs(calibration.mean) <= self._largest
        n = self._n_camera_parameters
        are_cameras_plausible = bool(is_usual[:n].all()) or self._are_cameras_beyond_any
        is_imu_plausible = bool(is_usual[n:].all())
        if are_cameras_plausible and is_imu_plausible:
            return True
        if is_full:
            agree = bool(self._implausible) and calibration.agrees_with(self._implausible[-1])
            self._implausible.append(calibration)
            if agree and is_imu_plausible:
                self._are_cameras_beyond_any, self._implausible = True, []
                return True
        return False

    def _put_in_force(self, adjusted: AdjustedWindow) -> None:
        """Use an adjustment's result from now on, and its pixel noise for the next windows."""
        if adjusted.is_full:
            self._evidence, self._refused, self._implausible = adjusted.evidence, 0, []
            self._used_windows += 1
            if not adjusted.estimate.is_file_exact:
                self._agreeing = 0  # those agreed under the calibration before this one
        solution, n = adjusted.solution, self._n_camera_parameters
        if (
            len(solution.states.poses) >= _MIN_KEYFRAMES_OF_NOISE
            and len(solution.errors2) >= _MIN_OBSERVATIONS_OF_NOISE
        ):
            self._sigma_px = pixel_noise(solution.errors2, solution.window.tracks.sigma_px[:, None])
        self._consider.extend(adjusted.keyframes, adjusted.by_cameras)
        difference = adjusted.estimate.difference[:n]
        self._consider.set_calibration_in_force(difference, adjusted.covariance, self._since_newest())
        self.estimate, self.extrinsics = adjusted.estimate, adjusted.extrinsics
        self.upper_covariance = adjusted.upper_covariance
        self._in_force, self._in_force_covariance = self._nominal.moved(difference), adjusted.covariance
        self.inertial_state = adjusted.inertial_state

    def _discard_window(self) -> None:
        self._collector.restart()
        self._adjusted_at = 0

    def _since_newest(self) -> PoseGain | None:
        """Return how the newest pose depends on the calibration since the keyframe that was adjusted last."""
        newest_ns = self._consider.newest_ns
        return None if newest_ns is None else self._gains.since(newest_ns)

    def _knocked(self, views: Mapping[int, View]) -> list[int]:
        """Return the pairs that have been knocked, by a keyframe's views; none while the calibration is unconfirmed."""
        if not (self.is_confirmed or self.estimate.is_file_exact):
            return []
        return self._knocks.update(views, self._in_force, self._in_force_covariance)

    def _fits(self, adjusted: AdjustedWindow) -> bool:
        """Return whether a window's calibration explains its views, with the noise of the windows before."""
        shown_px = pixel_noise(adjusted.solution.errors2, adjusted.solution.window.tracks.sigma_px[:, None])
        return shown_px < _MAX_NOISE_RATIO * self._sigma_px

    def _refuse(self, counts: bool) -> None:
        """Discard a window that contradicts those before it; three that count are taken as a knock.

        A window that comes into force in between ends the count.
        """
        self._refused += counts
        if self._refused >= _MAX_REFUSED:
            self._forget_extrinsics(range(len(self._rig.groups)))

    def _forget_extrinsics(self, groups: Iterable[int]) -> None:
        """Estimate extrinsics again after a knock of some pairs or cameras.

        What is known of the others, of lenses and of the IMU is kept.
        """
        self._pending = None
        change = knock_covariance(self._rig, len(self._walk), groups)
        self._evidence, self._prior = self._evidence.after_random_walk(change), self._prior.changed(change)
        self._collector.begin_window()
        self._adjusted_at = self._full_windows = 0
        self._used_windows, self._agreeing, self._refused = 0, 0, 0
        self._contradiction = Contradiction()
        self._knocks = KnockDetector()  # offsets by another calibration are not comparable
        self.restarts += 1
        self._consider.forget()

    def _adjust_when_due(self) -> None:
        """Begin to adjust the window as it is now, if it has grown enough; a full one is followed by a new one.

        This is done once the frameset after the last keyframe has come: by then the IMU covers the last keyframe,
        whatever its time offset.
        """
        if self._pending is not None:
            return
        if len(self._collector.keyframes) < min(size for size in self._pace.adjusted_at if size > self._adjusted_at):
            return
        window = tuple(self._collector.keyframes)
        self._due_in = self._pace.delay_framesets
        self._adjusted_at = len(window)
        if is_full := len(window) >= WINDOW:
            self._collector.begin_window()
            self._adjusted_at, self._full_windows = 0, self._full_windows + 1
            duration_s = min((window[-1].stamp_ns - window[0].stamp_ns) * 1e-9, _MAX_WALK_S)
            self._evidence = self._evidence.after_random_walk(duration_s * self._walk)
        samples = self._collector.samples_of(window)
        if is_full:
            self.on_full_window(FullWindow(window, samples, self._sigma_px))
        adjustment = WindowAdjustment(
            rig=self._rig,
            nominal=self._nominal,
            file_prior=self._prior,
            factors=self.estimate.file_factors,
            evidence=self._evidence,
            difference=self.estimate.posterior.mean,
            keyframes=window,
            samples=samples,
            sigma_px=self._sigma_px,
            is_full=is_full,
        )
        self._pending = self._worker.submit(_when_compiled, adjustment)


def _when_compiled(adjustment: WindowAdjustment) -> AdjustedWindow | None:
    """Adjust a window as soon as another process has compiled the kernels for that."""
    await_compilers()
    return adjustment.result()
