"""How far a measured motion can be trusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool
from graphvio.frontend.tracks import PairFrame
from graphvio.geometry import se3_inverse, se3_log
from graphvio.measurements.motion import Quality, RelativeMotion

_RIVAL_SHARE = 0.1  # of the best-supported side's points: from there on another side may be the right one
_FEW_POINTS = 25  # fewer may agree by chance
_USUAL_TENSION = 12.0  # beyond it the covariance grows in proportion: something small is wrong with one of the pairs
_CONFIRMED = 0.12  # share of the corners that the right images must show, too; real ones show 16 % and more
_BLURRED = 2.0  # pixel noise over the modelled one, beyond which a motion is weak
_WEAK_ROTATION_RAD = 0.02
_WEAK_TRANSLATION_M = 0.05
_POSSIBLE_SPEEDS = np.repeat([0.5, 1.0], 3)  # rad/s and m/s that a rig may have where images say next to nothing


class StereoShare(NamedTuple):
    """How far the right images confirm what the left ones see.

    Attributes:
        share: of all corners, those found in the right image: the smaller one of reference and newest frame.
        baseline_m: the longest baseline of the pairs in view.
    """

    share: float
    baseline_m: float


def stereo_share(
    reference: Mapping[int, PairFrame], current: Mapping[int, PairFrame], baselines_m: Sequence[float]
) -> StereoShare:
    """`StereoShare` of a frameset. A pair counts by its corners, also if the motion explains none of them."""
    pairs = sorted(reference.keys() & current.keys())
    corners = [len(current[j].ids) for j in pairs]
    shares = [min(_share(reference[j].has_depth), _share(current[j].has_depth)) for j in pairs]
    share = float(np.dot(shares, corners)) / max(sum(corners), 1)
    return StereoShare(share, max(baselines_m[j] for j in pairs))


def _share(found: Bool) -> float:
    return float(found.mean()) if len(found) else 0.0


class Doubted(NamedTuple):
    """What one side says of the rig's motion.

    Attributes:
        motion: with a covariance that allows for what speaks against it.
        reasons: what that is, in words.
    """

    motion: RelativeMotion
    reasons: list[str]


def doubted(motion: RelativeMotion, frozen_since_ns: int | None, stereo: StereoShare, noise: float) -> Doubted:
    """Allow for few points, blur, images that repeat, and right images that do not confirm the left ones.

    Args:
        motion: of one side, see `graphvio.frontend.agreement`.
        frozen_since_ns: stamp since which all images are the same, or None.
        stereo: how far the right images confirm what the left ones see.
        noise: root mean square error of the points that the motion explains, over that of the modelled noise.
    """
    covariance, reasons = motion.covariance, []
    if noise > 1.0:
        # The residuals' mean square is in the covariance already. But motions from images that are blurred are worse
        # than that: the mean of their squared errors over it becomes a few times larger.
        covariance = covariance * noise**2
        if noise > _BLURRED:
            reasons.append(f"points fit {noise:.1f} times worse than those of sharp images")
    if motion.inliers < _FEW_POINTS:
        lacking = (_FEW_POINTS - motion.inliers) / _FEW_POINTS
        covariance = covariance + np.diag((2.0 * lacking * _POSSIBLE_SPEEDS * motion.duration_s) ** 2)
        reasons.append(f"only {motion.inliers} points")
    if stereo.share < _CONFIRMED:
        # Cables that are swapped move a view by the baseline; what little is matched then may repeat by chance.
        sigmas = _POSSIBLE_SPEEDS * motion.duration_s + np.repeat([0.0, stereo.baseline_m], 3)
        covariance = covariance + np.diag(sigmas**2)
        reasons.append(f"only {100 * stereo.share:.0f} % of the corners are found in the right images")
    if frozen_since_ns is not None:
        elapsed_s = (motion.stamp_ns - frozen_since_ns) * 1e-9
        covariance = covariance + np.diag((_POSSIBLE_SPEEDS * elapsed_s) ** 2)
        reasons.append("every image repeats the one before")
    return Doubted(replace(motion, covariance=covariance), reasons)


def graded(sides: Sequence[Doubted], tension: float) -> tuple[RelativeMotion, Quality, str]:
    """The first side's motion, with a covariance that covers the others, its quality, and why.

    Args:
        sides: in the order of `graphvio.frontend.agreement.Agreement`.
        tension: squared Mahalanobis distance between pairs that are thought to agree.
    """
    best, reasons = sides[0].motion, list(sides[0].reasons)
    covariance = best.covariance * max(1.0, tension / _USUAL_TENSION)
    for rival, _ in sides[1:]:
        if rival.inliers >= _RIVAL_SHARE * best.inliers:
            apart = se3_log(se3_inverse(best.reference_T_current) @ rival.reference_T_current)
            angle, distance = np.linalg.norm(apart[:3]), np.linalg.norm(apart[3:])
            # In all directions: what fills one view may fill part of the other, and then neither is right.
            covariance = covariance + rival.covariance + np.diag(np.repeat([angle, distance], 3) ** 2)
            reasons.append(f"two motions are seen, {distance:.3f} m and {np.rad2deg(angle):.2f} deg apart")
    motion = replace(best, covariance=covariance)
    rotation_rad, translation_m = motion.weakest_sigmas
    if not reasons and (rotation_rad > _WEAK_ROTATION_RAD or translation_m > _WEAK_TRANSLATION_M):
        reasons.append(f"hardly constrained: {rotation_rad:.4f} rad, {translation_m:.3f} m")
    return motion, Quality.WEAK if reasons else Quality.GOOD, "; ".join(reasons)
