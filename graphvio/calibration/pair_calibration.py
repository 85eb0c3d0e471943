"""P_12 of two pairs from what each tells of its own motion, by both methods (section 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.calibration import graph, paper_method
from graphvio.calibration.comparison import Comparison, compare
from graphvio.calibration.observability import Observability
from graphvio.calibration.paper_method import PoseParts, alignment_errors
from graphvio.calibration.pose_pairs import PosePairs
from graphvio.calibration.spans import Stretches, most_telling, of_one_length
from graphvio.geometry import se3_inverse, se3_log

_MOST_OUTLIERS = 0.5


@dataclass(frozen=True, eq=False)
class PairCalibration:
    """Where the second of two pairs is, and how that was found.

    Attributes:
        left2_T_left1: (4, 4), the paper's P_12, by the graph.
        covariance: (6, 6) of it, tangent ``[rotation, translation]`` in left1; very large where the motions do not
            tell, see `observability`.
        pairs: N pose pairs that it was found from.
        inlier: (N,) those that are no outliers.
        squares: (N,) squared Mahalanobis distances of their errors, 6 degrees of freedom each.
        alignment_errors_m: (N,) lengths of the paper's alignment errors, eq. (7).
        paper_left2_T_left1: (4, 4) by the paper's method.
        comparison: of both methods.
        observability: what the motions tell.
        warnings: a sentence each.
    """

    left2_T_left1: Float
    covariance: Float
    pairs: PosePairs
    inlier: Bool
    squares: Float
    alignment_errors_m: Float
    paper_left2_T_left1: Float
    comparison: Comparison
    observability: Observability
    warnings: tuple[str, ...]

    def distance(self, left2_T_left1: Float) -> float:
        """Squared Mahalanobis distance (6 degrees of freedom) of another ``left2_T_left1`` (4, 4), such as a rig
        file's."""
        apart = se3_log(se3_inverse(self.left2_T_left1) @ np.ascontiguousarray(left2_T_left1))
        return float(apart @ np.linalg.solve(self.covariance, apart))


def calibrate_pair(stretches: Stretches, seed: int = 0) -> PairCalibration:
    """Calibrate two pairs.

    Args:
        stretches: pose pairs over all stretches of time that may be chosen.
        seed: of the random triples.

    Raises:
        CalibrationError: if there are fewer than three pose pairs, the rig hardly turned, or no relative pose explains
            the motions; the message says what to do.
    """
    first = stretches.chosen(of_one_length(stretches))
    begun = graph.solve(first, paper_method.calibrate(first, seed).left2_T_left1)
    pairs = stretches.chosen(most_telling(stretches, begun.left2_T_left1, begun.covariance))
    paper = paper_method.calibrate(pairs, seed)
    found = graph.solve(pairs, paper.left2_T_left1)
    comparison = compare(pairs, paper, found)
    R = np.ascontiguousarray(found.left2_T_left1[:3, :3])
    errors = alignment_errors(PoseParts.of(pairs), R, -R.T @ found.left2_T_left1[:3, 3])
    warnings = list(found.observability.missing)
    if not comparison.agrees:
        warnings.append(_disagreement(comparison))
    share = 1.0 - float(found.inlier.mean())
    if share > _MOST_OUTLIERS:
        warnings.append(f"{100 * share:.0f} % of the motions do not fit: look at each pair's own trajectory")
    return PairCalibration(
        left2_T_left1=found.left2_T_left1,
        covariance=found.covariance,
        pairs=pairs,
        inlier=found.inlier,
        squares=found.squares,
        alignment_errors_m=np.linalg.norm(errors, axis=1),
        paper_left2_T_left1=paper.left2_T_left1,
        comparison=comparison,
        observability=found.observability,
        warnings=tuple(warnings),
    )


def _disagreement(comparison: Comparison) -> str:
    apart = comparison.difference
    return (
        f"the paper's method and the graph differ by {np.rad2deg(np.linalg.norm(apart[:3])):.3f} degrees and "
        f"{1e3 * np.linalg.norm(apart[3:]):.1f} mm, more than their noise explains (chi-square "
        f"{comparison.statistic:.1f}, limit {comparison.limit:.1f})"
    )
