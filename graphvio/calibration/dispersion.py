"""How much more a calibration scatters than the motions' covariances say.

Errors of neighbouring motions may have causes in common (a wall without corners, a drifting odometry), which no
covariance of a single motion shows. Each block of some seconds, taken for itself, must pull the solution by no more
than its covariance allows; by how much more it does is the factor, as R. T. Birge's ratio of external to internal
errors.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from graphvio.arrays import Float, Int
from graphvio.calibration.pose_pairs import PosePairs

BLOCK_S = 5.0
_FEWEST_BLOCKS = 4
_TOLD = 1e-6  # of the largest information: directions of which a block tells less are left out
_NS_PER_S = 1e9


def blocks(pairs: PosePairs) -> Int:
    """Numbers (N,) of the blocks that pose pairs lie in: `BLOCK_S` long, or shorter where there would be too few."""
    if not len(pairs):
        return np.zeros(0, dtype=np.int64)
    since_s = (pairs.start_ns - pairs.start_ns[0]) / _NS_PER_S
    length_s = min(BLOCK_S, (float(since_s[-1]) + 1e-9) / (2 * _FEWEST_BLOCKS))
    return np.asarray((since_s // max(length_s, 1e-9)).astype(np.int64))


def dispersion(pairs: PosePairs, errors: Float, jacobians: Float, determined: Float, chance: float = 0.01) -> float:
    """The factor on the solution's covariance, at least 1; 1 where chance explains the scatter.

    Args:
        pairs: N pose pairs, which the solution is from.
        errors: (N, 6) there, of unit covariance.
        jacobians: (N, 6, M) of them.
        determined: (K, M) orthonormal directions of the unknowns that the pose pairs determine.
        chance: that honest covariances are enlarged.
    """
    number = blocks(pairs)
    jacobians = jacobians @ determined.T
    squares, degrees = 0.0, -len(determined)
    for block in np.unique(number):
        of_block = number == block
        told = np.einsum("nki,nkj->ij", jacobians[of_block], jacobians[of_block])
        pull = np.einsum("nki,nk->i", jacobians[of_block], errors[of_block])
        sizes, directions = np.linalg.eigh(told)
        kept = sizes > _TOLD * sizes[-1]
        squares += float(np.sum((directions[:, kept].T @ pull) ** 2 / sizes[kept]))
        degrees += int(kept.sum())
    if degrees <= 0 or squares < chi2.isf(chance, degrees):
        return 1.0
    return max(squares / degrees, 1.0)
