"""Several results side by side, against one truth or against one of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphvio.errors import TrajectoryError
from graphvio.evaluation.evaluation import MAX_GAP_S, Evaluation, evaluate
from graphvio.trajectory import Trajectory


@dataclass(frozen=True)
class Compared:
    """One of the results.

    Attributes:
        name: of it.
        evaluation: against the truth, or None where they could not be compared.
        why_not: why they could not, or empty.
        ate_ratio: position's ATE rmse over the first comparable result's.
    """

    name: str
    evaluation: Evaluation | None
    why_not: str
    ate_ratio: float | None

    @property
    def ate_m(self) -> float:
        """Position's ATE rmse; infinite where there is none."""
        return np.inf if self.evaluation is None else self.evaluation.ate_position_m.rmse


def compare(
    names: Sequence[str], results: Sequence[Trajectory], truth: Trajectory, max_gap_s: float = MAX_GAP_S
) -> list[Compared]:
    """Measure each result by the same truth; one that cannot be compared does not stop the others.

    Args:
        names: (N) of the results.
        results: N trajectories of body.
        truth: that all are held against.
        max_gap_s: greatest interval of the truth that is interpolated.
    """
    made: list[Compared] = []
    for name, result in zip(names, results, strict=True):
        try:
            evaluation = evaluate(result, truth, max_gap_s)
        except TrajectoryError as error:
            made.append(Compared(name, None, str(error), None))
            continue
        first = next((each.ate_m for each in made if each.evaluation is not None), evaluation.ate_position_m.rmse)
        ratio = evaluation.ate_position_m.rmse / first if first > 0.0 else None
        made.append(Compared(name, evaluation, "", ratio))
    return made
