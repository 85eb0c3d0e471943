"""A test whether the paper's method and the graph differ by more than noise explains.

Both are functions of the same noisy motions, so their errors are correlated: the covariance of their difference is
propagated, to first order, from each pose pair's noise to both solutions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space
from scipy.special import chdtri

from graphvio.arrays import Float
from graphvio.calibration.consistency import error_covariance, error_of, information
from graphvio.calibration.graph import GraphSolution
from graphvio.calibration.paper_method import PaperSolution, PoseParts, jacobians
from graphvio.calibration.pose_pairs import PosePairs
from graphvio.geometry import se3_adjoint, se3_inverse, se3_log, skew

_CHANCE = 1e-3  # probability of a false alarm
_LINEARISATION = 0.1  # error of the first-order propagation, in the solution's sigmas


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two solutions of one calibration, in the directions that the motions determine."""

    difference: Float  # (6,) tangent from the graph's solution to the paper's, ``[rotation, translation]`` in left1
    covariance: Float  # (6, 6) of the difference due to the noise of the motions
    determined: Float  # (K, 6) orthonormal directions in which they are compared
    paper_covariance: Float  # (6, 6) of the paper's solution, which does not weight the motions, due to the same noise

    @property
    def statistic(self) -> float:
        """Squared Mahalanobis distance between the two, K degrees of freedom."""
        apart = self.determined @ self.difference
        return float(apart @ np.linalg.solve(self.determined @ self.covariance @ self.determined.T, apart))

    @property
    def limit(self) -> float:
        """Largest statistic that chance explains."""
        return float(chdtri(len(self.determined), _CHANCE))

    @property
    def agrees(self) -> bool:
        """Whether chance explains the difference."""
        return self.statistic <= self.limit


def compare(pairs: PosePairs, paper: PaperSolution, graph: GraphSolution, dispersion: float = 1.0) -> Comparison:
    """Compare two solutions for the same N pose pairs; the dispersion scales the covariances of their motions.

    The graph's nuisance variables must be about zero.
    """
    by_paper = _influence_on_paper(pairs, paper)
    determined = null_space(graph.observability.undetermined).T if not graph.observability.is_complete else np.eye(6)
    by_graph = _influence_on_graph(pairs, graph, determined)
    first_order = _LINEARISATION**2 * dispersion * graph.covariance
    noise = dispersion * np.concatenate([pairs.covariance_1, pairs.covariance_2])
    apart = by_paper - by_graph
    return Comparison(
        se3_log(se3_inverse(graph.left2_T_left1) @ np.ascontiguousarray(paper.left2_T_left1)),
        np.einsum("nij,njk,nlk->il", apart, noise, apart) + first_order,
        determined,
        np.einsum("nij,njk,nlk->il", by_paper, noise, by_paper),
    )


def _influence_on_paper(pairs: PosePairs, paper: PaperSolution) -> Float:
    """Return derivatives (2 N, 6, 6) of the paper's solution by the errors of all first, then all second motions."""
    R = paper.left2_T_left1[:3, :3]
    t = -R.T @ paper.left2_T_left1[:3, 3]
    J = jacobians(PoseParts.of(pairs), R) * paper.inlier[:, None, None]
    in_tangent = np.block([[np.zeros((3, 3)), 2.0 * R.T], [-np.eye(3), 2.0 * skew(t) @ R.T]])
    gains = -in_tangent @ np.linalg.pinv(np.einsum("nki,nkj->ij", J, J), hermitian=True) @ np.swapaxes(J, 1, 2)
    of_1 = pairs.motion_1[:, :3, :3] @ np.hstack([-skew(t), np.eye(3)])
    of_2 = np.concatenate([np.zeros((len(pairs), 3, 3)), -R.T @ pairs.motion_2[:, :3, :3]], axis=2)
    return np.concatenate([gains @ of_1, gains @ of_2])


def _influence_on_graph(pairs: PosePairs, graph: GraphSolution, determined: Float) -> Float:
    """Return the derivatives (2 N, 6, 6) of the graph's solution, in the same order."""
    pose, chosen = graph.left2_T_left1, pairs.select(graph.inlier)
    known = determined @ information(chosen, pose) @ determined.T
    covariance = determined.T @ np.linalg.solve(known, determined)
    gains = np.zeros((len(pairs), 6, 6))
    for k in np.flatnonzero(graph.inlier):
        _, jacobian = error_of(pose, pairs.motion_1[k], pairs.motion_2[k])
        noise = error_covariance(pose, pairs.covariance_1[k], pairs.covariance_2[k])
        gains[k] = -covariance @ np.linalg.solve(noise, jacobian).T
    return np.concatenate([gains @ se3_adjoint(pose), -gains])
