"""What the front-end says of a frameset: a measured motion, how far it can be trusted, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from graphvio.arrays import Float, Int


class Quality(StrEnum):
    """How far a measured motion can be trusted."""

    GOOD = "good"
    """Its covariance says all there is to say."""
    WEAK = "weak"
    """Pairs contradict each other, points are few, or a direction is hardly constrained; its covariance says so."""
    FAILED = "failed"
    """There is no motion."""


@dataclass(frozen=True, slots=True, eq=False)
class PairReport:
    """What one stereo pair contributed to a frameset.

    Attributes:
        points: points offered to the estimation.
        inliers: points that the chosen motion explains.
        pixels: (N, 2) left-image pixels of the tracked corners, for display.
        is_inlier: (N,) whether each of them is explained.
        ages: (N,) number of earlier frames that saw each of them.
        rejected: test of tracking or stereo matching -> how many corners it threw out.
        rms_px: rms reprojection error of these under the chosen motion, per direction and without the share of the
            points' own uncertainty; None where there are none.
        own_inliers: points that the pair's own motion explains, or None where there is but one pair or too few points.
        own_rms_px: their rms error under it, or None; much less than ``rms_px`` tells of a transfer between pairs that
            is wrong.
    """

    points: int
    inliers: int
    pixels: Float
    is_inlier: np.ndarray[tuple[int], np.dtype[np.bool_]]
    ages: Int | None = None
    rejected: Mapping[str, int] = field(default_factory=dict)
    rms_px: float | None = None
    own_inliers: int | None = None
    own_rms_px: float | None = None


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """A measured motion of the rig.

    Attributes:
        reference_stamp_ns: the earlier instant.
        stamp_ns: the later one.
        reference_T_current: (4, 4) of body: the motion that a between factor takes.
        covariance: (6, 6), tangent ``[rotation, translation]`` in the body frame of the later instant.
        shared_covariance: (6, 6) the part of it that all motions from this reference have in common, same tangent.
        inliers: number of points that it explains.
    """

    reference_stamp_ns: int
    stamp_ns: int
    reference_T_current: Float
    covariance: Float
    shared_covariance: Float
    inliers: int

    @property
    def duration_s(self) -> float:
        """Time between the two instants."""
        return (self.stamp_ns - self.reference_stamp_ns) * 1e-9

    @property
    def weakest_sigmas(self) -> tuple[float, float]:
        """Standard deviations in the directions that are known least: of the rotation, radians, and the translation,
        metres."""
        blocks = np.stack([self.covariance[:3, :3], self.covariance[3:, 3:]])
        rotation, translation = np.sqrt(np.linalg.eigvalsh(blocks)[:, -1])
        return float(rotation), float(translation)


@dataclass(frozen=True, eq=False)
class VisualResult:
    """What the front-end made of one frameset.

    Attributes:
        motion: the measured motion, or None.
        quality: how far the motion can be trusted.
        reason: why it is not good, or empty.
        alternatives: where pairs contradict each other, what each side says with its own covariance: one is right.
        own: at the end of a keyframe, pair -> its own motion of body, as the rig file's place of the pair makes it.
        is_stationary: the images have shown no motion for a while.
        frozen: pairs that were left out because a camera of theirs repeats an image.
        pairs: pair index -> report.
        stage_ms: time by stage, milliseconds: ``track``, with all pairs side by side; its parts ``pyramid``,
            ``register``, ``flow`` and ``stereo``, each of the pair that took longest; then ``motion``, ``quality``, and
            ``replenish``, which is next to nothing unless the reference changes.
    """

    motion: RelativeMotion | None
    quality: Quality
    reason: str
    pairs: Mapping[int, PairReport]
    alternatives: tuple[RelativeMotion, ...] = ()
    own: Mapping[int, RelativeMotion] = field(default_factory=dict)
    is_stationary: bool = False
    frozen: frozenset[int] = frozenset()
    stage_ms: Mapping[str, float] = field(default_factory=dict)
