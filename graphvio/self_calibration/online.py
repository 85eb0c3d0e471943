"""Self-calibration while the odometry runs: keyframes in, corrected rigs out.

Keyframes are collected in windows. Each window is adjusted several times while it grows, in a thread of its own, and
once it is full its posterior of the calibration is the next window's prior: a recursive estimator, whose windows share
no observation. A result comes into force a fixed number of framesets after its adjustment began, so that a run does not
depend on timing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.rig import Imu, Rig
from graphvio.self_calibration.evidence import EXACT, Evidence, Gaussian
from graphvio.self_calibration.imu_model import ACCEL_MATRIX, GYRO_BIAS, GYRO_MATRIX, TIME_OFFSET
from graphvio.self_calibration.inertial import InertialSamples
from graphvio.self_calibration.parameters import PAIR, RigCalibration
from graphvio.self_calibration.prior import CalibrationSigmas
from graphvio.self_calibration.solver import Solution, GRAVITY_M_S2, States, Window, solve
from graphvio.self_calibration.window import Keyframe, View, choose_tracks

_WINDOW = 16  # keyframes
_ADJUSTED_AT = ((1, 3, 6, 10, _WINDOW), (_WINDOW // 2, _WINDOW))  # keyframes, of the first window and later ones
_MAX_TRACKS = 150  # of each pair
_INTERVALS_S = (0.1, 0.25)  # between keyframes, in the first window and later
_MIN_DISPLACEMENT_PX = 8.0  # median of a pair's tracks since the keyframe before
_DELAYS_FRAMESETS = (2, 8)  # until a result comes into force, in the first window and later
_FIRST_SIGMA_PX = 0.15
_MIN_SIGMA_PX = 0.06
_NOISE_FACTOR = 2.0  # on the noise that residuals show: observations of one track are correlated
_RAYLEIGH_MEDIAN = 1.1774  # of the norm of two standard normal variables
_WALK = 0.01  # in one second, as a share of the prior's standard deviations
_MAX_WALK_S = 10.0  # between two windows
_IMU_NOISE_FACTOR = 2.0  # on the stated densities: biases walk within a window, too
_MARGIN_NS = 50_000_000  # of IMU samples around a window
_MAX_IMU_GAP_NS = 50_000_000


class _Adjusted(NamedTuple):
    prior: Gaussian
    solution: Solution
    sigma_px: float


class SelfCalibration:
    """Estimates the differences of a rig's calibration from its rig file.

    Args:
        rig: from the rig file.
        sigmas: how far it is known.

    Attributes:
        posterior: of the difference from the rig file.
        file_factor: by which factor the file's errors exceed the stated standard deviations, `EXACT` at least.
        log_bayes_factor: twice the logarithm of the odds of that factor against an exact file; above 10 it is very strong
            evidence (R. E. Kass, A. E. Raftery, *Bayes factors*, 1995).
    """

    def __init__(self, rig: Rig, sigmas: CalibrationSigmas) -> None:
        self._rig = rig
        self._nominal = RigCalibration.of(rig)
        self._prior = sigmas.prior(rig)
        self._walk = _WALK**2 * self._prior.covariance  # in one second
        if rig.imu is not None:
            self._set_bias_walk(rig.imu)
        self._evidence = Evidence.none(len(self._walk))  # of the windows that are full
        self.posterior = self._evidence.given(self._prior, 1.0)
        self.file_factor, self.log_bayes_factor = EXACT, 0.0
        self._samples: deque[tuple[int, Float]] = deque()
        self._sigma_px = _FIRST_SIGMA_PX
        self._keyframes: list[Keyframe] = []
        self._last: Keyframe | None = None
        self._committed = 0  # windows
        self._adjusted_at = 0  # keyframes of this window
        self._pending: Future[_Adjusted] | None = None
        self._pending_is_full = False
        self._due_in = 0  # framesets
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="graphvio-calibration")

    def close(self) -> None:
        """End the thread."""
        self._worker.shutdown()

    def take_rig(self) -> Rig | None:
        """Return the rig that is in force from this frameset on, or None where that has not changed."""
        if self._pending is None:
            return None
        self._due_in -= 1
        if self._due_in > 0:
            return None
        (prior, solution, self._sigma_px), self._pending = self._pending.result(), None
        evidence = self._evidence.with_window(prior, solution.calibration)
        if self._pending_is_full:
            self._evidence = evidence
        was_exact = self.file_factor == EXACT
        self.file_factor, self.log_bayes_factor = evidence.file_factor(self._prior)
        self.posterior = evidence.given(self._prior, self._assumed_factor)
        if self.file_factor == EXACT and was_exact:
            return None
        return self.refined_rig

    @property
    def refined_rig(self) -> Rig:
        """The rig with the calibration as it is known now."""
        if self.file_factor == EXACT:
            return self._rig
        rig = self._nominal.moved(self.posterior.mean[: self._n_cameras]).applied_to(self._rig)
        if rig.imu is None:
            return rig
        return replace(rig, imu=replace(rig.imu, time_offset_s=rig.imu.time_offset_s + self.time_offset_s))

    @property
    def time_offset_s(self) -> float:
        """Difference of the IMU's time offset from the rig file's."""
        if self._rig.imu is None or self.file_factor == EXACT:
            return 0.0
        return float(self.posterior.mean[self._n_cameras + TIME_OFFSET])

    @property
    def imu_matrices(self) -> tuple[Float, Float]:
        """Errors (3, 3) of the matrices of gyro and accelerometer."""
        if self._rig.imu is None or self.file_factor == EXACT:
            return np.zeros((3, 3)), np.zeros((3, 3))
        imu = self.posterior.mean[self._n_cameras :]
        return imu[GYRO_MATRIX:ACCEL_MATRIX].reshape(3, 3), imu[ACCEL_MATRIX:TIME_OFFSET].reshape(3, 3)

    @property
    def _n_cameras(self) -> int:
        return PAIR * len(self._rig.pairs)

    @property
    def _assumed_factor(self) -> float:
        return 1.0 if self.file_factor == EXACT else self.file_factor

    def _set_bias_walk(self, imu: Imu) -> None:
        at, walk = self._n_cameras, self._walk
        biases = np.arange(at + GYRO_BIAS, at + GYRO_MATRIX)
        walks = np.repeat([imu.gyro_random_walk, imu.accel_random_walk], 3)
        walk[biases, biases] = (_IMU_NOISE_FACTOR * walks) ** 2

    def add_sample(self, stamp_ns: int, angular_velocity: Float, linear_acceleration: Float) -> None:
        """Take an IMU sample; its stamp is on the framesets' clock by the rig file's time offset."""
        self._samples.append((stamp_ns, np.concatenate([angular_velocity, linear_acceleration])))

    def observe(self, stamp_ns: int, odom_T_body: Float, views: Mapping[int, View]) -> None:
        """Take what the pairs see at a frameset, with its estimated pose (4, 4)."""
        if not views or not self._is_keyframe(stamp_ns, views):
            return
        self._last = Keyframe(stamp_ns, odom_T_body, views)
        self._keyframes.append(self._last)
        if self._pending is not None or len(self._keyframes) < self._next_size():
            return
        window = self._keyframes
        self._pending_is_full = len(window) >= _WINDOW
        self._adjusted_at = len(window)
        if self._pending_is_full:
            self._keyframes, self._adjusted_at = [], 0
            self._committed += 1
        self._pending = self._worker.submit(self._adjust, list(window), self._samples_of(window))
        self._due_in = _DELAYS_FRAMESETS[min(self._committed, 1)]

    def _next_size(self) -> int:
        return next((size for size in _ADJUSTED_AT[min(self._committed, 1)] if size > self._adjusted_at), _WINDOW)

    def _is_keyframe(self, stamp_ns: int, views: Mapping[int, View]) -> bool:
        last = self._last
        if last is None:
            return True
        interval_s = _INTERVALS_S[min(self._committed, 1)]
        if stamp_ns - last.stamp_ns < interval_s * 1e9 - 1e6:
            return False
        common = views.keys() & last.views.keys()
        return any(_displacement_px(last.views[j], views[j]) >= _MIN_DISPLACEMENT_PX for j in common) or not common

    def _samples_of(self, window: list[Keyframe]) -> InertialSamples | None:
        """Return the IMU over a window, or None where there is none, and forget what is older."""
        imu = self._rig.imu
        while self._samples and self._samples[0][0] < window[0].stamp_ns - _MARGIN_NS:
            self._samples.popleft()
        if imu is None or not self._samples:
            return None
        return InertialSamples(
            np.array([stamp_ns for stamp_ns, _ in self._samples]),
            np.array([reading for _, reading in self._samples]),
            np.array([keyframe.stamp_ns for keyframe in window]),
            _IMU_NOISE_FACTOR * np.array([imu.gyro_noise_density, imu.accel_noise_density]),
            _MAX_IMU_GAP_NS,
        )

    def _adjust(self, keyframes: list[Keyframe], samples: InertialSamples | None) -> _Adjusted:
        """Adjust a window; what is read of this object does not change while an adjustment is pending."""
        poses = np.array([keyframe.odom_T_body for keyframe in keyframes])
        stamps_s = np.array([(keyframe.stamp_ns - keyframes[0].stamp_ns) * 1e-9 for keyframe in keyframes])
        self._evidence = self._evidence.forgotten((min(stamps_s[-1], _MAX_WALK_S) + 1e-3) * self._walk)
        prior, difference = self._evidence.given(self._prior, self._assumed_factor), self.posterior.mean
        nominal = self._nominal.moved(difference[: self._n_cameras])
        tracks, landmarks = choose_tracks(keyframes, poses, nominal, _MAX_TRACKS)
        velocities = np.zeros((len(poses), 3))
        if len(poses) > 1:
            velocities = np.gradient(poses[:, :3, 3], stamps_s, axis=0)
        states = States(poses, velocities, np.array([0.0, 0.0, -GRAVITY_M_S2]), landmarks)
        window = Window(tracks, self._sigma_px, samples)
        if samples is None and self._rig.imu is not None:
            raise NotImplementedError
        solution = solve(window, states, self._nominal, difference, prior)
        if len(keyframes) < 3:
            return _Adjusted(prior, solution, self._sigma_px)
        error = np.sqrt(np.nanmedian(solution.errors2)) / _RAYLEIGH_MEDIAN
        return _Adjusted(prior, solution, max(_NOISE_FACTOR * float(error) * self._sigma_px, _MIN_SIGMA_PX))


def _displacement_px(then: View, now: View) -> float:
    """Return the median displacement of the tracks common to two views; infinite where there are none."""
    _, at_then, at_now = np.intersect1d(then.ids, now.ids, assume_unique=True, return_indices=True)
    if not len(at_then):
        return float("inf")
    return float(np.median(np.linalg.norm(now.left_px[at_now] - then.left_px[at_then], axis=1)))
