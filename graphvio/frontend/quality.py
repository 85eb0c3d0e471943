"""How far a measured motion can be trusted, and standing still."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.events import Quality
from graphvio.frontend.motion import RelativeMotion
from graphvio.frontend.observations import Correspondences
from graphvio.frontend.tracks import PairFrame
from graphvio.geometry import se3_inverse, se3_log

_RIVAL_SHARE = 0.1  # of the best-supported side's points: from there on another side may be the right one
_FEW_POINTS = 25  # fewer may agree by chance
_USUAL_TENSION = 12.0  # beyond it the covariance grows in proportion: something small is wrong with one of the pairs
_CONFIRMED = 0.12  # share of the corners that the right images must show, too; real ones show 16 % and more
_WEAK_ROTATION_RAD = 0.02
_WEAK_TRANSLATION_M = 0.05
_POSSIBLE_SPEEDS = np.repeat([0.5, 1.0], 3)  # rad/s and m/s that a rig may have where images say next to nothing
_REST_MEDIAN_PX = 0.15
_REST_MOST_PX = 0.5


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
    share = float(np.average(shares, weights=corners)) if sum(corners) else 0.0
    return StereoShare(share, max(baselines_m[j] for j in pairs))


def _share(found: Bool) -> float:
    return float(found.mean()) if len(found) else 0.0


def graded(
    motions: Sequence[RelativeMotion], tension: float, frozen_since_ns: int | None, stereo: StereoShare
) -> tuple[RelativeMotion, Quality, str]:
    """The first motion, with a covariance that allows for what speaks against it, its quality, and why.

    Args:
        motions: of each side, as `graphvio.frontend.agreement.Agreement` has them in order.
        tension: squared Mahalanobis distance between pairs that are thought to agree.
        frozen_since_ns: stamp since which all images are the same, or None.
        stereo: how far the right images confirm what the left ones see.
    """
    best = motions[0]
    covariance, reasons = best.covariance * max(1.0, tension / _USUAL_TENSION), []
    for rival in motions[1:]:
        if rival.inliers >= _RIVAL_SHARE * best.inliers:
            apart = se3_log(se3_inverse(best.reference_T_current) @ rival.reference_T_current)
            angle, distance = np.linalg.norm(apart[:3]), np.linalg.norm(apart[3:])
            # In all directions: what fills one view may fill part of the other, and then neither is right.
            covariance = covariance + rival.covariance + np.diag(np.repeat([angle, distance], 3) ** 2)
            reasons.append(f"two motions are seen, {distance:.3f} m and {np.rad2deg(angle):.2f} deg apart")
    if best.inliers < _FEW_POINTS:
        lacking = (_FEW_POINTS - best.inliers) / _FEW_POINTS
        covariance = covariance + np.diag((2.0 * lacking * _POSSIBLE_SPEEDS * best.duration_s) ** 2)
        reasons.append(f"only {best.inliers} points")
    if stereo.share < _CONFIRMED:
        # Cables that are swapped move a view by the baseline; what little is matched then may repeat by chance.
        sigmas = _POSSIBLE_SPEEDS * best.duration_s + np.repeat([0.0, stereo.baseline_m], 3)
        covariance = covariance + np.diag(sigmas**2)
        reasons.append(f"only {100 * stereo.share:.0f} % of the corners are found in the right images")
    sigmas = np.sqrt([np.linalg.eigvalsh(covariance[block, block])[-1] for block in (slice(0, 3), slice(3, 6))])
    if frozen_since_ns is not None:
        elapsed_s = (best.stamp_ns - frozen_since_ns) * 1e-9
        covariance = covariance + np.diag((_POSSIBLE_SPEEDS * elapsed_s) ** 2)
        reasons.append("every image repeats the one before")
    elif not reasons and (sigmas[0] > _WEAK_ROTATION_RAD or sigmas[1] > _WEAK_TRANSLATION_M):
        reasons.append(f"hardly constrained: {sigmas[0]:.4f} rad, {sigmas[1]:.3f} m")
    quality = Quality.WEAK if reasons else Quality.GOOD
    return replace(best, covariance=covariance), quality, "; ".join(reasons)


def at_rest(
    reference: Mapping[int, PairFrame],
    current: Mapping[int, PairFrame],
    correspondences: Correspondences,
    inlier: Bool,
) -> bool:
    """Whether no right point (of N) has moved in the left images since the reference."""
    moved: list[Float] = []
    for j, rows in correspondences.rows.items():
        rows = rows[inlier[correspondences.observations.pair == j]]
        at_reference = np.searchsorted(reference[j].ids, current[j].ids[rows])
        shift = current[j].pixels[rows] - reference[j].pixels[at_reference]
        moved.append(np.hypot(shift[:, 0], shift[:, 1]))
        if len(rows) and np.median(moved[-1]) > _REST_MOST_PX:
            return False  # as nearly always: no need to look at the other pairs
    distance = np.concatenate(moved)
    if len(distance) < _FEW_POINTS:
        return False
    return bool(np.median(distance) < _REST_MEDIAN_PX and np.quantile(distance, 0.9) < _REST_MOST_PX)
