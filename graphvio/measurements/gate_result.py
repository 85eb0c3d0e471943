"""The outcome of an innovation test."""

from __future__ import annotations

from dataclasses import dataclass

from graphvio.arrays import Float

_UNCLEAR_RATIO = (0.5, 2.0)  # statistic over threshold


@dataclass(frozen=True, eq=False)
class GateResult:
    """Outcome of an innovation test.

    Attributes:
        accepted: Whether the measurement passed.
        statistic: Squared Mahalanobis distance of the innovation.
        threshold: Largest statistic that passes.
        innovation: (M,) measurement less its prediction.
        covariance: (M, M) covariance of the innovation.
    """

    accepted: bool
    statistic: float
    threshold: float
    innovation: Float
    covariance: Float

    @property
    def is_clear(self) -> bool:
        """Whether the statistic is far from the threshold."""
        return not _UNCLEAR_RATIO[0] < self.statistic / self.threshold < _UNCLEAR_RATIO[1]

    @property
    def exceedance(self) -> str:
        """Reason why the measurement was refused, for the detail of an event."""
        return f"innovation {self.statistic:.1f} beyond chi-square {self.threshold:.1f}"
