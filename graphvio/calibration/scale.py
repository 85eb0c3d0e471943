"""Whether two pairs agree on lengths: one whose baseline is wrong by 1 % measures all motions 1 % too long or short."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from graphvio.arrays import Float
from graphvio.calibration.pose_pairs import PosePairs

ScaleMode = Literal["auto", "estimate", "fixed"]

_SIGNIFICANT = 4.0  # sigmas
_LEAST = 2e-3  # what a good calibration of a pair leaves
PRIOR_SIGMA = 0.1
"""Of the logarithm of the ratio, before anything is measured."""


@dataclass(frozen=True)
class ScaleCheck:
    """Ratio of the second camera's lengths to the first's.

    Attributes:
        log_ratio: natural logarithm, so 0.01 where the second measures 1 % longer.
        sigma: of it.
    """

    log_ratio: float
    sigma: float

    @property
    def is_wrong(self) -> bool:
        """Whether a baseline, or a focal length, is wrong beyond doubt and by more than calibrations leave."""
        return abs(self.log_ratio) > max(_SIGNIFICANT * self.sigma, _LEAST)

    def told(self, first: str, second: str) -> str:
        """A sentence."""
        longer = "longer" if self.log_ratio > 0.0 else "shorter"
        return (
            f"{second} measures lengths {100 * abs(np.expm1(self.log_ratio)):.2f} % (+- {100 * self.sigma:.2f}) "
            f"{longer} than {first}: the scale of one of them is wrong (of a stereo pair, its baseline or focal length)"
        )


def derivatives(pairs: PosePairs) -> Float:
    """Derivatives (N, 6, 1) of the pose pairs' errors by the logarithm of the ratio."""
    by_scale = np.zeros((len(pairs), 6, 1))
    by_scale[:, 3:, 0] = np.einsum("nji,nj->ni", pairs.motion_2[:, :3, :3], pairs.motion_2[:, :3, 3])
    return by_scale


def rescaled(pairs: PosePairs, log_ratio: float) -> PosePairs:
    """Pose pairs whose second motions are put right by a ratio."""
    motion_2 = pairs.motion_2.copy()
    motion_2[:, :3, 3] *= np.exp(-log_ratio)
    return replace(pairs, motion_2=motion_2)
