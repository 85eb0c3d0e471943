"""Advice while recording: the accuracy so far, which motions are still needed, and when it is enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.calibration import graph, paper_method
from graphvio.calibration.camera_motions import CameraMotions
from graphvio.calibration.pair_calibration import SYSTEMATIC_POSE_COVARIANCE, systematic_covariance
from graphvio.calibration.pose_pairs import MIN_PAIRS, PosePairs
from graphvio.errors import CalibrationError

ENOUGH_DEG, ENOUGH_M, ENOUGH_MOTIONS = 0.05, 2e-3, 40
"""Largest standard deviations and smallest number of motions, each of a third of a second, for a recording that is long
enough; from fewer motions, errors that neighbouring motions share cannot be detected."""

_SEGMENT_NS = 350_000_000
_INITIAL_ADVICE = "turn the rig about two axes, one after the other, by 30 degrees and more, while you walk"


@dataclass(frozen=True)
class Advice:
    """The accuracy so far of the pair whose pose is least accurate, and what is needed to improve it."""

    name: str  # name of the pair
    motions: int  # number of its motions
    rotation_sigma_deg: float  # largest over all directions; infinite without a solution
    translation_sigma_m: float  # largest over all directions; infinite without a solution
    missing: str  # a sentence on what to do; empty if more motions of the same kind suffice

    @property
    def is_enough(self) -> bool:
        """Whether the recording may end."""
        known = self.rotation_sigma_deg <= ENOUGH_DEG and self.translation_sigma_m <= ENOUGH_M
        return known and not self.missing and self.motions >= ENOUGH_MOTIONS

    @property
    def text(self) -> str:
        """The advice in one line."""
        begin = "enough" if self.is_enough else self.missing or "go on like this"
        if not np.isfinite(self.rotation_sigma_deg):
            return f"{begin} ({self.motions} motions)"
        sigma_m = self.translation_sigma_m
        offset = f"{1e3 * sigma_m:.1f} mm" if sigma_m < 1.0 else "offset unknown"
        return f"{begin} ({self.name}: +- {self.rotation_sigma_deg:.3f} degrees, {offset}, {self.motions} motions)"


class Guide:
    """Gives advice during a recording on the pose of each pair relative to the first; takes the pairs' names."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._segments: list[list[tuple[int, int, Float, Float, Float, Float]]] = [[] for _ in names]
        self._left_T_left1: list[Float | None] = [None] * len(self._names)
        self._until_ns: int | None = None

    def advise(self, motions: Sequence[CameraMotions]) -> Advice:
        """Return advice on what to do next, from all motions that each pair has measured up to now."""
        self._take(motions)
        advice = [self._advice(j) for j in range(1, len(self._names))]
        return max(advice, key=lambda each: (bool(each.missing), each.translation_sigma_m, each.rotation_sigma_deg))

    def _take(self, motions: Sequence[CameraMotions]) -> None:
        """Append new segments of some tenths of a second, one after the other."""
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
                    self._segments[j].append((start_ns, end_ns, *first, *other))
            self._until_ns = end_ns

    def _advice(self, j: int) -> Advice:
        segments = self._segments[j]
        nothing = Advice(self._names[j], len(segments), np.inf, np.inf, _INITIAL_ADVICE)
        if len(segments) < MIN_PAIRS:
            return nothing
        start_ns, end_ns, *arrays = (np.array(column) for column in zip(*segments, strict=True))
        pairs = PosePairs(start_ns.astype(np.int64), end_ns.astype(np.int64), *arrays)
        try:
            start = self._left_T_left1[j]
            found = graph.solve(pairs, paper_method.calibrate(pairs).left2_T_left1 if start is None else start)
        except CalibrationError:
            self._left_T_left1[j] = None
            return nothing
        observability = found.observability
        # A solution from rotation about one axis may be wrong, and is no start for the next.
        self._left_T_left1[j] = found.left2_T_left1 if observability.is_complete else None
        covariance = found.covariance + systematic_covariance(found.left2_T_left1, SYSTEMATIC_POSE_COVARIANCE)
        blocks = np.stack([covariance[:3, :3], covariance[3:, 3:]])
        rotation, translation = np.sqrt(np.linalg.eigvalsh(blocks)[:, -1])
        missing = "; ".join(observability.missing)
        return Advice(self._names[j], len(segments), float(np.rad2deg(rotation)), float(translation), missing)
