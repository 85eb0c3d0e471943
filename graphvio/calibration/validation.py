"""Checks of a calibration: comparison of the recording's halves, bootstrap, growing recordings, and dispersion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from graphvio.arrays import Float, Int
from graphvio.calibration import graph
from graphvio.calibration.consistency import whitened
from graphvio.calibration.graph import GraphSolution
from graphvio.calibration.nuisances import Nuisances
from graphvio.calibration.observability import observe
from graphvio.calibration.paper_method import PoseParts, alignment_errors
from graphvio.calibration.pose_pairs import MIN_PAIRS, PosePairs
from graphvio.errors import CalibrationError
from graphvio.geometry import se3_inverse, se3_log

_BLOCK_S = 5.0
_MIN_BLOCKS = 4
_MIN_BLOCK_INFORMATION = 1e-6  # relative to the largest: directions with less information in a block are left out
_RESAMPLES = 200
_MIN_INFORMATION = 1e-12  # relative to the largest: less counts as none
_GROWTH_POINTS = 8
_CHANCE = 1e-3
_NS_PER_S = 1e9


@dataclass(frozen=True, eq=False)
class Halves:
    """The solutions from a recording's first and second half."""

    own_m: tuple[float, float]  # mean alignment error of inliers by the half's own solution, first and second half
    crossed_m: tuple[float, float]  # the same by the other half's solution
    difference: Float  # (6,) tangent from the first half's solution to the second's
    covariance: Float  # (6, 6) of the difference, if the cameras did not move on the rig

    @property
    def statistic(self) -> float:
        """Squared Mahalanobis distance of the two solutions, 6 degrees of freedom."""
        return float(self.difference @ np.linalg.solve(self.covariance, self.difference))

    @property
    def agree(self) -> bool:
        """Whether chance explains the difference."""
        return self.statistic <= float(chdtri(6, _CHANCE))


class Grown(NamedTuple):
    """The solution from a first part of a recording."""

    end_ns: int  # end of the part that is used
    left2_T_left1: Float  # (4, 4)
    covariance: Float  # (6, 6) of left2_T_left1


def halves(
    pairs: PosePairs, solution: GraphSolution, factor: float, nuisances: Nuisances, floor: Float
) -> Halves | None:
    """Compare the solutions from each half alone; None where one half does not determine the pose.

    Args:
        pairs: N pose pairs.
        solution: solution from all pose pairs.
        factor: factor on the covariances of both solutions.
        nuisances: nuisance variables that are estimated as well.
        floor: (6, 6) covariance of systematic errors of each solution.
    """
    middle = np.median(pairs.end_ns)
    parts = [np.flatnonzero(pairs.end_ns <= middle), np.flatnonzero(pairs.end_ns > middle)]
    found = [each for rows in parts if (each := _solve_part(pairs, rows, solution, nuisances)) is not None]
    if len(found) < 2:
        return None

    def mean_error(half: int, by: int) -> float:
        errors = alignment_lengths(pairs.select(parts[half][found[half].inlier]), found[by].left2_T_left1)
        return float(errors.mean())

    one, other = found
    return Halves(
        own_m=(mean_error(0, 0), mean_error(1, 1)),
        crossed_m=(mean_error(0, 1), mean_error(1, 0)),
        difference=se3_log(se3_inverse(one.left2_T_left1) @ other.left2_T_left1),
        covariance=factor * (one.covariance + other.covariance) + 2.0 * floor,
    )


def resampled(pairs: PosePairs, solution: GraphSolution, nuisances: Nuisances, seed: int) -> Float:
    """Estimate the covariance (6 + M, 6 + M) of pose and nuisance variables by a bootstrap over blocks of some seconds.

    Blocks preserve the correlation of neighbouring motions (H. R. Künsch, *The Jackknife and the Bootstrap for General
    Stationary Observations*, 1989). Each sample takes one Gauss-Newton step from the solution.
    """
    rng = np.random.default_rng(seed)
    chosen, nuisances = pairs.select(solution.inlier), nuisances.select(solution.inlier)
    errors, jacobians = whitened(chosen, solution.left2_T_left1, nuisances, solution.nuisances)
    number = np.unique(_blocks(chosen), return_inverse=True)[1]
    count = int(number.max()) + 1
    size = jacobians.shape[2]
    normals, gradients = np.zeros((count, size, size)), np.zeros((count, size))
    np.add.at(normals, number, np.einsum("nki,nkj->nij", jacobians, jacobians))
    np.add.at(gradients, number, np.einsum("nki,nk->ni", jacobians, errors))
    prior = np.diag(np.concatenate([np.zeros(6), nuisances.sigmas**-2]))
    steps = np.empty((_RESAMPLES, size))
    for i in range(_RESAMPLES):
        times = np.bincount(rng.integers(count, size=count), minlength=count).astype(np.float64)
        normal = np.einsum("b,bij->ij", times, normals) + prior
        steps[i] = np.linalg.lstsq(normal, -times @ gradients, rcond=_MIN_INFORMATION)[0]
    return np.asarray(np.cov(steps.T))


def growth(pairs: PosePairs, solution: GraphSolution, nuisances: Nuisances) -> tuple[Grown, ...]:
    """Solve for increasing parts of the recording, from its beginning; omit those that do not determine the pose."""
    begin, end = int(pairs.start_ns[0]), int(pairs.end_ns[-1])
    grown = []
    for share in 2.0 ** -np.arange(_GROWTH_POINTS - 1, -1, -1.0):
        rows = np.flatnonzero(pairs.end_ns <= begin + share * (end - begin))
        found = _solve_part(pairs, rows, solution, nuisances)
        if found is not None:
            grown.append(Grown(int(pairs.end_ns[rows[-1]]), found.left2_T_left1, found.covariance))
    return tuple(grown)


def dispersion(pairs: PosePairs, errors: Float, jacobians: Float, determined: Float, chance: float = 0.01) -> float:
    """Estimate the factor by which a solution's covariance exceeds what the motions' covariances predict.

    Errors of neighbouring motions may have a common cause (a wall without corners, a drifting odometry), which the
    covariance of a single motion does not show. Each block of some seconds, by itself, must shift the solution by no
    more than its covariance allows; the excess is the factor, R. T. Birge's ratio of external to internal errors.

    Args:
        pairs: N pose pairs from which the solution was found.
        errors: (N, 6) whitened errors at the solution.
        jacobians: (N, 6, M) derivatives of the errors.
        determined: (K, M) orthonormal directions of the unknowns that the pose pairs determine.
        chance: probability of a factor above 1 for consistent covariances.

    Returns:
        The factor; 1 where chance explains the excess.
    """
    number = _blocks(pairs)
    jacobians = jacobians @ determined.T
    squares, degrees = 0.0, -len(determined)
    for block in np.unique(number):
        of_block = number == block
        normal = np.einsum("nki,nkj->ij", jacobians[of_block], jacobians[of_block])
        gradient = np.einsum("nki,nk->i", jacobians[of_block], errors[of_block])
        sizes, directions = np.linalg.eigh(normal)
        kept = sizes > _MIN_BLOCK_INFORMATION * sizes[-1]
        squares += float(np.sum((directions[:, kept].T @ gradient) ** 2 / sizes[kept]))
        degrees += int(kept.sum())
    if degrees <= 0 or squares < chdtri(degrees, chance):
        return 1.0
    return max(squares / degrees, 1.0)


def alignment_lengths(pairs: PosePairs, left2_T_left1: Float) -> Float:
    """Compute the lengths (N,) of the paper's alignment errors, eq. (7), metres."""
    R = np.ascontiguousarray(left2_T_left1[:3, :3])
    errors = alignment_errors(PoseParts.of(pairs), R, -R.T @ left2_T_left1[:3, 3])
    return np.asarray(np.linalg.norm(errors, axis=1))


def _blocks(pairs: PosePairs) -> Int:
    """Return the number (N,) of the block of each pose pair; blocks are shorter where there would be too few."""
    if not len(pairs):
        return np.zeros(0, dtype=np.int64)
    since_s = (pairs.start_ns - pairs.start_ns[0]) / _NS_PER_S
    length_s = min(_BLOCK_S, (float(since_s[-1]) + 1e-9) / (2 * _MIN_BLOCKS))
    return np.asarray((since_s // max(length_s, 1e-9)).astype(np.int64))


def _solve_part(pairs: PosePairs, rows: Int, solution: GraphSolution, nuisances: Nuisances) -> GraphSolution | None:
    """Solve for some of the pose pairs; None where they do not determine the pose."""
    some = pairs.select(rows)
    if len(some) < MIN_PAIRS or not observe(some, solution.left2_T_left1).is_complete:
        return None
    try:
        found = graph.solve(some, solution.left2_T_left1, nuisances.select(rows))
    except CalibrationError:
        return None
    return found if found.observability.is_complete else None
