"""Self-calibration while the odometry runs: keyframes and IMU samples in, calibrations out.

Keyframes are collected in windows. Each window is adjusted several times while it grows, in a thread of its own; once
it is full, what it says of the calibration is kept, and the next window begins. Windows share no observation. A result
comes into force a fixed number of framesets after its adjustment began, so that a run does not depend on timing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Set
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError
from graphvio.kernels import await_compilers
from graphvio.linear_algebra import cholesky, solve_lower, solve_rows
from graphvio.measurements.motion import RelativeMotion
from graphvio.measurements.sensors import GRAVITY_M_S2, ImuSample
from graphvio.rig import Rig
from graphvio.self_calibration.adjustment import adjusted
from graphvio.self_calibration.collector import FIRST_WINDOW_SIGMA_PX, WINDOW, FullWindow, WindowCollector
from graphvio.self_calibration.consider import ConsiderCovariance
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.self_calibration.evidence import (
    EXACT,
    MAX_FACTOR,
    MIN_TWICE_LOG_BAYES_FACTORS,
    Evidence,
    FactorLikelihood,
    Gaussian,
)
from graphvio.self_calibration.findings import Finding, findings
from graphvio.self_calibration.inertial import InertialSamples
from graphvio.self_calibration.knock import KnockDetector, knock_covariance
from graphvio.self_calibration.motion_gains import MotionGains, PoseGain
from graphvio.self_calibration.parameters import RigCalibration, n_camera_parameters, parameter_names
from graphvio.self_calibration.pixel_noise import pixel_noise
from graphvio.self_calibration.prior import extrinsic_covariances, file_prior, walk_per_second
from graphvio.self_calibration.solver import Solution
from graphvio.self_calibration.window import Keyframe, View

_MIN_KEYFRAMES_OF_NOISE, _MIN_OBSERVATIONS_OF_NOISE = 3, 100
_MAX_SIGMAS = 4.0  # of a parameter, by the file's standard deviations times the largest factor
_MIN_AGREEING = 3  # keyframes whose pairs agreed, from which contradictions are the scene's
_MAX_REFUSED = 3  # full windows
_MIN_CONFIRMING = 2  # full windows; one is at times off by more than its covariance says
WALK = 0.01  # in one second, as a share of the prior's standard deviations
_MAX_WALK_S = 10.0  # in a window


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
"""Of the first windows; the last one is that of all later ones."""


class _Adjusted(NamedTuple):
    prior: Gaussian
    solution: Solution
    evidence: Evidence
    estimate: CalibrationEstimate
    extrinsics: dict[int, Float]
    upper_covariance: Float
    covariance: Float  # of the cameras' parameters that come into force
    by_cameras: Float
    window: tuple[Keyframe, ...]
    is_full: bool


class SelfCalibration:
    """Estimates how the calibration of a rig differs from its rig file.

    Args:
        rig: from the rig file, with how far its calibration is known.

    Attributes:
        estimate: what is known now.
        extrinsics: index of a pair or single camera -> covariance (6, 6) of its pose relative to the first pair, see
            `graphvio.self_calibration.prior.extrinsic_covariances`; empty while the rig file is as good as exact. The
            file may be as wrong there as any: a few windows may show that it is wrong long before they show how wrong.
        upper_covariance: (C, C) covariance of the calibration if the rig file's standard deviations are all scaled by
            `MAX_FACTOR`; used by the innovation test.
        restarts: how often what was known has been forgotten, since later windows contradicted it.
        on_full_window: called with each window that is full, before it is adjusted.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._nominal = RigCalibration.of(rig)
        self._prior = file_prior(rig)
        upper_covariance = self._prior.with_factors(np.full(self._prior.n_groups, MAX_FACTOR))
        self._largest = np.where(self._prior.group < 0, np.inf, _MAX_SIGMAS * np.sqrt(np.diag(upper_covariance)))
        self._walk = walk_per_second(rig, self._prior, WALK)
        self._evidence = Evidence.none(len(self._walk))  # of the full windows
        n_groups = self._prior.n_groups
        posterior = self._evidence.given(self._prior, np.ones(n_groups))
        exact = np.full(n_groups, EXACT)
        self.estimate = CalibrationEstimate(rig, posterior, np.zeros_like(posterior.mean), exact)
        self.extrinsics: dict[int, Float] = {}
        self.upper_covariance = upper_covariance
        self.restarts = 0
        self.on_full_window: Callable[[FullWindow], None] = lambda _: None
        self._in_force = self._nominal
        self._knocks = KnockDetector()
        self._agreeing = 0  # keyframes
        self._refused = 0  # full windows, one after the other
        self._implausible = 0  # the same, by which the rig file is more wrong than any
        self._farthest = ""  # parameter in the newest of these
        self._sigma_px = FIRST_WINDOW_SIGMA_PX
        self._collector = WindowCollector(rig)
        self._full_windows = 0
        self._used_windows = 0  # full ones, without those that are left out
        self._adjusted_at = 0  # keyframes of this window
        self._pending: Future[_Adjusted] | None = None
        self._due_in = 0  # framesets
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
        """Take an IMU sample as it was measured, in time order."""
        self._collector.add_sample(sample)

    def note_stamps(self, sigma_s: float) -> None:
        """Take the standard deviation of the framesets' stamps, seconds, as it is known now."""
        self._collector.stamp_sigma_s = sigma_s

    def add_motion(
        self, stamp_ns: int, instant_ns: int, odom_T_body: Float, motion: RelativeMotion | None, references: Set[int]
    ) -> None:
        """Add the motion of a frameset, before `add_frameset`; for arguments see `MotionGains.add`."""
        self._gains.add(stamp_ns, instant_ns, odom_T_body, motion, references, self._consider.newest_ns)

    def add_frameset(
        self,
        stamp_ns: int,
        odom_T_body: Float,
        views: Mapping[int, View],
        are_contradicting: bool = False,
        is_urgent: bool = False,
    ) -> None:
        """Take what the pairs see at a frameset.

        Args:
            stamp_ns: of the frameset.
            odom_T_body: (4, 4) its estimated pose.
            views: index of the pair or single camera -> tracks.
            are_contradicting: whether the pairs' motions contradict each other. It is the calibration if they always
                did, and the scene if they once agreed.
            is_urgent: whether motions cannot be measured with the calibration in force: an adjustment that is due comes
                into force with this frameset then. Its left and right images alone show how epipolar lines are off.
        """
        self._adjust_when_due()
        if not self._collector.is_keyframe(stamp_ns, views, self._pace.interval_s):
            return
        if self.is_trusted:
            if knocked := self._knocks.update(views, self._in_force):
                self._forget_extrinsics(knocked)
            elif are_contradicting:
                return
        self._agreeing += not are_contradicting
        self._collector.add(stamp_ns, odom_T_body, views)
        self._gains.note_keyframe()
        if is_urgent:
            self._adjust_when_due()
            self._due_in = 0

    def pose_covariance(self, odom_T_body: Float) -> Float:
        """Return the covariance (6, 6) that errors of the calibration add to the newest pose (4, 4)."""
        return self._consider.at(odom_T_body, self._since_newest())

    def correct_pose(self, turned: Float) -> None:
        """Take note that the newest pose has been changed by a tangent (6,) in body, as the calibration asked for."""
        self._consider.correct(turned)

    def start_window(self) -> None:
        """Discard the window that is not full: the poses that come are in another frame."""
        self._gains.restart()
        self._discard_window()

    def restart_imu(self) -> None:
        """Discard all that has IMU samples of before: those that come are of another clock."""
        self._drop_pending()
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
        pending, self._pending = self._pending, None
        adjusted = _finished_adjustment(pending)
        if adjusted is None or not self._is_acceptable(adjusted):
            return False
        was_exact = self.estimate.is_file_exact
        self._put_in_force(adjusted)
        return not (was_exact and self.estimate.is_file_exact)

    @property
    def is_trusted(self) -> bool:
        """Whether pairs that contradict each other are the scene's fault, and no longer the calibration's."""
        if self.has_full_window:
            return True
        return self.estimate.is_file_exact and self._agreeing >= _MIN_AGREEING

    @property
    def _n_camera_parameters(self) -> int:
        """Number of the cameras' parameters, the first ones of all."""
        return n_camera_parameters(self._rig)

    @property
    def implausible_parameter(self) -> str | None:
        """Name of the parameter that is farthest off where windows say that the rig file is more wrong than any."""
        return self._farthest if self._implausible >= _MIN_CONFIRMING else None

    @property
    def has_full_window(self) -> bool:
        """Whether what is known is based on a full window at least."""
        return self._used_windows > 0

    @property
    def is_confirmed(self) -> bool:
        """Whether what is known comes from two full windows at least, which share no observation."""
        return self._used_windows >= _MIN_CONFIRMING

    @property
    def _pace(self) -> _Pace:
        return _PACES[min(self._full_windows, len(_PACES) - 1)]

    def _is_acceptable(self, adjusted: _Adjusted) -> bool:
        """Return whether an adjustment may come into force; one that contradicts those before it counts as refused."""
        calibration = adjusted.solution.calibration
        if self.has_full_window and not adjusted.prior.is_confirmed_by(calibration):
            self._refuse(adjusted.is_full)
            return False
        if not (np.abs(calibration.mean) <= self._largest).all():  # also rejects NaN
            self._note_implausible(adjusted)
            return False  # no rig file is so wrong: the measurements are
        # What a full window has confirmed, a part of one does not refute: it may be the scene's fault.
        is_confirmed = self.has_full_window and self.estimate.is_file_exact
        return adjusted.is_full or adjusted.estimate.is_file_exact or not is_confirmed

    def _note_implausible(self, adjusted: _Adjusted) -> None:
        """Count a full window that asks for a calibration by which the rig file is more wrong than any."""
        mean = adjusted.solution.calibration.mean
        if adjusted.is_full and np.isfinite(mean).all():
            self._implausible += 1
            excess = np.divide(np.abs(mean), self._largest, out=np.zeros_like(mean), where=self._largest > 0.0)
            self._farthest = parameter_names(self._rig)[int(np.argmax(excess))]

    def _put_in_force(self, adjusted: _Adjusted) -> None:
        """Use an adjustment's result from now on, and its noise for the next windows."""
        if adjusted.is_full:
            self._evidence, self._refused, self._implausible = adjusted.evidence, 0, 0
            self._used_windows += 1
        solution, n = adjusted.solution, self._n_camera_parameters
        if (
            len(solution.states.poses) >= _MIN_KEYFRAMES_OF_NOISE
            and len(solution.errors2) >= _MIN_OBSERVATIONS_OF_NOISE
        ):
            self._sigma_px = pixel_noise(solution.errors2, self._sigma_px)
        self._consider.extend(adjusted.window, adjusted.by_cameras)
        difference = adjusted.estimate.difference[:n]
        self._consider.set_calibration_in_force(difference, adjusted.covariance, self._since_newest())
        self.estimate, self.extrinsics = adjusted.estimate, adjusted.extrinsics
        self.upper_covariance = adjusted.upper_covariance
        self._in_force = self._nominal.moved(difference)

    def _discard_window(self) -> None:
        self._collector.restart()
        self._adjusted_at = 0

    def _since_newest(self) -> PoseGain | None:
        """Return how the newest pose depends on the calibration since the keyframe that was adjusted last."""
        newest_ns = self._consider.newest_ns
        return None if newest_ns is None else self._gains.since(newest_ns)

    def _refuse(self, is_full: bool) -> None:
        """Discard a window that contradicts those before it; several such windows are a knock."""
        self._refused += is_full
        if self._refused >= _MAX_REFUSED:
            self._forget_extrinsics(range(len(self._rig.groups)))

    def _drop_pending(self) -> None:
        """Discard the window that is being adjusted, which is from before a break.

        It waits for the adjustment, which reads what changes after this call.
        """
        if self._pending is not None:
            wait([self._pending])
            self._pending = None

    def _forget_extrinsics(self, groups: Iterable[int]) -> None:
        """Begin again after a knock of some pairs or cameras, with what was known of the others, of lenses and IMU."""
        self._drop_pending()
        change = knock_covariance(self._rig, len(self._walk), groups)
        self._evidence, self._prior = self._evidence.after_random_walk(change), self._prior.changed(change)
        self._collector.keyframes, self._adjusted_at, self._full_windows = [], 0, 0
        self._used_windows, self._agreeing, self._refused = 0, 0, 0
        self.restarts += 1
        self._consider.forget()

    def _adjust_when_due(self) -> None:
        """Begin to adjust the window as it is now, if it has grown enough; a full one is followed by a new one.

        It is done when the frameset after the last keyframe has come: by then the IMU covers the last keyframe,
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
            self._collector.keyframes, self._adjusted_at, self._full_windows = [], 0, self._full_windows + 1
            duration_s = min((window[-1].stamp_ns - window[0].stamp_ns) * 1e-9, _MAX_WALK_S)
            self._evidence = self._evidence.after_random_walk(duration_s * self._walk)
        assumed = _assumed(self.estimate.file_factors)
        prior = self._evidence.given(self._prior, assumed)
        samples, difference = self._collector.samples_of(window), self.estimate.posterior.mean
        if is_full:
            self.on_full_window(FullWindow(window, samples, self._sigma_px))
        self._pending = self._worker.submit(self._adjust, window, samples, difference, prior, assumed, is_full)

    def _adjust(
        self,
        window: tuple[Keyframe, ...],
        samples: InertialSamples | None,
        difference: Float,
        prior: Gaussian,
        assumed: Float,
        is_full: bool,
    ) -> _Adjusted:
        """Adjust a window; what is read here does not change while an adjustment is pending."""
        await_compilers()
        solution = adjusted(window, samples, self._nominal, difference, prior, self._sigma_px)
        evidence, likelihood, factors, twice_log_bayes_factor = self._judged(prior, solution)
        if solution.has_converged and not np.array_equal(_assumed(factors), assumed):
            # What the window says was linearised where another file led it.
            prior = self._evidence.given(self._prior, _assumed(factors))
            solution = adjusted(window, samples, self._nominal, solution.calibration.mean, prior, self._sigma_px)
            evidence, likelihood, factors, twice_log_bayes_factor = self._judged(prior, solution)
        posterior = evidence.given(self._prior, _assumed(factors))
        n, in_force = self._n_camera_parameters, np.zeros_like(difference)
        is_changed = self._prior.change is not None
        if is_changed or (factors != EXACT).any():
            in_force = evidence.given(self._prior, factors).mean
        covariance = evidence.mean_square(self._prior, in_force, likelihood)[:n, :n]
        extrinsics = {}
        estimate = CalibrationEstimate(self._rig, posterior, in_force, factors, twice_log_bayes_factor, is_changed)
        _ = estimate.rig  # build the rig now: it raises RigError here rather than later in the odometry's thread
        anywhere = evidence.given(self._prior, np.full_like(factors, MAX_FACTOR))
        if not estimate.is_file_exact:
            extrinsics = extrinsic_covariances(self._rig, anywhere.covariance)
        by_cameras = solution.poses_by_cameras(n)
        return _Adjusted(
            prior,
            solution,
            evidence,
            estimate,
            extrinsics,
            anywhere.covariance,
            covariance,
            by_cameras,
            window,
            is_full,
        )

    def _judged(self, prior: Gaussian, solution: Solution) -> tuple[Evidence, FactorLikelihood, Float, float]:
        """Return what a window and those before say, its likelihood, the file's factors, and their Bayes factor."""
        evidence = self._evidence.with_window(prior, solution.calibration)
        likelihood = FactorLikelihood(evidence, self._prior)
        return evidence, likelihood, *evidence.file_factors(self._prior, MIN_TWICE_LOG_BAYES_FACTORS, likelihood)


def warm_up_adjustment(rig: Rig) -> None:
    """Adjust two keyframes that see one point, to compile or load the kernels."""
    stamps_ns, point = (0, 100_000_000), np.full((1, 2), 100.0)
    seen = View(np.zeros(1, dtype=np.int64), point, point, np.ones(1, dtype=bool), np.ones(1))
    calibration = SelfCalibration(rig)
    keyframes = tuple(Keyframe(stamp_ns, np.eye(4), {0: seen}) for stamp_ns in stamps_ns)
    for stamp_ns in (-10_000_000, *stamps_ns, 110_000_000) if rig.imu is not None else ():
        calibration.add_sample(ImuSample(stamp_ns, np.zeros(3), np.array([0.0, 0.0, GRAVITY_M_S2])))
    prior = calibration.estimate.posterior
    samples = calibration._collector.samples_of(keyframes)
    adjusted(keyframes, samples, calibration._nominal, prior.mean, prior, FIRST_WINDOW_SIGMA_PX)
    calibration.close()
    information, right = np.eye(2), np.zeros((2, 2))  # of the evidence, and of what all cameras have in common
    solve_lower(cholesky(information), right)
    solve_rows(information, right)


def _finished_adjustment(pending: Future[_Adjusted]) -> _Adjusted | None:
    """Return an adjustment when it is done, or None where it says nothing."""
    try:
        adjusted = pending.result()
    except np.linalg.LinAlgError:
        return None  # measurements that determine nothing
    except RigError:
        # The estimated IMU parameters are outside what Imu accepts, so the IMU's measurements must be wrong.
        return None
    return adjusted if adjusted.solution.has_converged else None


def _assumed(factors: Float) -> Float:
    """Return the factors without those of exact parts, which may yet turn out to be wrong."""
    return np.where(factors == EXACT, 1.0, factors)
