"""Evaluation of estimated trajectories against truth: ATE, RPE, drift and loop-closure error."""

from graphvio.evaluation.evaluation import MAX_GAP_S, Compared, Evaluation, LoopClosureError, compare, evaluate
from graphvio.evaluation.measures import RelativeError, Stats, umeyama_se3

__all__ = [
    "MAX_GAP_S",
    "Compared",
    "Evaluation",
    "LoopClosureError",
    "RelativeError",
    "Stats",
    "compare",
    "evaluate",
    "umeyama_se3",
]
