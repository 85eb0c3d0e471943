"""Which motion the estimator takes where pairs contradict each other."""

from __future__ import annotations

import numpy as np
import pytest

from graphvio.backend.contradiction import Contradiction
from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult

SET = tuple[tuple[int, ...], float]
"""Pairs of a motion hypothesis, and the statistic of its innovation test."""


def chosen(
    contradiction: Contradiction, hypotheses: list[SET], *, has_imu: bool = False, followed: tuple[int, ...] = ()
) -> tuple[int, ...]:
    """Return the pairs whose motion is used; of hypotheses that cover each other, none."""
    statistics = dict(hypotheses)

    def gate(motion: RelativeMotion) -> GateResult:
        statistic = statistics.get(motion.pairs, 1.0)
        return GateResult(statistic < 27.9, statistic, 27.9, np.zeros(6), np.eye(6))

    motions = tuple(RelativeMotion(0, 1, np.eye(4), np.eye(6), np.eye(6), 100, pairs=pairs) for pairs in statistics)
    covering = RelativeMotion(0, 1, np.eye(4), 100.0 * np.eye(6), np.eye(6), 100)
    visual = VisualResult(covering, Quality.WEAK, "two motions", {}, alternatives=motions)
    motion, result = contradiction.resolve(visual, gate, has_imu, followed)
    assert result.statistic == gate(motion).statistic
    return motion.pairs


def test_contradiction_without_imu_follows_the_pair_whose_velocity_went_on() -> None:
    """Afterwards the object's velocity is constant, too, and does not count against that pair."""
    contradiction = Contradiction()
    assert chosen(contradiction, [((0,), 15.0), ((1,), 1.0)]) == (1,)
    assert chosen(contradiction, [((0,), 1.0), ((1,), 5.0)]) == (1,)
    assert chosen(contradiction, []) == ()
    assert chosen(contradiction, [((0,), 1.0), ((1,), 5.0)]) == ()  # it is over: another one is not decided by it


@pytest.mark.parametrize(
    "hypotheses",
    [
        [((0,), 2.0), ((1,), 7.0)],  # both may be
        [((0,), 30.0), ((1,), 60.0)],  # none may be
        [((0, 1), 1.0), ((0,), 40.0)],  # a pair that sees both
    ],
)
def test_contradiction_that_is_not_decided_at_first_stays_so(hypotheses: list[SET]) -> None:
    contradiction = Contradiction()
    assert chosen(contradiction, hypotheses) == ()
    assert chosen(contradiction, [((0,), 15.0), ((1,), 1.0)]) == ()


def test_contradiction_leaves_a_pair_that_becomes_unlikely() -> None:
    contradiction = Contradiction()
    assert chosen(contradiction, [((0,), 15.0), ((1,), 1.0)]) == (1,)
    assert chosen(contradiction, [((0,), 1.0), ((1,), 9.0)]) == ()
    assert chosen(contradiction, [((0,), 15.0), ((1,), 1.0)]) == ()


def test_contradiction_with_imu_takes_what_it_accepts_alone() -> None:
    assert chosen(Contradiction(), [((0,), 90.0), ((1,), 5.0)], has_imu=True) == (1,)
    assert chosen(Contradiction(), [((0,), 20.0), ((1,), 1.0)], has_imu=True) == ()
    assert chosen(Contradiction(), [((0,), 40.0), ((1,), 20.0)], has_imu=True) == ()


def test_contradiction_with_imu_takes_the_followed_pairs_where_it_accepts_all() -> None:
    both: list[SET] = [((0,), 5.0), ((1,), 6.0)]
    assert chosen(Contradiction(), both, has_imu=True, followed=(1,)) == (1,)
    assert chosen(Contradiction(), both, has_imu=True, followed=(2,)) == ()
    assert chosen(Contradiction(), [((0,), 5.0), ((1,), 30.0)], has_imu=True, followed=(1,)) == ()
    assert chosen(Contradiction(), [((0,), 5.0), ((1,), 90.0)], has_imu=True, followed=(1,)) == (0,)
