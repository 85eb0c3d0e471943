"""Quality of a measured motion: checks that enlarge its covariance and grade it as good or weak."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.thresholds import THRESHOLDS
from graphvio.geometry import se3_inverse, se3_log
from graphvio.measurements.motion import Quality, RelativeMotion

_T = THRESHOLDS.quality


class StereoShare(NamedTuple):
    """Share of the corners that are found in the right images, too.

    Attributes:
        share: Share of all corners; of each pair, the smaller one of reference and newest frame counts.
        baseline_m: Longest baseline of the pairs in view.
    """

    share: float
    baseline_m: float


def stereo_share(
    reference: Mapping[int, TrackedFrame], current: Mapping[int, TrackedFrame], baselines_m: Sequence[float]
) -> StereoShare:
    """Return the share for a frameset; pairs are weighted by their corners, even if the motion explains none."""
    pairs = sorted(reference.keys() & current.keys())
    corners = [len(current[j].ids) for j in pairs]
    shares = [min(_share(reference[j].has_depth), _share(current[j].has_depth)) for j in pairs]
    share = float(np.dot(shares, corners)) / max(sum(corners), 1)
    return StereoShare(share, max(baselines_m[j] for j in pairs))


def _share(found: Bool) -> float:
    return float(found.mean()) if len(found) else 0.0


class CheckedHypothesis(NamedTuple):
    """A motion hypothesis after its own checks.

    Attributes:
        motion: The motion, with a covariance that failed checks have enlarged.
        reasons: The failed checks, in words.
    """

    motion: RelativeMotion
    reasons: list[str]


def checked_hypothesis(
    motion: RelativeMotion, frozen_since_ns: int | None, stereo: StereoShare, noise: float
) -> CheckedHypothesis:
    """Enlarge the covariance for few points, blur, repeated images, and right images that do not match the left ones.

    Args:
        motion: Motion of one hypothesis, see `graphvio.frontend.pairs.agreement`.
        frozen_since_ns: Stamp since which all images are the same, or None.
        stereo: Share of the corners that are found in the right images.
        noise: Root mean square error of the points that the motion explains, over that of the modelled noise.
    """
    covariance, reasons = motion.covariance, []
    if noise > 1.0:
        # The residuals' mean square is in the covariance already. But motions from blurred images are worse than that:
        # their squared errors, over the covariance, become a few times larger on average.
        covariance = covariance * noise**2
        if noise > _T.max_blur:
            reasons.append(f"points fit {noise:.1f} times worse than those of sharp images")
    if motion.inliers < _T.min_points:
        lacking = (_T.min_points - motion.inliers) / _T.min_points
        covariance = covariance + np.diag((2.0 * lacking * _T.possible_speeds * motion.duration_s) ** 2)
        reasons.append(f"only {motion.inliers} points")
    if stereo.share < _T.min_stereo_share:
        # Swapped cables move a view by the baseline; the few corners that are then matched may be so by chance.
        sigmas = _T.possible_speeds * motion.duration_s + np.repeat([0.0, stereo.baseline_m], 3)
        covariance = covariance + np.diag(sigmas**2)
        reasons.append(f"only {100 * stereo.share:.0f} % of the corners are found in the right images")
    if frozen_since_ns is not None:
        elapsed_s = (motion.stamp_ns - frozen_since_ns) * 1e-9
        covariance = covariance + np.diag((_T.possible_speeds * elapsed_s) ** 2)
        reasons.append("every image repeats the one before")
    return CheckedHypothesis(replace(motion, covariance=covariance), reasons)


def motion_with_quality(
    hypotheses: Sequence[CheckedHypothesis], max_distance: float, *, has_length: bool = True
) -> tuple[RelativeMotion, Quality, str]:
    """Return the first hypothesis' motion, with a covariance that covers the others; its quality; and the reasons.

    Args:
        hypotheses: In the order of `graphvio.frontend.pairs.agreement.Agreement`.
        max_distance: Largest squared Mahalanobis distance between pairs that agree.
        has_length: Whether the first one's cameras can measure the length of a translation at all.
    """
    best, reasons = hypotheses[0].motion, list(hypotheses[0].reasons)
    covariance = best.covariance * max(1.0, max_distance / _T.max_usual_distance)
    for rival, _ in hypotheses[1:]:
        if rival.inliers >= _T.min_rival_share * best.inliers:
            apart = se3_log(se3_inverse(best.reference_T_current) @ rival.reference_T_current)
            angle, distance = np.linalg.norm(apart[:3]), np.linalg.norm(apart[3:])
            # In all directions: an object that fills one view may fill part of another, and then neither is right.
            covariance = covariance + rival.covariance + np.diag(np.repeat([angle, distance], 3) ** 2)
            reasons.append(f"two motions are seen, {distance:.3f} m and {np.rad2deg(angle):.2f} deg apart")
    motion = replace(best, covariance=covariance)
    rotation_rad, translation_m = motion.weakest_sigmas
    is_vague = rotation_rad > _T.max_rotation_sigma_rad or (has_length and translation_m > _T.max_translation_sigma_m)
    if is_vague and not reasons:
        reasons.append(f"hardly constrained: {rotation_rad:.4f} rad, {translation_m:.3f} m")
    return motion, Quality.WEAK if reasons else Quality.GOOD, "; ".join(reasons)
