"""Self-calibration while the odometry runs: keyframes in, corrected rigs out.

Keyframes are collected in windows. Each window is adjusted several times while it grows, in a thread of its own, and
once it is full its posterior of the calibration is the next window's prior: a recursive estimator, whose windows share
no observation. A result comes into force a fixed number of framesets after its adjustment began, so that a run does not
depend on timing.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.rig import Rig
from graphvio.self_calibration.evidence import Evidence, Gaussian
from graphvio.self_calibration.parameters import RigCalibration
from graphvio.self_calibration.prior import CalibrationSigmas
from graphvio.self_calibration.solver import Solution, solve
from graphvio.self_calibration.window import Keyframe, View, choose_tracks

_WINDOW = 16  # keyframes
_ADJUSTED_AT = ((1, 3, 6, 10, _WINDOW), (_WINDOW // 2, _WINDOW))  # keyframes, of the first window and later ones
_MAX_TRACKS = 150  # of each pair
_INTERVALS_S = (0.1, 0.25)  # between keyframes, in the first window and later
_MIN_DISPLACEMENT_PX = 8.0  # median of a pair's tracks since the keyframe before
_DELAY_FRAMESETS = 2  # until a result comes into force
_FIRST_SIGMA_PX = 0.15
_MIN_SIGMA_PX = 0.06
_NOISE_FACTOR = 2.0  # on the noise that residuals show: observations of one track are correlated
_RAYLEIGH_MEDIAN = 1.1774  # of the norm of two standard normal variables
_WALK = 0.01  # in one second, as a share of the prior's standard deviations
_MAX_WALK_S = 10.0  # between two windows


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
        file_scale: by which factor the file's errors exceed the stated standard deviations, 0 for an exact file.
        log_bayes_factor: twice the logarithm of the odds of that factor against an exact file; above 10 it is very strong
            evidence (R. E. Kass, A. E. Raftery, *Bayes factors*, 1995).
    """

    def __init__(self, rig: Rig, sigmas: CalibrationSigmas) -> None:
        self._rig = rig
        self._nominal = RigCalibration.of(rig)
        self._file_covariance = sigmas.covariance(rig)
        self._evidence = Evidence.none(len(self._file_covariance))  # of the windows that are full
        self.posterior = self._evidence.given(self._file_covariance, 1.0)
        self.file_scale, self.log_bayes_factor = 0.0, 0.0
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
        was_exact = self.file_scale == 0.0
        self.file_scale, self.log_bayes_factor = evidence.file_scale(self._file_covariance)
        self.posterior = evidence.given(self._file_covariance, self.file_scale or 1.0)
        if self.file_scale == 0.0:
            return None if was_exact else self._rig
        return self._nominal.moved(self.posterior.mean).applied_to(self._rig)

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
        self._pending = self._worker.submit(self._adjust, list(window))
        self._due_in = _DELAY_FRAMESETS

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

    def _adjust(self, window: list[Keyframe]) -> _Adjusted:
        """Adjust a window; what is read of this object does not change while an adjustment is pending."""
        poses = np.array([keyframe.odom_T_body for keyframe in window])
        elapsed_s = min((window[-1].stamp_ns - window[0].stamp_ns) * 1e-9, _MAX_WALK_S)
        self._evidence = self._evidence.forgotten((elapsed_s + 1e-3) * _WALK**2 * self._file_covariance)
        prior = self._evidence.given(self._file_covariance, self.file_scale or 1.0)
        difference = self.posterior.mean
        tracks, landmarks = choose_tracks(window, poses, self._nominal.moved(difference), _MAX_TRACKS)
        solution = solve(poses, landmarks, tracks, self._nominal, difference, prior, self._sigma_px)
        if len(window) < 3:
            return _Adjusted(prior, solution, self._sigma_px)
        error = np.sqrt(np.nanmedian(solution.errors2)) / _RAYLEIGH_MEDIAN
        return _Adjusted(prior, solution, max(_NOISE_FACTOR * float(error) * self._sigma_px, _MIN_SIGMA_PX))


def _displacement_px(then: View, now: View) -> float:
    """Return the median displacement of the tracks common to two views; infinite where there are none."""
    _, at_then, at_now = np.intersect1d(then.ids, now.ids, assume_unique=True, return_indices=True)
    if not len(at_then):
        return float("inf")
    return float(np.median(np.linalg.norm(now.left_px[at_now] - then.left_px[at_then], axis=1)))
