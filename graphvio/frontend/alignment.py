"""Watches P_12: whether two pairs' own motions can be those of one rigid body with the transfer that the rig file says.

With a small error ``d`` of ``body_T_left`` (from the left, in body), a pair reports the motion ``exp(-d) M exp(d)``
where the rig's is M: its difference from another pair's motion is ``(Ad_M - 1) d``, linear in d. Motions over whole
keyframes, which share next to no noise, are collected, and d is their robust least-squares solution: section 4 in
small.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from graphvio.arrays import Float
from graphvio.frontend.refinement import Refined
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log

_KEPT = 100
_FEWEST = 6
_ROUNDS = 8
_CAUCHY = 9.0  # squared scale for the distance of one motion, which has 6 degrees of freedom
_PRIOR_SIGMAS = np.repeat([0.1, 0.2], 3)  # radians and metres: decides only in directions that no motion shows
_SIGNIFICANT = float(chi2.isf(1e-9, 6))
_MOST_OUTLIERS = 0.3


class Misalignment(NamedTuple):
    """An error of a pair's extrinsics.

    Attributes:
        tangent: (6,) ``[rotation, translation]`` d: the true ``body_T_left`` is ``exp(d)`` times the assumed one.
        covariance: (6, 6) of it.
        statistic: chi-square (6 degrees of freedom) of d being zero.
    """

    tangent: Float
    covariance: Float
    statistic: float

    @property
    def is_significant(self) -> bool:
        """Whether chance explains it less than once in 10^9."""
        return self.statistic > _SIGNIFICANT


class PairAlignment:
    """Collects what one pair's motions say of its place relative to another pair.

    Attributes:
        in_force: the error that the pair's motions allow for from here on, or None as long as it is none.
    """

    def __init__(self) -> None:
        self._equations: deque[tuple[Float, Float]] = deque(maxlen=_KEPT)  # whitened A (6, 6) and y (6,)
        self.in_force: Misalignment | None = None

    @property
    def correction(self) -> Float:
        """What the rig file's ``body_T_left`` of the pair is to be multiplied by from the left (4, 4)."""
        return np.eye(4) if self.in_force is None else se3_exp(self.in_force.tangent)

    def add(self, trusted: Refined, pair: Refined) -> None:
        """Take two motions over the same keyframe, the pair's computed with the correction in force."""
        correction = self.correction
        nominal = se3_inverse(correction) @ pair.cur_T_ref @ correction
        y = se3_log(np.ascontiguousarray(nominal @ se3_inverse(trusted.cur_T_ref)))
        a = se3_adjoint(trusted.cur_T_ref) - np.eye(6)
        whiten = np.linalg.inv(np.linalg.cholesky(trusted.covariance + pair.covariance))
        self._equations.append((whiten @ a, whiten @ y))

    def solve(self) -> Misalignment | None:
        """The error of the rig file's extrinsics, or None while too few motions agree on one."""
        if len(self._equations) < _FEWEST:
            return None
        a = np.array([equation[0] for equation in self._equations])
        y = np.array([equation[1] for equation in self._equations])
        prior = np.diag(1.0 / _PRIOR_SIGMAS**2)
        d, weights = np.zeros(6), np.ones(len(a))
        information = prior
        for _ in range(_ROUNDS):
            information = prior + np.einsum("n,nki,nkj->ij", weights, a, a)
            d = np.linalg.solve(information, np.einsum("n,nki,nk->i", weights, a, y))
            squared = np.sum((y - a @ d) ** 2, axis=1)
            weights = 1.0 / (1.0 + squared / _CAUCHY)
        if np.mean(squared > 4.0 * _CAUCHY) > _MOST_OUTLIERS:
            return None
        return Misalignment(d, np.asarray(np.linalg.inv(information)), float(d @ (information - prior) @ d))
