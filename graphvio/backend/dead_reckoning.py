"""Comparison of contradicting motion hypotheses with the IMU alone, since before the contradiction.

From one frameset to the next, hypotheses often differ by less than the IMU's prediction is uncertain. Over some tenths
of a second their difference grows faster than the error of that prediction. The state estimate cannot decide between
them over that time, since it follows the motion that covers all hypotheses.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.smoother import Smoother
from graphvio.backend.window import SOLVER_ERRORS
from graphvio.geometry import se3_adjoint, se3_inverse
from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import RelativeMotion, VisualResult

_MIN_AGREEMENT_NS = 500_000_000  # a contradiction ends once all pairs have agreed for so long
_MAX_DURATION_NS = 1_500_000_000  # of a prediction by the IMU alone
_CERTAIN: Float = np.zeros((6, 6))

Pairs = tuple[int, ...]
"""Indices of the pairs and single cameras of a motion hypothesis."""


class _ChainedPose(NamedTuple):
    """A pose relative to the first one of a chain of motions.

    Attributes:
        first_T_last: (4, 4).
        covariance: (6, 6), tangent ``[rotation, translation]`` in the body frame of the last pose.
    """

    first_T_last: Float
    covariance: Float

    def then(self, motion: RelativeMotion) -> _ChainedPose:
        """Return the pose after one more motion."""
        adjoint = se3_adjoint(se3_inverse(motion.reference_T_current))
        return _ChainedPose(
            self.first_T_last @ motion.reference_T_current, adjoint @ self.covariance @ adjoint.T + motion.covariance
        )

    def before(self, motion: RelativeMotion) -> _ChainedPose:
        """Return the pose at the reference of a motion that ends in this pose."""
        adjoint = se3_adjoint(motion.reference_T_current)
        return _ChainedPose(
            self.first_T_last @ se3_inverse(motion.reference_T_current),
            adjoint @ (self.covariance + motion.covariance) @ adjoint.T,
        )


_Chain = dict[int, _ChainedPose]
"""Stamp -> pose, of all framesets that later motions may be measured from."""


@dataclass(eq=False)
class _Comparison:
    """The prediction by the IMU alone since a stamp, and the motions of each hypothesis since then."""

    since_ns: int
    imu: Smoother
    agreed: _Chain  # by motions that all pairs agree on
    chains: dict[Pairs, _Chain]

    def add_agreed(self, motion: RelativeMotion) -> None:
        """Add a motion that all pairs agree on."""
        for chain in (self.agreed, *self.chains.values()):
            _extend(chain, motion)

    def add_and_test(self, motion: RelativeMotion) -> GateResult | None:
        """Add the motion of a hypothesis, and test all its motions since the beginning; None if they are no chain."""
        chained = _extend(self.chains.setdefault(motion.pairs, dict(self.agreed)), motion)
        if chained is None:
            return None
        # Without the covariance of the calibration: if errors of the calibration mattered, none would agree.
        since_beginning = RelativeMotion(
            self.since_ns, motion.stamp_ns, chained.first_T_last, chained.covariance, _CERTAIN, motion.inliers
        )
        return self.imu.gate(since_beginning)


class DeadReckoning:
    """Finds the pairs to follow while pairs contradict each other: those whose motions agree with the IMU alone."""

    def __init__(self) -> None:
        self._newest: tuple[int, ImuInterval | None] = (0, None)
        self._motions: dict[Pairs, RelativeMotion] = {}  # of the newest frameset; of () where all pairs agree
        self._contradicting_ns = 0  # stamp of the newest frameset with a contradiction
        self._comparison: _Comparison | None = None
        self._followed: Pairs = ()

    def restart(self) -> None:
        """End the comparison: the state that it began with was wrong."""
        self._comparison = None

    def predict(self, stamp_ns: int, interval: ImuInterval | None) -> None:
        """Extend the prediction by the IMU to a frameset; it ends after 1.5 s, and without an interval."""
        self._newest = stamp_ns, interval
        comparison, self._comparison = self._comparison, None
        if interval is not None and comparison is not None and stamp_ns - comparison.since_ns <= _MAX_DURATION_NS:
            with suppress(*SOLVER_ERRORS):
                comparison.imu.extend(stamp_ns, interval)
                self._comparison = comparison

    def pairs_to_follow(self, visual: VisualResult, smoother: Smoother) -> Pairs:
        """Return the pairs whose motions are to be followed, or none where that is not decided.

        While the calibration is not trusted, nothing new is decided: the motions of all pairs may be wrong.

        Args:
            visual: Result of the visual front-end for the predicted frameset, with a motion.
            smoother: Smoother of the state estimator, extended to the frameset.
        """
        assert visual.motion is not None
        motion, before = visual.motion.with_any_velocity(), self._motions
        if motion.stamp_ns - self._contradicting_ns > _MIN_AGREEMENT_NS:
            self._comparison, self._followed = None, ()
        if not visual.alternatives:
            self._motions = {(): motion}
            if self._comparison is not None:
                self._comparison.add_agreed(motion)
            return ()
        motions = [each.with_any_velocity() for each in visual.alternatives]
        self._contradicting_ns, self._motions = motion.stamp_ns, {each.pairs: each for each in motions}
        comparison, self._comparison = self._comparison, None
        if visual.is_calibration_trusted:
            with suppress(*SOLVER_ERRORS):  # nothing is decided then; the state is not at fault
                if comparison is None:
                    comparison = self._begin(smoother, before)
                if comparison is not None:
                    self._followed = self._chosen(motions, comparison)
                self._comparison = comparison
        return self._followed

    def _begin(self, smoother: Smoother, before: Mapping[Pairs, RelativeMotion]) -> _Comparison | None:
        """Begin a comparison at the state before the newest one; None if there is none, or without the IMU.

        Args:
            smoother: Smoother of the state estimator, extended to the newest frameset.
            before: Motions until the state before: of each hypothesis, or of () where all pairs agreed.
        """
        stamp_ns, interval = self._newest
        since_ns = smoother.previous_ns
        if interval is None or since_ns is None or stamp_ns != smoother.latest_ns:
            return None
        imu = smoother.from_state(since_ns)
        imu.extend(stamp_ns, interval)
        first = _ChainedPose(np.eye(4), _CERTAIN)
        chains: dict[Pairs, _Chain] = {(): {since_ns: first}}
        for pairs, motion in before.items():
            if motion.stamp_ns == since_ns:
                chains[pairs] = {since_ns: first, motion.reference_stamp_ns: first.before(motion)}
        return _Comparison(since_ns, imu, chains.pop(()), chains)

    def _chosen(self, motions: list[RelativeMotion], comparison: _Comparison) -> Pairs:
        """Return the pairs of the only hypothesis that the IMU agrees with, or else those followed until now.

        Pairs that the IMU contradicts are no longer followed.
        """
        tested = [
            (result, motion.pairs) for motion in motions if (result := comparison.add_and_test(motion)) is not None
        ]
        if len(tested) == len(motions) > 1:
            (likely, pairs), (unlikely, _), *_ = sorted(tested, key=lambda each: each[0].statistic)
            if likely.accepted and likely.is_clear and not unlikely.accepted:
                return pairs
        is_refuted = any(pairs == self._followed and not result.accepted for result, pairs in tested)
        return () if is_refuted else self._followed


def _extend(chain: _Chain, motion: RelativeMotion) -> _ChainedPose | None:
    """Add a motion to a chain, and return the pose after it; None if the chain lacks the motion's reference."""
    reference = chain.get(motion.reference_stamp_ns)
    if reference is None:
        return None
    chain[motion.stamp_ns] = chained = reference.then(motion)
    return chained
