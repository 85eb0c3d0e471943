"""Second motions that are none: tracks that were followed to what looks the same, such as the next row of bricks.

Where the predicted motion is far off, neighbouring tracks are all followed to the next repetition of a texture. They
then agree on a motion of their own, as the points of an object that moves do. But their patches are also where the
motion of the others has them, which an object's are not.
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
    """Leave out the hypotheses whose points are where the first one has them, too.

    Unless its own points are also where they have them: then either may be right.

    Args:
        agreement: of the frameset's motion.
        seen: the frameset.
        trackers: of all groups, at this frameset.
        body_T_left: (P, 4, 4) of their left cameras.
    """
    best, *others = agreement.hypotheses

    def share(one: MotionHypothesis, other: MotionHypothesis) -> float:
        """Return the share of one's points that are where the other has them, too."""
        there = 0
        for j, ids in seen.correspondences.identities(seen.frames, one.refined.inlier).items():
            left_T_left = se3_inverse(body_T_left[j]) @ other.refined.cur_T_ref @ body_T_left[j]
            there += int(trackers[j].are_also_at(seen.reference_stamp_ns, ids, left_T_left).sum())
        return there / max(one.support, 1)

    least = THRESHOLDS.agreement.min_lookalike_share
    kept = [each for each in others if share(each, best) < least or share(best, each) >= least]
    return replace(agreement, hypotheses=(best, *kept))
