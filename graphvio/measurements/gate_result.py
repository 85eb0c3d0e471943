"""The outcome of an innovation test."""

from __future__ import annotations

from dataclasses import dataclass

from graphvio.arrays import Float

_UNCLEAR = (0.5, 2.0)  # statistic over threshold


@dataclass(frozen=True, eq=False)
class GateResult:
    """Outcome of a gate.

    Attributes:
        accepted: whether the measurement may be used.
        statistic: squared Mahalanobis distance of the innovation.
        threshold: the largest that is accepted.
        innovation: (M,) what was measured, less what was expected.
        covariance: (M, M) of it.
    """

    accepted: bool
    statistic: float
    threshold: float
    innovation: Float
    covariance: Float

    @property
    def is_clear(self) -> bool:
        """Whether the outcome is not a matter of a small difference."""
        return not _UNCLEAR[0] < self.statistic / self.threshold < _UNCLEAR[1]
