"""Removal of false second motions, caused by tracks that jumped to the next repetition of a texture.

If the predicted motion is far off, neighbouring tracks may all be followed to a place that looks the same, such as the
next row of bricks. They then agree on a motion of their own, as the points of a moving object do. But unlike an
object's, their keyframe patches are also found where the motion of the other tracks predicts them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from graphvio.arrays import Float
from graphvio.frontend.pairs.agreement import Agreement, MotionHypothesis
from graphvio.frontend.thresholds import THRESHOLDS
from graphvio.frontend.tracking.tracker import GroupTracker
from graphvio.frontend.tracking_frontend import TrackedFrameset
from graphvio.geometry import se3_inverse


def without_lookalikes(
    agreement: Agreement, seen: TrackedFrameset, trackers: Sequence[GroupTracker], body_T_left: Float
) -> Agreement:
    """Leave out the motion hypotheses whose points are also seen where the first hypothesis predicts them.

    A hypothesis is kept if the first one's points are also seen where it predicts them: then either may be right.

    Args:
        agreement: the motion hypotheses of the frameset.
        seen: the tracks of the frameset.
        trackers: the trackers of all groups, at this frameset.
        body_T_left: (P, 4, 4) poses of the groups' left cameras in body.
    """
    best, *others = agreement.hypotheses

    def share(one: MotionHypothesis, other: MotionHypothesis) -> float:
        """Return the share of the points of ``one`` that are also seen where the motion of ``other`` predicts them."""
        there = 0
        for j, ids in seen.correspondences.identities(seen.frames, one.refined.inlier).items():
            left_T_left = se3_inverse(body_T_left[j]) @ other.refined.cur_T_ref @ body_T_left[j]
            there += int(trackers[j].are_also_at(seen.reference_stamp_ns, ids, left_T_left).sum())
        return there / max(one.support, 1)

    least = THRESHOLDS.agreement.min_lookalike_share
    kept = [each for each in others if share(each, best) < least or share(best, each) >= least]
    return replace(agreement, hypotheses=(best, *kept))
