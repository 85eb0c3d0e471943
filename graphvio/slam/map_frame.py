"""Estimation of the odometry's frame in a map (REP-105) from corrections of single keyframes.

The state is ``map_T_odom``, a random walk whose process noise is the odometry's drift between keyframes; a correction
measures the state at its keyframe. All covariances are expressed in the tangent in odom, where they add up. A Kalman
filter fuses corrections in the order of their keyframes, and is run again over all of them when one comes late.
Corrections are assumed to be independent of each other.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.gating import chi_square_quantile
from graphvio.errors import MeasurementError
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log
from graphvio.slam.checks import check_covariance, check_pose
from graphvio.slam.keyframe import CorrectionResult, Keyframe

_MAX_KEYFRAMES = 10_000  # keyframes that can be corrected; those of about an hour
_MAX_CORRECTIONS = 200  # corrections that are fused again when one comes late
_FIRST_AGREEMENT = 3  # refused corrections in a row that must agree to be accepted; doubled each time


@dataclass(frozen=True, eq=False)
class _Passed:
    """A past keyframe: its pose (4, 4), and the covariance (6, 6) of the drift up to it, tangent in odom."""

    odom_T_body: Float
    drift: Float


@dataclass(frozen=True, eq=False)
class _Correction:
    """An estimate of ``map_T_odom`` at a keyframe from one correction, or from several fused ones."""

    epoch: int  # epoch of the keyframe
    keyframe_id: int  # id of the keyframe
    map_T_odom: Float  # (4, 4)
    covariance: Float  # (6, 6), tangent in odom
    drift: Float  # covariance (6, 6) of the drift up to the keyframe, which may be dropped sooner than the correction
    is_many: bool = False  # whether it represents several corrections


class MapFrame:
    """Estimator of ``map_T_odom`` in the newest epoch; thread-safe.

    Corrections beyond the quantile of the chi-square distribution at ``probability`` are refused.
    """

    def __init__(self, probability: float) -> None:
        self._threshold = chi_square_quantile(probability, 6)
        self._lock = threading.Lock()
        self._epoch: int | None = None
        self._passed: dict[int, _Passed] = {}
        self._accepted: list[_Correction] = []  # in the order of keyframes
        self._refused: list[_Correction] = []  # since the last accepted one, the newest of each keyframe
        self._agreement = _FIRST_AGREEMENT
        self._estimate: _Correction | None = None  # all accepted corrections fused, at the last one's keyframe

    @property
    def map_T_odom(self) -> Float | None:
        """Estimate (4, 4), or None before the epoch's first correction."""
        estimate = self._estimate
        return None if estimate is None else estimate.map_T_odom.copy()

    def of_epoch(self, epoch: int) -> Float | None:
        """Return ``map_T_odom`` (4, 4) if it is known for this epoch, else None."""
        estimate = self._estimate  # read once: with its epoch, since the next one may begin at any time
        return None if estimate is None or estimate.epoch != epoch else estimate.map_T_odom.copy()

    def begin(self, epoch: int) -> None:
        """Set the epoch; a new one discards the corrections of the old one."""
        if epoch != self._epoch:
            with self._lock:
                self._epoch = epoch
                self._passed, self._accepted, self._refused = {}, [], []
                self._agreement, self._estimate = _FIRST_AGREEMENT, None

    def add(self, keyframe: Keyframe) -> None:
        """Add the next keyframe."""
        self.begin(keyframe.epoch)
        with self._lock:
            drift = np.zeros((6, 6))
            if self._passed:
                last = self._passed[next(reversed(self._passed))]
                drift = last.drift + _drifted(last.odom_T_body, keyframe)
            self._passed[keyframe.id] = _Passed(keyframe.odom_T_body, drift)
            if len(self._passed) > _MAX_KEYFRAMES:
                del self._passed[next(iter(self._passed))]

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """Fuse a correction of a keyframe's pose in the map, or refuse it.

        A correction that fails the innovation test is refused, until several refused ones in a row agree with each
        other. Each time this happens, twice as many are required for the next time, so that two contradicting sources
        do not alternate. A second correction of a keyframe replaces the first.

        Raises:
            MeasurementError: If the pose is not rigid, or the covariance is not positive definite.
        """
        map_T_body, covariance = _checked(map_T_body, covariance)
        with self._lock:
            if keyframe_id not in self._passed:
                return self._refusal(f"keyframe {keyframe_id} is not of the newest epoch, too old, or unknown")
            assert self._epoch is not None
            passed = self._passed[keyframe_id]
            to_odom = se3_adjoint(passed.odom_T_body)
            candidate = _Correction(
                self._epoch,
                keyframe_id,
                map_T_body @ se3_inverse(passed.odom_T_body),
                to_odom @ covariance @ to_odom.T,
                passed.drift,
            )
            if self._estimate is None:
                return self._accept(candidate, None)
            statistic = _distance(self._expected_at(candidate), candidate)
            if statistic <= self._threshold:
                return self._accept(candidate, statistic)
            # A repeated correction of a keyframe is no independent one.
            self._refused = [*(each for each in self._refused if each.keyframe_id != keyframe_id), candidate]
            newest = self._refused[-self._agreement :]
            is_enough = len(newest) == self._agreement
            if is_enough and all(_distance(each, candidate) <= self._threshold for each in newest[:-1]):
                self._agreement *= 2
                self._accepted, self._estimate = newest[:-1], None
                return self._accept(
                    candidate, statistic, f"{len(newest)} refused corrections in a row agree: the map moves"
                )
            del self._refused[: -4 * self._agreement]
            return self._refusal(
                f"keyframe {keyframe_id}: squared distance {statistic:.1f} beyond chi-square {self._threshold:.1f}",
                statistic,
            )

    def _accept(self, candidate: _Correction, statistic: float | None, reason: str = "") -> CorrectionResult:
        others = [each for each in self._accepted if each.is_many or each.keyframe_id != candidate.keyframe_id]
        estimate, count = self._estimate, len(self._accepted)
        self._accepted = sorted([*others, candidate], key=lambda each: each.keyframe_id)
        self._refused = []
        if estimate is None or estimate.keyframe_id > candidate.keyframe_id or len(self._accepted) != count + 1:
            self._estimate = _fused(self._accepted)
        else:
            self._estimate = _fused([estimate, candidate])
        if len(self._accepted) > _MAX_CORRECTIONS:  # the older half is fused into one
            half = self._accepted[: _MAX_CORRECTIONS // 2]
            self._accepted = [replace(_fused(half), is_many=True), *self._accepted[len(half) :]]
        return CorrectionResult(True, reason, statistic, self._threshold, self.map_T_odom)

    def _refusal(self, reason: str, statistic: float | None = None) -> CorrectionResult:
        return CorrectionResult(False, reason, statistic, self._threshold, self.map_T_odom)

    def _expected_at(self, candidate: _Correction) -> _Correction:
        """Return the accepted corrections, fused and carried to the keyframe of a candidate."""
        assert self._estimate is not None
        if self._estimate.keyframe_id <= candidate.keyframe_id:
            return _carried(self._estimate, candidate)
        before = [each for each in self._accepted if each.keyframe_id <= candidate.keyframe_id]
        after = [each for each in self._accepted if each.keyframe_id > candidate.keyframe_id]
        return _fused([_carried(_fused(part), candidate) for part in (before, after[::-1]) if part])


def _fused(corrections: Sequence[_Correction]) -> _Correction:
    """Fuse corrections at the last one's keyframe; their keyframes are in ascending or descending order."""
    estimate = corrections[0]
    for candidate in corrections[1:]:
        prior = estimate.covariance + _drift(estimate, candidate)
        gain = np.linalg.solve(prior + candidate.covariance, prior).T
        step = gain @ _difference(estimate, candidate)
        remaining = np.eye(6) - gain
        estimate = replace(
            candidate,
            map_T_odom=estimate.map_T_odom @ se3_exp(step),
            covariance=remaining @ prior @ remaining.T + gain @ candidate.covariance @ gain.T,
        )
    return estimate


def _carried(estimate: _Correction, to: _Correction) -> _Correction:
    """Return an estimate carried to another keyframe, with the drift in between added to its covariance."""
    return replace(to, map_T_odom=estimate.map_T_odom, covariance=estimate.covariance + _drift(estimate, to))


def _distance(one: _Correction, other: _Correction) -> float:
    """Return the squared Mahalanobis distance between two independent estimates, 6 degrees of freedom."""
    difference = _difference(one, other)
    covariance = one.covariance + other.covariance + _drift(one, other)
    return float(difference @ np.linalg.solve(covariance, difference))


def _drift(one: _Correction, other: _Correction) -> Float:
    """Return the covariance (6, 6) of the drift between two keyframes, tangent in odom."""
    first, last = sorted((one, other), key=lambda each: each.keyframe_id)
    return np.asarray(last.drift - first.drift)


def _drifted(odom_T_previous: Float, keyframe: Keyframe) -> Float:
    """Return the covariance (6, 6) of the drift since the previous keyframe, tangent in odom.

    Poses in odom are causal: when the smoother later corrects the previous keyframe, odom moves. The relative
    covariance does not include this motion, which is often larger.
    """
    if keyframe.previous_T_body is None or keyframe.relative_covariance is None:
        return np.zeros((6, 6))
    moved = se3_inverse(keyframe.previous_T_body) @ se3_inverse(odom_T_previous) @ keyframe.odom_T_body
    shift, to_odom = se3_log(moved), se3_adjoint(keyframe.odom_T_body)
    return np.asarray(to_odom @ (keyframe.relative_covariance + np.outer(shift, shift)) @ to_odom.T)


def _difference(one: _Correction, other: _Correction) -> Float:
    return se3_log(se3_inverse(one.map_T_odom) @ other.map_T_odom)


def _checked(map_T_body: Float, covariance: Float) -> tuple[Float, Float]:
    try:
        pose, spread = (np.array(each, dtype=np.float64) for each in (map_T_body, covariance))
    except (TypeError, ValueError):
        raise MeasurementError("map_T_body or covariance is not an array of numbers; give (4, 4) and (6, 6)") from None
    check_pose(pose, "map_T_body")
    check_covariance(spread, "covariance")
    return pose, 0.5 * (spread + spread.T)
