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
    """When pairs agree on one motion, and when a second one is searched for (`graphvio.frontend.pairs.agreement`).

    Attributes:
        max_distance: Largest squared Mahalanobis distance of motions that agree; normal errors exceed it once in 2
            million cases.
        max_distance_in_doubt: The same shortly after the pairs contradicted each other; normal errors exceed it once in
            20 cases.
        doubt_ns: Time after a contradiction during which ``max_distance_in_doubt`` applies.
        max_searched_share: Share of a pair's points that the joint motion explains; below it, the pair's own motion is
            searched by RANSAC.
        min_joint_share: Share of a pair's points that the joint motion explains; from it on, the pair's own motion is
            refined from the joint one with its inliers.
        min_rival_points: Smallest number of points of a second motion.
        min_unlike_px: Smallest error, under the other motions, of a point that may belong to a second one; smaller
            errors may come from a lens that is not exactly known.
        min_unexplained_share: Share of all points that no motion explains, from which on a second one is searched for.
        min_rival_share: Share of the unexplained points that the second motion has to explain.
        min_comparable_support: Support, as a share of the best, from which on hypotheses are ordered by their pairs'
            indices instead of their support.
        min_lookalike_share: Share of a second motion's points that are also seen where the first one predicts them,
            from which on the second motion is taken for a false one.
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
        min_rival_share: Support of another hypothesis, as a share of the first one's, from which on the covariance has
            to cover it.
        min_points: Number of points below which the covariance grows, since so few may agree by chance.
        max_usual_distance: Squared Mahalanobis distance between agreeing pairs beyond which the covariance grows.
        min_stereo_share: Smallest share of the corners that have to be found in the right images; real image pairs
            reach 16 % and more.
        max_blur: Pixel noise over the modelled one, beyond which a motion is weak.
        max_rotation_sigma_rad: Standard deviation of the rotation in its weakest direction, beyond which a motion is
            weak.
        max_translation_sigma_m: The same for the translation.
        possible_speeds: (6,) rad/s and m/s, speeds that a rig may have where images show next to nothing of its motion.
        max_excess_speed_m_s: By how much a motion measured by single cameras alone may be faster than predicted.
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
        min_points: Smallest number of points that the motion explains; with fewer, the reference is replaced.
        min_near_share: Smallest share of the near points that are still in view, as a factor of the configured
            ``keyframe_overlap``.
        min_pair_share: Smallest share of a pair's tracks with depth that are usable points, as a factor of the
            configured ``keyframe_overlap``.
        max_absence_ns: A pair without images for longer loses its tracks and its reference.
    """

    min_points: int = 20
    min_near_share: float = 0.5
    min_pair_share: float = 0.5
    max_absence_ns: int = 1_000_000_000


@dataclass(frozen=True)
class ExtrinsicThresholds:
    """When the extrinsics between two pairs are taken to be wrong (`graphvio.frontend.pairs.extrinsic_monitor`).

    Attributes:
        max_motions: Number of motions over whole keyframes that are kept, the newest ones.
        min_motions: Smallest number of motions from which an error is estimated.
        iterations: Number of Gauss-Newton iterations.
        cauchy_scale: Squared scale of the robust cost of a motion's squared Mahalanobis distance.
        max_outlier_share: Largest share of outliers among the motions; with more, there is no common error.
        prior_sigmas: (6,) rad and m, of a prior on the error; it matters only in directions that no motion constrains.
        max_chance_distance: Chi-square that exact extrinsics exceed once in 10^9 cases.
        max_vague_share: Standard deviation of an angle or distance, as a share of it, up to which it is reported.
        max_fine_rad: Standard deviation of an angle up to which it is reported in any case.
        max_fine_m: Standard deviation of a distance up to which it is reported in any case.
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
        max_median_px: Movement that more than half of the points have to stay below.
        max_moved_px: Movement below which a point counts as unmoved.
        min_unmoved_share: Smallest share of unmoved points.
        min_points: Smallest number of points from which a standstill is detected.
        min_duration_s: Shortest time that this has to last, since a slow motion does not show at once.
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
