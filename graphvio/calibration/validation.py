"""Whether a calibration can be trusted: one half against the other, resampling, growth of the recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from graphvio.arrays import Float, Int
from graphvio.calibration import graph
from graphvio.calibration.consistency import Further, whitened
from graphvio.calibration.dispersion import blocks
from graphvio.calibration.graph import GraphSolution
from graphvio.calibration.observability import observe
from graphvio.calibration.paper_method import PoseParts, alignment_errors
from graphvio.calibration.pose_pairs import FEWEST, PosePairs
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_inverse, se3_log

_RESAMPLES = 200
_TOLD = 1e-12  # of the largest information: less is taken for none
_POINTS = 8  # of the growth
_CHANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Halves:
    """A recording's first half against its second one.

    Attributes:
        own_m: mean alignment error of inliers by the half's own solution, first and second half.
        crossed_m: by the other half's solution.
        difference: (6,) tangent from the first half's solution to the second's.
        covariance: (6, 6) that it has where it is chance.
    """

    own_m: tuple[float, float]
    crossed_m: tuple[float, float]
    difference: Float
    covariance: Float

    @property
    def statistic(self) -> float:
        """Squared Mahalanobis distance of the two solutions, 6 degrees of freedom."""
        return float(self.difference @ np.linalg.solve(self.covariance, self.difference))

    @property
    def agree(self) -> bool:
        """Whether chance explains the difference."""
        return self.statistic <= float(chi2.isf(_CHANCE, 6))


class Grown(NamedTuple):
    """The solution from a recording's beginning only.

    Attributes:
        end_ns: where it ends.
        left2_T_left1: (4, 4).
        covariance: (6, 6) of it, as the motions tell.
    """

    end_ns: int
    left2_T_left1: Float
    covariance: Float


def halves(
    pairs: PosePairs, solution: GraphSolution, factor: float, further: Further | None, floor: Float
) -> Halves | None:
    """Solve for each half alone; None where a half does not tell enough.

    Args:
        pairs: N pose pairs.
        solution: of all.
        factor: on what the motions' covariances say.
        further: unknowns besides.
        floor: (6, 6) covariance of what no recording tells.
    """
    middle = np.median(pairs.end_ns)
    parts = [np.flatnonzero(pairs.end_ns <= middle), np.flatnonzero(pairs.end_ns > middle)]
    found = [each for rows in parts if (each := _of(pairs, rows, solution, further)) is not None]
    if len(found) < 2:
        return None

    def mean_error(half: int, by: int) -> float:
        errors = alignment_lengths(pairs.chosen(parts[half][found[half].inlier]), found[by].left2_T_left1)
        return float(errors.mean())

    one, other = found
    return Halves(
        own_m=(mean_error(0, 0), mean_error(1, 1)),
        crossed_m=(mean_error(0, 1), mean_error(1, 0)),
        difference=se3_log(se3_inverse(one.left2_T_left1) @ other.left2_T_left1),
        covariance=factor * (one.covariance + other.covariance) + 2.0 * floor,
    )


def resampled(pairs: PosePairs, solution: GraphSolution, further: Further | None, seed: int) -> Float:
    """Covariance (6 + M, 6 + M) of the solution and further unknowns, by a bootstrap over blocks of some seconds, which
    keeps what neighbouring motions have in common (H. R. Künsch, *The Jackknife and the Bootstrap for General
    Stationary Observations*, 1989); each time one step of Gauss-Newton from the solution.
    """
    rng = np.random.default_rng(seed)
    chosen = pairs.chosen(solution.inlier)
    unknowns = Further.none(chosen) if further is None else further.chosen(solution.inlier)
    errors, jacobians = whitened(chosen, solution.left2_T_left1, unknowns, solution.further)
    number = np.unique(blocks(chosen), return_inverse=True)[1]
    count = int(number.max()) + 1
    size = jacobians.shape[2]
    told, pull = np.zeros((count, size, size)), np.zeros((count, size))
    np.add.at(told, number, np.einsum("nki,nkj->nij", jacobians, jacobians))
    np.add.at(pull, number, np.einsum("nki,nk->ni", jacobians, errors))
    known = np.diag(np.concatenate([np.zeros(6), unknowns.sigmas**-2]))
    steps = np.empty((_RESAMPLES, size))
    for i in range(_RESAMPLES):
        times = np.bincount(rng.integers(count, size=count), minlength=count).astype(np.float64)
        normal = np.einsum("b,bij->ij", times, told) + known
        steps[i] = np.linalg.lstsq(normal, -times @ pull, rcond=_TOLD)[0]
    return np.asarray(np.cov(steps.T))


def growth(pairs: PosePairs, solution: GraphSolution, further: Further | None) -> tuple[Grown, ...]:
    """Solutions from longer and longer beginnings, as far as they tell everything."""
    begin, end = int(pairs.start_ns[0]), int(pairs.end_ns[-1])
    grown = []
    for share in 2.0 ** -np.arange(_POINTS - 1, -1, -1.0):
        rows = np.flatnonzero(pairs.end_ns <= begin + share * (end - begin))
        found = _of(pairs, rows, solution, further)
        if found is not None:
            grown.append(Grown(int(pairs.end_ns[rows[-1]]), found.left2_T_left1, found.covariance))
    return tuple(grown)


def alignment_lengths(pairs: PosePairs, left2_T_left1: Float) -> Float:
    """Lengths (N,) of the paper's alignment errors, eq. (7), metres."""
    R = np.ascontiguousarray(left2_T_left1[:3, :3])
    errors = alignment_errors(PoseParts.of(pairs), R, -R.T @ left2_T_left1[:3, 3])
    return np.asarray(np.linalg.norm(errors, axis=1))


def _of(pairs: PosePairs, rows: Int, solution: GraphSolution, further: Further | None) -> GraphSolution | None:
    """The solution from some pose pairs, or None where they do not tell everything."""
    some = pairs.chosen(rows)
    if len(some) < FEWEST or not observe(some, solution.left2_T_left1).is_complete:
        return None
    try:
        found = graph.solve(some, solution.left2_T_left1, None if further is None else further.chosen(rows))
    except CalibrationError:
        return None
    return found if found.observability.is_complete else None
