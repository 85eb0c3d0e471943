"""Comparison of contradicting motion hypotheses with the IMU alone, since before the contradiction.

From one frameset to the next, hypotheses often differ by less than the IMU's prediction is uncertain. Over some tenths
of a second their difference grows faster than the error of that prediction. The state estimate cannot decide between
them over that time, since it follows the motion that covers all hypotheses.
"""

from __future__ import annotations

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


class _Chained(NamedTuple):
    """A pose relative to the first one of a chain of motions.

    Attributes:
        first_T_last: (4, 4).
        covariance: (6, 6), tangent ``[rotation, translation]`` in the body frame of the last pose.
    """

    first_T_last: Float
    covariance: Float

    def then(self, motion: RelativeMotion) -> _Chained:
        """Return the pose after one more motion."""
        adjoint = se3_adjoint(se3_inverse(motion.reference_T_current))
        return _Chained(
            self.first_T_last @ motion.reference_T_current, adjoint @ self.covariance @ adjoint.T + motion.covariance
        )

    def before(self, motion: RelativeMotion) -> _Chained:
        """Return the pose at the reference of a motion that ends in this pose."""
        adjoint = se3_adjoint(motion.reference_T_current)
        return _Chained(
            self.first_T_last @ se3_inverse(motion.reference_T_current),
            adjoint @ (self.covariance + motion.covariance) @ adjoint.T,
        )


_Chain = dict[int, _Chained]
"""Stamp -> pose, of all framesets that later motions may be measured from."""


@dataclass(eq=False)
class _Comparison:
    """The prediction by the IMU alone since a stamp, and the motions of each hypothesis since then."""

    since_ns: int
    imu: Smoother
    agreed: _Chain  # as far as all pairs agree
    chains: dict[Pairs, _Chain]

    def add_agreed(self, motion: RelativeMotion) -> None:
        """Add a motion that all pairs agree on."""
        for chain in (self.agreed, *self.chains.values()):
            _extend(chain, motion)

    def gate(self, motion: RelativeMotion) -> GateResult | None:
        """Add the motion of a hypothesis, and test all its motions since the beginning; None if they are no chain."""
        chained = _extend(self.chains.setdefault(motion.pairs, dict(self.agreed)), motion)
        if chained is None:
            return None
        # Without the covariance of the calibration: if errors of the calibration mattered, none would agree.
        whole = RelativeMotion(
            self.since_ns, motion.stamp_ns, chained.first_T_last, chained.covariance, _CERTAIN, motion.inliers
        )
        return self.imu.gate(whole)


class DeadReckoning:
    """Finds the pairs to follow while pairs contradict each other: those whose motions agree with the IMU alone."""

    def __init__(self) -> None:
        self._newest: tuple[int, ImuInterval | None] = (0, None)
        self._agreed: RelativeMotion | None = None  # the newest motion that all pairs agree on
        self._contradicting_ns = 0  # stamp of the newest frameset with a contradiction
        self._comparison: _Comparison | None = None
        self._followed: Pairs = ()

    def predict(self, stamp_ns: int, interval: ImuInterval | None) -> None:
        """Extend the prediction by the IMU to a frameset; without an interval, it ends."""
        self._newest = stamp_ns, interval
        comparison, self._comparison = self._comparison, None
        if interval is not None and comparison is not None:
            with suppress(*SOLVER_ERRORS):
                comparison.imu.extend(stamp_ns, interval)
                self._comparison = comparison

    def pairs_to_follow(self, visual: VisualResult, smoother: Smoother) -> Pairs:
        """Return the pairs whose motions are to be followed, or none where that is not decided.

        While the calibration is not trusted, nothing is decided: the motions of all pairs may be wrong.

        Args:
            visual: Result of the visual front-end for the predicted frameset, with a motion.
            smoother: Smoother of the state estimator, extended to the frameset.
        """
        assert visual.motion is not None
        motion = visual.motion.with_any_velocity()
        if not visual.alternatives:
            self._agreed = motion
            if motion.stamp_ns - self._contradicting_ns > _MIN_AGREEMENT_NS:
                self._comparison, self._followed = None, ()
            elif self._comparison is not None:
                self._comparison.add_agreed(motion)
            return ()
        self._contradicting_ns = motion.stamp_ns
        comparison, self._comparison = self._comparison, None
        motions = [each.with_any_velocity() for each in visual.alternatives]
        if visual.is_calibration_trusted:
            with suppress(*SOLVER_ERRORS):  # nothing is decided then; the state is not at fault
                if comparison is None or motion.stamp_ns - comparison.since_ns > _MAX_DURATION_NS:
                    comparison = self._begin(smoother)
                if comparison is not None:
                    self._followed = self._chosen(motions, comparison)
                self._comparison = comparison
        return self._followed

    def _begin(self, smoother: Smoother) -> _Comparison | None:
        """Begin a comparison at the state before the newest one; None if there is none, or without the IMU."""
        stamp_ns, interval = self._newest
        since_ns = smoother.previous_ns
        if interval is None or since_ns is None or stamp_ns != smoother.latest_ns:
            return None
        imu = smoother.from_state(since_ns)
        imu.extend(stamp_ns, interval)
        first = _Chained(np.eye(4), _CERTAIN)
        chain = {since_ns: first}
        if self._agreed is not None and self._agreed.stamp_ns == since_ns:
            chain[self._agreed.reference_stamp_ns] = first.before(self._agreed)
        return _Comparison(since_ns, imu, chain, {})

    def _chosen(self, motions: list[RelativeMotion], comparison: _Comparison) -> Pairs:
        """Return the pairs of the only hypothesis that the IMU agrees with, or else those followed until now.

        Pairs that the IMU contradicts are no longer followed.
        """
        tested = [(result, motion.pairs) for motion in motions if (result := comparison.gate(motion)) is not None]
        if len(tested) == len(motions):
            (likely, pairs), (unlikely, _), *_ = sorted(tested, key=lambda each: each[0].statistic)
            if likely.accepted and likely.is_clear and not unlikely.accepted:
                return pairs
        is_refuted = any(pairs == self._followed and not result.accepted for result, pairs in tested)
        return () if is_refuted else self._followed


def _extend(chain: _Chain, motion: RelativeMotion) -> _Chained | None:
    """Add a motion to a chain, and return the pose after it; None if the chain lacks the motion's reference."""
    reference = chain.get(motion.reference_stamp_ns)
    if reference is None:
        return None
    chain[motion.stamp_ns] = chained = reference.then(motion)
    return chained
