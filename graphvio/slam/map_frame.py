"""Where the odometry's frame lies in a map, by what a SLAM system says of single keyframes (REP 105).

The unknown is ``map_T_odom``. What odometry drifts from one keyframe to the next makes it walk; a correction measures
it at its keyframe. All covariances are taken to the tangent in odom, where they add up, so that corrections may come in
any order: a Kalman filter takes them in by the order of their keyframes, anew when one came late. Corrections are taken
for independent of each other.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from graphvio.arrays import Float
from graphvio.errors import MeasurementError
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log
from graphvio.slam.keyframe import CorrectionResult, Keyframe

_MOST_KEYFRAMES = 10_000  # that can be corrected; an hour or so
_MOST_CORRECTIONS = 200  # that are taken in anew when one comes late
_FIRST_AGREEMENT = 3  # refused corrections in a row that must agree to be believed; each time it takes twice as many
_RIGID = 1e-6


@dataclass(frozen=True, eq=False)
class _Passed:
    """A keyframe: its pose, and the odometry's drift (6, 6) until there, tangent in odom."""

    odom_T_body: Float
    drift: Float


@dataclass(frozen=True, eq=False)
class _Correction:
    """``map_T_odom`` as a correction of a keyframe, or several up to there, have it.

    Attributes:
        epoch: of the keyframe.
        keyframe_id: of it.
        map_T_odom: (4, 4).
        covariance: (6, 6), tangent in odom.
        drift: the odometry's until there, (6, 6); kept here because the keyframe may be forgotten sooner.
        is_many: whether it stands for several.
    """

    epoch: int
    keyframe_id: int
    map_T_odom: Float
    covariance: Float
    drift: Float
    is_many: bool = False


class MapFrame:
    """``map_T_odom`` of the newest epoch; from any thread.

    Args:
        probability: corrections outside this share of the chi-square distribution are refused.
    """

    def __init__(self, probability: float) -> None:
        self._threshold = float(chi2.ppf(probability, 6))
        self._lock = threading.Lock()
        self._epoch: int | None = None
        self._passed: dict[int, _Passed] = {}
        self._accepted: list[_Correction] = []  # in the order of keyframes
        self._refused: list[_Correction] = []  # since the last one that was accepted, the newest of each keyframe
        self._agreement = _FIRST_AGREEMENT
        self._estimator: _Correction | None = (
            None  # what all that were accepted say together, at the last one's keyframe
        )

    @property
    def map_T_odom(self) -> Float | None:
        """(4, 4), or None before the epoch's first correction."""
        estimator = self._estimator
        return None if estimator is None else estimator.map_T_odom.copy()

    def of_epoch(self, epoch: int) -> Float | None:
        """The same (4, 4) for an epoch's odom frame; None if it is known of none or of another one."""
        estimator = self._estimator  # read once: with its epoch, since the next one may begin at any time
        return None if estimator is None or estimator.epoch != epoch else estimator.map_T_odom.copy()

    def begin(self, epoch: int) -> None:
        """An epoch runs; a new one ends what was known of the old one."""
        if epoch != self._epoch:
            with self._lock:
                self._epoch = epoch
                self._passed, self._accepted, self._refused = {}, [], []
                self._agreement, self._estimator = _FIRST_AGREEMENT, None

    def add(self, keyframe: Keyframe) -> None:
        """The next keyframe."""
        self.begin(keyframe.epoch)
        with self._lock:
            drift = np.zeros((6, 6))
            if self._passed:
                last = self._passed[next(reversed(self._passed))]
                drift = last.drift + _drifted(last.odom_T_body, keyframe)
            self._passed[keyframe.id] = _Passed(keyframe.odom_T_body, drift)
            if len(self._passed) > _MOST_KEYFRAMES:
                del self._passed[next(iter(self._passed))]

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """Take in where a keyframe is in the map, or refuse it.

        What is far from expected is refused, until so many in a row agree with each other that they are believed; the
        next time it takes twice as many, so that two that contradict each other do not take turns.

        Args:
            keyframe_id: of the newest epoch; a second correction of a keyframe takes the place of the first.
            map_T_body: (4, 4).
            covariance: (6, 6), tangent ``[rotation, translation]`` in body.

        Raises:
            MeasurementError: if the pose is not rigid, or the covariance is none.
        """
        map_T_body, covariance = _checked(map_T_body, covariance)
        with self._lock:
            if keyframe_id not in self._passed:
                return self._refusal(f"keyframe {keyframe_id} is not of the newest epoch, or too old, or never was")
            assert self._epoch is not None
            passed = self._passed[keyframe_id]
            to_odom = se3_adjoint(passed.odom_T_body)
            offered = _Correction(
                self._epoch,
                keyframe_id,
                map_T_body @ se3_inverse(passed.odom_T_body),
                to_odom @ covariance @ to_odom.T,
                passed.drift,
            )
            if self._estimator is None:
                return self._accept(offered, None)
            statistic = _distance(self._expected_at(offered), offered)
            if statistic <= self._threshold:
                return self._accept(offered, statistic)
            # Said again of one keyframe, it is no second witness.
            self._refused = [*(each for each in self._refused if each.keyframe_id != keyframe_id), offered]
            newest = self._refused[-self._agreement :]
            if len(newest) == self._agreement and self._agree(newest):
                self._agreement *= 2
                self._accepted, self._estimator = newest[:-1], None
                return self._accept(
                    offered, statistic, f"{len(newest)} refused corrections in a row agree: the map moves"
                )
            del self._refused[: -4 * self._agreement]
            return self._refusal(
                f"keyframe {keyframe_id}: squared distance {statistic:.1f} beyond chi-square {self._threshold:.1f}",
                statistic,
            )

    def _accept(self, offered: _Correction, statistic: float | None, reason: str = "") -> CorrectionResult:
        others = [each for each in self._accepted if each.is_many or each.keyframe_id != offered.keyframe_id]
        estimator, count = self._estimator, len(self._accepted)
        self._accepted = sorted([*others, offered], key=lambda each: each.keyframe_id)
        self._refused = []
        if estimator is None or estimator.keyframe_id > offered.keyframe_id or len(self._accepted) != count + 1:
            self._estimator = _fused(self._accepted)
        else:
            self._estimator = _fused([estimator, offered])
        if len(self._accepted) > _MOST_CORRECTIONS:  # the older half becomes one
            half = self._accepted[: _MOST_CORRECTIONS // 2]
            self._accepted = [replace(_fused(half), is_many=True), *self._accepted[len(half) :]]
        return CorrectionResult(True, reason, statistic, self._threshold, self.map_T_odom)

    def _refusal(self, reason: str, statistic: float | None = None) -> CorrectionResult:
        return CorrectionResult(False, reason, statistic, self._threshold, self.map_T_odom)

    def _expected_at(self, offered: _Correction) -> _Correction:
        """What all that were accepted say at the keyframe of one more: those before it and those after it."""
        assert self._estimator is not None
        if self._estimator.keyframe_id <= offered.keyframe_id:
            return _carried(self._estimator, offered)
        before = [each for each in self._accepted if each.keyframe_id <= offered.keyframe_id]
        after = [each for each in self._accepted if each.keyframe_id > offered.keyframe_id]
        return _fused([_carried(_fused(side), offered) for side in (before, after[::-1]) if side])

    def _agree(self, corrections: Sequence[_Correction]) -> bool:
        last = corrections[-1]
        return all(_distance(each, last) <= self._threshold for each in corrections[:-1])


def _fused(corrections: Sequence[_Correction]) -> _Correction:
    """What corrections say together at the last one's keyframe; their keyframes go forward, or all back."""
    estimator = corrections[0]
    for offered in corrections[1:]:
        prior = estimator.covariance + _drift(estimator, offered)
        gain = np.linalg.solve(prior + offered.covariance, prior).T
        step = gain @ _difference(estimator, offered)
        rest = np.eye(6) - gain
        estimator = replace(
            offered,
            map_T_odom=estimator.map_T_odom @ se3_exp(step),
            covariance=rest @ prior @ rest.T + gain @ offered.covariance @ gain.T,
        )
    return estimator


def _carried(estimator: _Correction, to: _Correction) -> _Correction:
    """A estimator at another's keyframe."""
    return replace(to, map_T_odom=estimator.map_T_odom, covariance=estimator.covariance + _drift(estimator, to))


def _distance(one: _Correction, other: _Correction) -> float:
    """Squared Mahalanobis distance."""
    difference = _difference(one, other)
    covariance = one.covariance + other.covariance + _drift(one, other)
    return float(difference @ np.linalg.solve(covariance, difference))


def _drift(one: _Correction, other: _Correction) -> Float:
    """What odometry may have drifted between two keyframes, (6, 6), tangent in odom."""
    first, last = sorted((one, other), key=lambda each: each.keyframe_id)
    return np.asarray(last.drift - first.drift)


def _drifted(odom_T_previous: Float, keyframe: Keyframe) -> Float:
    """What odometry may have drifted from the keyframe before to this one, (6, 6), tangent in odom.

    Poses in odom are causal. By what the keyframe before has been corrected since then, odom moved: no part of the
    relative covariance, and often more than it.
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
        raise MeasurementError("map_T_body or covariance is no array of numbers; give (4, 4) and (6, 6)") from None
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise MeasurementError(f"map_T_body has shape {pose.shape}, or holds NaN; give a rigid transform (4, 4)")
    rotation = pose[:3, :3]
    off = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), np.abs(pose[3] - [0, 0, 0, 1]).max())
    if off > _RIGID or np.linalg.det(rotation) < 0.0:
        raise MeasurementError(
            f"map_T_body is no rigid transform: off by {off:.2g}; give rotation and translation (4, 4)"
        )
    if spread.shape != (6, 6) or not np.isfinite(spread).all():
        raise MeasurementError(
            f"covariance has shape {spread.shape}, or holds NaN; give (6, 6) [rotation, translation]"
        )
    if not np.allclose(spread, spread.T, rtol=1e-6, atol=1e-12) or np.linalg.eigvalsh(spread)[0] <= 0.0:
        raise MeasurementError(
            "covariance is not symmetric and positive definite; say how well each direction is known"
        )
    return pose, 0.5 * (spread + spread.T)
