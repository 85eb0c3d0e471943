"""The choice of the rig's motion where the camera pairs measure motions that contradict each other."""

from collections.abc import Callable

from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.motion import RelativeMotion, VisualResult

_MIN_LIKELIER = 6.0  # difference of chi-square statistics that decides without an IMU: odds of 20 to 1


class Contradiction:
    """Chooses between motion hypotheses by comparing them with the state estimator's prediction.

    With an IMU, the innovation test rejects a motion that is not the rig's; where it accepts all of them, their motions
    over a longer time decide. Without an IMU, the prediction is constant velocity, and the test rejects hardly any
    motion; but an object that comes into one view and moves changes that view's velocity at once, while the velocity of
    the other views continues. So the first frameset with a contradiction decides, and the pairs chosen there are
    followed as long as the contradiction lasts: later, an object's velocity is as constant as the rig's.
    """

    def __init__(self) -> None:
        self._is_open = False
        self._followed: frozenset[int] = frozenset()

    def resolve(
        self,
        visual: VisualResult,
        gate: Callable[[RelativeMotion], GateResult],
        has_imu: bool,
        followed: tuple[int, ...] = (),
    ) -> tuple[RelativeMotion, GateResult]:
        """Return the motion to use and its gate result.

        Args:
            visual: Result of the visual front-end, with a motion.
            gate: Innovation test of the estimator.
            has_imu: Whether the prediction is by an IMU.
            followed: Pairs that the IMU alone has agreed with until now, see `graphvio.backend.dead_reckoning`; none
                where that is not decided.
        """
        assert visual.motion is not None
        tested = sorted(((gate(motion), motion) for motion in visual.alternatives), key=lambda each: each[0].statistic)
        if tested and has_imu:
            (likely, motion), (unlikely, _) = tested[:2]
            if likely.accepted and not unlikely.accepted and likely.is_clear and unlikely.is_clear:
                return motion, likely
            for result, motion in tested:
                if motion.pairs == followed and result.accepted:
                    return motion, result
        elif tested:
            if not self._is_open:
                self._followed = _clearly_predicted(tested)
            self._is_open = True
            for result, motion in tested:
                if self._followed == set(motion.pairs) and not _is_less_likely(result, tested[0][0]):
                    return motion, result
            self._followed = frozenset()
        self._is_open = bool(tested)
        return visual.motion, gate(visual.motion)


def _clearly_predicted(tested: list[tuple[GateResult, RelativeMotion]]) -> frozenset[int]:
    """Return the pairs of the likeliest motion if it is clearly likelier and no pair supports another; else none."""
    (likely, motion), *others = tested
    is_decided = likely.accepted and _is_less_likely(others[0][0], likely)
    is_whole = all(set(motion.pairs).isdisjoint(other.pairs) for _, other in others)
    return frozenset(motion.pairs) if is_decided and is_whole else frozenset()


def _is_less_likely(one: GateResult, other: GateResult) -> bool:
    return one.statistic - other.statistic > _MIN_LIKELIER
