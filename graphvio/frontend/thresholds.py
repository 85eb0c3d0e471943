"""Thresholds of the front-end's decisions.

They follow from statistics, or from what was measured on many recordings; none is tuned to a data set, and none is part
of the configuration. Squared Mahalanobis distances between motions have 6 degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri


@dataclass(frozen=True)
class AgreementThresholds:
    """When pairs agree on one motion, and when a second one is looked for (`graphvio.frontend.pairs.agreement`).

    Attributes:
        max_distance: Squared Mahalanobis distance of motions that agree: normal errors exceed it once in 2 million.
        max_distance_in_doubt: The same while the pairs contradicted each other a moment ago: once in 20.
        doubt_ns: Time after a contradiction during which that holds.
        max_searched_share: Share of a pair's points that the joint motion explains, below which it searches its own.
        min_joint_share: From this share on, its own motion is refined from the joint one and its inliers.
        min_rival_points: Points of a second motion.
        min_unlike_px: Error of a point that may belong to it; less is a lens that is not quite known.
        min_unexplained_share: Share of all points that are unexplained, from which on a second motion is looked for.
        min_rival_share: Share of these that it has to explain.
        min_comparable_support: Support, as a share of the best, from which on support alone does not decide.
        min_lookalike_share: Share of points that are where another motion has them, too, of a motion that is none.
    """

    max_distance: float = 40.0
    max_distance_in_doubt: float = 12.6
    doubt_ns: int = 1_000_000_000
    max_searched_share: float = 0.5
    min_joint_share: float = 0.9
    min_rival_points: int = 12
    min_unlike_px: float = 1.0
    min_unexplained_share: float = 0.12
    min_rival_share: float = 0.5
    min_comparable_support: float = 0.85
    min_lookalike_share: float = 0.5


@dataclass(frozen=True)
class QualityThresholds:
    """When a motion is weak, and by how much its covariance grows (`graphvio.frontend.motion.quality`).

    Attributes:
        min_rival_share: Support of another hypothesis, as a share of the first, that makes it a possible one.
        min_points: Fewer points may agree by chance.
        max_usual_distance: Squared Mahalanobis distance between agreeing pairs beyond which the covariance grows.
        min_stereo_share: Share of the corners that the right images must show as well; real ones show 16 % and more.
        max_blur: Pixel noise over the modelled one, beyond which a motion is weak.
        max_rotation_sigma_rad: Standard deviation in the weakest direction beyond which a motion is weak.
        max_translation_sigma_m: The same of the translation.
        possible_speeds: (6,) rad/s and m/s that a rig may have where images say next to nothing.
        max_excess_speed_m_s: By how much faster than predicted a motion by single cameras alone may be.
    """

    min_rival_share: float = 0.1
    min_points: int = 25
    max_usual_distance: float = 12.0
    min_stereo_share: float = 0.12
    max_blur: float = 2.0
    max_rotation_sigma_rad: float = 0.02
    max_translation_sigma_m: float = 0.05
    possible_speeds: np.ndarray[tuple[int], np.dtype[np.float64]] = field(
        default_factory=lambda: np.repeat([0.5, 1.0], 3)
    )
    max_excess_speed_m_s: float = 0.1


@dataclass(frozen=True)
class ReferenceThresholds:
    """When later motions are measured from a new frameset (`graphvio.frontend.references`).

    Attributes:
        min_points: Points that the motion explains.
        min_near_share: Share, of the configured overlap, of the near points that have to be still in view.
        min_pair_share: Share, of the configured overlap, of a pair's tracks with depth that have to be usable points.
        max_absence_ns: A pair that was absent for longer is tracked from scratch.
    """

    min_points: int = 20
    min_near_share: float = 0.5
    min_pair_share: float = 0.5
    max_absence_ns: int = 1_000_000_000


@dataclass(frozen=True)
class ExtrinsicThresholds:
    """When the extrinsics between two pairs are taken to be wrong (`graphvio.frontend.pairs.extrinsic_monitor`).

    Attributes:
        max_motions: Motions over whole keyframes that are kept.
        min_motions: Fewer do not decide.
        iterations: Of Gauss-Newton.
        cauchy_scale: Squared scale of the robust cost of a motion's squared Mahalanobis distance.
        max_outlier_share: Of the motions; with more, there is no common error.
        prior_sigmas: (6,) rad and m: decides only in directions that no motion shows.
        max_chance_distance: Chi-square that a right transform exceeds once in 10^9.
        max_vague_share: A size is reported where its standard deviation is at most this share of it.
        max_fine_rad: Or, of an angle, where it is at most this.
        max_fine_m: Or, of a distance, where it is at most this.
    """

    max_motions: int = 100
    min_motions: int = 6
    iterations: int = 8
    cauchy_scale: float = 9.0
    max_outlier_share: float = 0.3
    prior_sigmas: np.ndarray[tuple[int], np.dtype[np.float64]] = field(default_factory=lambda: np.repeat([0.1, 0.2], 3))
    max_chance_distance: float = float(chdtri(6, 1e-9))
    max_vague_share: float = 0.25
    max_fine_rad: float = float(np.deg2rad(0.2))
    max_fine_m: float = 0.01


@dataclass(frozen=True)
class StandstillThresholds:
    """When images show a standstill (`graphvio.frontend.tracking.standstill`).

    Attributes:
        max_median_px: Half of the points have not moved by more.
        max_moved_px: Largest movement of a point that counts as unmoved.
        min_unmoved_share: Share of the points that have to be unmoved.
        min_points: Fewer do not decide.
        min_duration_s: A slow motion does not show at once.
    """

    max_median_px: float = 0.15
    max_moved_px: float = 0.5
    min_unmoved_share: float = 0.9
    min_points: int = 25
    min_duration_s: float = 0.25


@dataclass(frozen=True)
class DecisionThresholds:
    """All thresholds, a group for each decision."""

    agreement: AgreementThresholds = field(default_factory=AgreementThresholds)
    quality: QualityThresholds = field(default_factory=QualityThresholds)
    reference: ReferenceThresholds = field(default_factory=ReferenceThresholds)
    extrinsics: ExtrinsicThresholds = field(default_factory=ExtrinsicThresholds)
    standstill: StandstillThresholds = field(default_factory=StandstillThresholds)


THRESHOLDS = DecisionThresholds()
