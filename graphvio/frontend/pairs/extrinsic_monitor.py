"""Online monitoring of the extrinsics between pairs: whether their own motions fit one rigid body with the rig's P_12.

With an error ``d`` of ``body_T_left`` (multiplied from the left, in body), a pair measures the motion
``exp(-d) M exp(d)`` when the rig's motion is M. Motions over whole keyframes, which share next to no noise, are
collected, and d is estimated from them by robust least squares with Gauss-Newton, as in section 4 but for small errors.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.frontend.motion.refinement import Refined
from graphvio.frontend.thresholds import THRESHOLDS
from graphvio.geometry import se3_adjoint, se3_compose, se3_exp, se3_inverse, se3_log
from graphvio.kernels import kernel
from graphvio.rig import Rig

_T = THRESHOLDS.extrinsics


class ExtrinsicError(NamedTuple):
    """An error of a pair's extrinsics.

    Attributes:
        tangent: (6,) ``[rotation, translation]`` d: the true ``body_T_left`` is ``exp(d)`` times the assumed one.
        covariance: (6, 6) of d.
        statistic: Chi-square (6 degrees of freedom) of d being zero.
    """

    tangent: Float
    covariance: Float
    statistic: float

    def refutes(self, other: ExtrinsicError) -> bool:
        """Return whether another error differs significantly from this one."""
        apart = self.tangent - other.tangent
        return float(apart @ np.linalg.solve(self.covariance, apart)) > _T.max_chance_distance


class ExtrinsicMonitor:
    """Estimates the error of a pair's extrinsics relative to another pair, from the motions of both.

    The extrinsics are taken as they are, unless exact ones would show such an error less than once in 10^9 cases.

    Attributes:
        in_force: The error that the pair's motions are corrected for from now on, or None.
    """

    def __init__(self) -> None:
        self._motions: deque[tuple[Float, Float, Float]] = deque(maxlen=_T.max_motions)  # trusted, the pair's, whitener
        self.in_force: ExtrinsicError | None = None

    @property
    def correction(self) -> Float:
        """(4, 4) by which the rig's ``body_T_left`` of the pair is multiplied from the left."""
        return np.eye(4) if self.in_force is None else se3_exp(self.in_force.tangent)

    def add(self, trusted: Refined, pair: Refined) -> None:
        """Add the motions of the trusted pair and of this pair, corrected by the error in force, over one keyframe."""
        correction = self.correction
        uncorrected = se3_inverse(correction) @ pair.cur_T_ref @ correction
        whitener = np.linalg.inv(np.linalg.cholesky(trusted.covariance + pair.covariance))
        self._motions.append((trusted.cur_T_ref, uncorrected, whitener))

    def learn(self) -> bool:
        """Set ``in_force`` to a significant error, or to None if it is refuted; return whether it has changed."""
        found = self.solve()
        if found is None:
            return False
        if found.statistic > _T.max_chance_distance:
            self.in_force = found
            return True
        if self.in_force is not None and found.refutes(self.in_force):
            self.in_force = None
            return True
        return False

    def solve(self) -> ExtrinsicError | None:
        """Return the error of the rig's extrinsics, or None while too few motions agree on one."""
        if len(self._motions) < _T.min_motions:
            return None
        trusted, pairs, whiteners = (np.array(column) for column in zip(*self._motions, strict=True))
        prior = np.diag(1.0 / _T.prior_sigmas**2)
        d = np.zeros(6) if self.in_force is None else self.in_force.tangent
        information = prior
        for _ in range(_T.iterations):
            errors, derivatives = _linearised(se3_exp(d), trusted, pairs, whiteners)
            squared = np.sum(errors**2, axis=1)
            weights = 1.0 / (1.0 + squared / _T.cauchy_scale)
            information = prior + np.einsum("n,nki,nkj->ij", weights, derivatives, derivatives)
            gradient = prior @ d + np.einsum("n,nki,nk->i", weights, derivatives, errors)
            d = d - np.linalg.solve(information, gradient)
        if np.mean(squared > 4.0 * _T.cauchy_scale) > _T.max_outlier_share:
            return None
        return ExtrinsicError(d, np.asarray(np.linalg.inv(information)), float(d @ (information - prior) @ d))


def warm_up_extrinsic_monitor(motion: Refined) -> None:
    """Compile the kernels of `ExtrinsicMonitor` for the warm-up, by adding a motion that shows no error."""
    monitor = ExtrinsicMonitor()
    for _ in range(_T.min_motions):
        monitor.add(motion, motion)
    monitor.learn()


def describe(rig: Rig, pair: int, error: ExtrinsicError) -> str:
    """Describe how far a pair is from where the rig has it, relative to the first pair, as a clause."""
    group = rig.groups[pair]
    kind = "pair" if pair < len(rig.pairs) else "camera"
    adjoint = se3_adjoint(np.ascontiguousarray(rig.pairs[0].left.cam_T_body))
    turned, moved = np.split(adjoint @ error.tangent, 2)
    covariance = adjoint @ error.covariance @ adjoint.T
    sigmas = np.sqrt([np.linalg.eigvalsh(block)[-1] for block in (covariance[:3, :3], covariance[3:, 3:])])
    angle, distance = float(np.linalg.norm(turned)), float(np.linalg.norm(moved))
    by_angle = f"{np.rad2deg(angle):.2f} (+- {np.rad2deg(sigmas[0]):.2f}) deg"
    by_distance = f"{100 * distance:.1f} (+- {100 * sigmas[1]:.1f}) cm"
    if sigmas[0] > max(_T.max_vague_share * angle, _T.max_fine_rad):
        by_angle = "an angle that these motions do not determine"
    if sigmas[1] > max(_T.max_vague_share * distance, _T.max_fine_m):
        by_distance = "a distance that these motions do not determine"
    return (
        f"{kind} {group.name} is {by_angle} and {by_distance} from where the rig has it, as its motion and "
        "the first pair's show"
    )


def placed(motion: Refined, extrinsics_covariance: Float | None) -> Refined:
    """Enlarge the covariance of a pair's motion by the effect of its extrinsics' covariance (6, 6), None if exact."""
    if extrinsics_covariance is None:
        return motion
    lever = np.eye(6) - se3_adjoint(motion.cur_T_ref)
    return replace(motion, covariance=motion.covariance + lever @ extrinsics_covariance @ lever.T)


def combined(joint: Refined, motions: Sequence[Refined]) -> Refined:
    """Combine the motions of pairs, some of which have been corrected, weighted by their covariances, see `placed`.

    Refining on the points of all pairs would weight them as if the corrections were exact.

    Args:
        joint: Motion on all points, whose inliers and errors are kept.
        motions: Own motion of each pair.
    """
    first = motions[0].cur_T_ref
    information, weighted, through_points = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6))
    for motion in motions:
        inverse = np.linalg.inv(motion.covariance)
        information += inverse
        weighted += inverse @ se3_log(np.ascontiguousarray(motion.cur_T_ref @ se3_inverse(first)))
        through_points += inverse @ motion.shared_covariance @ inverse
    covariance = np.asarray(np.linalg.inv(information))
    return replace(
        joint,
        cur_T_ref=se3_exp(covariance @ weighted) @ first,
        covariance=covariance,
        shared_covariance=covariance @ through_points @ covariance,
    )


@kernel
def _linearised(correction: Float, trusted: Float, pairs: Float, whiteners: Float) -> tuple[Float, Float]:
    """Return whitened differences (N, 6) of a pair's corrected motions from the trusted ones, and their derivatives.

    The derivatives (N, 6, 6) are with respect to one more correction, multiplied from the left.
    """
    n = len(trusted)
    errors, derivatives = np.empty((n, 6)), np.empty((n, 6, 6))
    inverse = se3_inverse(correction)
    for i in range(n):
        corrected = se3_compose(se3_compose(correction, pairs[i]), inverse)
        apart, adjoint = se3_log(se3_compose(corrected, se3_inverse(trusted[i]))), se3_adjoint(corrected)
        for r in range(6):
            errors[i, r] = 0.0
            for k in range(6):
                errors[i, r] += whiteners[i, r, k] * apart[k]
                derivatives[i, r, k] = whiteners[i, r, k]
                for m in range(6):
                    derivatives[i, r, k] -= whiteners[i, r, m] * adjoint[m, k]
    return errors, derivatives
