"""Nuisance variables of a calibration, among them the ratio of the lengths that two cameras measure.

A pair whose baseline is wrong by 1 % measures all motions 1 % too long or too short.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.calibration.pose_pairs import PosePairs

ScaleMode = Literal["auto", "estimate", "fixed"]

_SIGNIFICANT = 4.0  # sigmas
_MIN_LOG_RATIO = 2e-3  # error that a good calibration of a pair leaves
_LOG_RATIO_SIGMA = 0.1  # a priori


class Nuisances(NamedTuple):
    """Nuisance variables on which the errors of pose pairs depend linearly: a clock offset, a scale."""

    derivatives: Float  # (N, 6, M) of the errors, see `consistency.error_of`
    sigmas: Float  # (M,) a-priori standard deviations around zero

    @staticmethod
    def none(count: int) -> Nuisances:
        """Return an empty set of variables (M = 0) for ``count`` pose pairs."""
        return Nuisances(np.zeros((count, 6, 0)), np.zeros(0))

    def select(self, rows: Bool | Int) -> Nuisances:
        """Return the variables for some of the pose pairs."""
        return Nuisances(self.derivatives[rows], self.sigmas)

    def with_scale(self, pairs: PosePairs) -> Nuisances:
        """Append the logarithm of the ratio of the second camera's lengths to the first's."""
        by_scale = np.zeros((len(pairs), 6, 1))
        by_scale[:, 3:, 0] = np.einsum("nji,nj->ni", pairs.motion_2[:, :3, :3], pairs.motion_2[:, :3, 3])
        return Nuisances(
            np.concatenate([self.derivatives, by_scale], axis=2),
            np.concatenate([self.sigmas, [_LOG_RATIO_SIGMA]]),
        )


@dataclass(frozen=True)
class ScaleCheck:
    """The ratio of the second camera's lengths to the first's."""

    log_ratio: float  # natural logarithm, so 0.01 where the second measures 1 % longer
    sigma: float  # standard deviation of log_ratio

    @property
    def is_wrong(self) -> bool:
        """Whether a baseline or focal length is wrong, significantly and by more than calibrations usually leave."""
        return abs(self.log_ratio) > max(_SIGNIFICANT * self.sigma, _MIN_LOG_RATIO)

    def describe(self, first: str, second: str) -> str:
        """Return a sentence about the ratio for cameras with these names."""
        longer = "longer" if self.log_ratio > 0.0 else "shorter"
        return (
            f"{second} measures lengths {100 * abs(np.expm1(self.log_ratio)):.2f} % (+- {100 * self.sigma:.2f}) "
            f"{longer} than {first}: the scale of one of them is wrong (of a stereo pair, its baseline or focal length)"
        )


def rescaled(pairs: PosePairs, log_ratio: float) -> PosePairs:
    """Return the pose pairs with their second motions corrected for a ratio of lengths."""
    motion_2 = pairs.motion_2.copy()
    motion_2[:, :3, 3] *= np.exp(-log_ratio)
    return replace(pairs, motion_2=motion_2)
