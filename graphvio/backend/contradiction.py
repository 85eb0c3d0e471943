"""Which of the motions is the rig's, where the pairs contradict each other."""

from collections.abc import Callable

from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.motion import RelativeMotion, VisualResult

_MIN_LIKELIER = 6.0  # difference of the statistics that decides without an IMU: 20 to 1


class Contradiction:
    """The choice between motion hypotheses by what the state estimator predicts.

    An IMU refuses a motion that is not the rig's. Without one, the prediction is constant velocity, which refuses
    hardly any; but whatever comes into one view and moves changes that view's velocity at once, while the others' goes
    on. So the first frameset with a contradiction decides, and as long as it lasts the same pairs are followed: later,
    an object's velocity is as constant as the rig's.
    """

    def __init__(self) -> None:
        self._is_open = False
        self._followed: frozenset[int] = frozenset()

    def resolve(
        self, visual: VisualResult, gate: Callable[[RelativeMotion], GateResult], has_imu: bool
    ) -> tuple[RelativeMotion, GateResult]:
        """Return the motion to use and its gate result.

        Args:
            visual: Result with a motion.
            gate: Innovation test of the estimator.
            has_imu: Whether an IMU predicts.
        """
        assert visual.motion is not None
        tested = sorted(((gate(motion), motion) for motion in visual.alternatives), key=lambda each: each[0].statistic)
        if tested and has_imu:
            (likely, motion), (unlikely, _) = tested[:2]
            if likely.accepted and not unlikely.accepted and likely.is_clear and unlikely.is_clear:
                return motion, likely
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
    """Return the pairs, of which none sees a second motion, whose motion is by far the likeliest, or none."""
    (likely, motion), *others = tested
    is_decided = likely.accepted and _is_less_likely(others[0][0], likely)
    is_whole = all(set(motion.pairs).isdisjoint(other.pairs) for _, other in others)
    return frozenset(motion.pairs) if is_decided and is_whole else frozenset()


def _is_less_likely(one: GateResult, other: GateResult) -> bool:
    return one.statistic - other.statistic > _MIN_LIKELIER
