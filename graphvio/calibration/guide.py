"""Tells a person who is recording what is known so far, which motions are still needed, and when it is enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.calibration import graph, paper_method
from graphvio.calibration.camera_motions import CameraMotions
from graphvio.calibration.pair_calibration import SEEN_FROM, allowance
from graphvio.calibration.pose_pairs import FEWEST, PosePairs
from graphvio.errors import CalibrationError

ENOUGH_DEG, ENOUGH_M, ENOUGH_MOTIONS = 0.05, 2e-3, 40
"""One standard deviation in the direction that is known least with which a recording is long enough, and how many
motions, each of a third of a second, there must be: from fewer, errors that last cannot be told from others."""

_SEGMENT_NS = 350_000_000
_BEGINNING = "turn the rig about two axes, one after the other, by 30 degrees and more, while you walk"


@dataclass(frozen=True)
class Advice:
    """What is known so far of the place that is known least.

    Attributes:
        name: of the pair.
        motions: that tell of it.
        rotation_sigma_deg: in the direction that is known least; infinite as long as nothing is known.
        translation_sigma_m: the same.
        turning_deg_s: (3,) rms turning about the principal axes, in descending order.
        missing: what to do, a sentence; empty if only more of the same is needed.
    """

    name: str
    motions: int
    rotation_sigma_deg: float
    translation_sigma_m: float
    turning_deg_s: tuple[float, float, float]
    missing: str

    @property
    def is_enough(self) -> bool:
        """Whether the recording may end."""
        known = self.rotation_sigma_deg <= ENOUGH_DEG and self.translation_sigma_m <= ENOUGH_M
        return known and not self.missing and self.motions >= ENOUGH_MOTIONS

    @property
    def text(self) -> str:
        """One line."""
        begin = "enough" if self.is_enough else self.missing or "go on like this"
        if not np.isfinite(self.rotation_sigma_deg):
            return f"{begin} ({self.motions} motions)"
        return (
            f"{begin} ({self.name}: +- {self.rotation_sigma_deg:.3f} degrees, "
            f"{_length(self.translation_sigma_m)}, {self.motions} motions)"
        )


class Guide:
    """Follows a recording.

    Args:
        names: of the pairs; where each of the others is relative to the first is asked for.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._told: list[list[tuple[int, int, Float, Float, Float, Float]]] = [[] for _ in names]
        self._place: list[Float | None] = [None] * len(self._names)
        self._until_ns: int | None = None

    def advise(self, motions: Sequence[CameraMotions]) -> Advice:
        """What to do next, from all that the pairs have told of their motions until now."""
        self._take(motions)
        advice = [self._advice(j) for j in range(1, len(self._names))]
        return max(advice, key=lambda each: (bool(each.missing), each.translation_sigma_m, each.rotation_sigma_deg))

    def _take(self, motions: Sequence[CameraMotions]) -> None:
        """Segments of some tenths of a second, one after the other, as they come in."""
        stamps = motions[0].stamps_ns
        if self._until_ns is None and len(stamps):
            self._until_ns = int(stamps[0])
        while self._until_ns is not None:
            index = int(np.searchsorted(stamps, self._until_ns + _SEGMENT_NS))
            if index >= len(stamps):
                return
            start_ns, end_ns = self._until_ns, int(stamps[index])
            first = motions[0].between(start_ns, end_ns)
            for j in range(1, len(motions)):
                other = motions[j].between(start_ns, end_ns)
                if first is not None and other is not None:
                    self._told[j].append((start_ns, end_ns, *first, *other))
            self._until_ns = end_ns

    def _advice(self, j: int) -> Advice:
        told = self._told[j]
        nothing = Advice(self._names[j], len(told), np.inf, np.inf, (0.0, 0.0, 0.0), _BEGINNING)
        if len(told) < FEWEST:
            return nothing
        start_ns, end_ns, *arrays = (np.array(column) for column in zip(*told, strict=True))
        pairs = PosePairs(start_ns.astype(np.int64), end_ns.astype(np.int64), *arrays)
        try:
            start = self._place[j]
            found = graph.solve(pairs, paper_method.calibrate(pairs).left2_T_left1 if start is None else start)
        except CalibrationError:
            self._place[j] = None
            return nothing
        observability = found.observability
        # A start that one axis told wrongly is not held on to.
        self._place[j] = found.left2_T_left1 if observability.is_complete else None
        covariance = found.covariance + allowance(found.left2_T_left1, SEEN_FROM)
        blocks = np.stack([covariance[:3, :3], covariance[3:, 3:]])
        rotation, translation = np.sqrt(np.linalg.eigvalsh(blocks)[:, -1])
        seconds = float(np.mean(pairs.end_ns - pairs.start_ns)) * 1e-9
        turning = tuple((np.rad2deg(observability.turning_rad) / seconds).tolist())
        missing = "; ".join(observability.missing)
        return Advice(self._names[j], len(told), float(np.rad2deg(rotation)), float(translation), turning, missing)


def _length(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm" if metres < 1.0 else "offset unknown"
