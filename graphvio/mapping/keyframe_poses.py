"""Where all keyframes are, once it is known where the places are."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.mapping.places import Anchored
from graphvio.trajectory import Trajectory


def spread_keyframes(
    keyframes: Sequence[Anchored], poses: Sequence[Float | None], motions: Sequence[Float], begins: Collection[int]
) -> Trajectory:
    """The odometry's chain from place to place is kept, and what it differs by at the next place shared out by time.

    Args:
        keyframes: in the order of time.
        poses: (4, 4) of the places, as far as they are worked on; None of those that are not in the map.
        motions: (4, 4) by the odometry from the place before to each place.
        begins: places that have none before.
    """
    stamp_of: dict[int, int] = {}
    for each in keyframes:
        stamp_of.setdefault(each.place, each.stamp_ns)
    errors: dict[int, Float] = {}
    stamps: list[int] = []
    made: list[Float] = []
    for each in keyframes:
        k = each.place
        pose = poses[k] if k < len(poses) else None
        if pose is None or (stamps and each.stamp_ns <= stamps[-1]):
            continue
        after = poses[k + 1] if k + 1 < len(poses) and k + 1 not in begins else None
        share = np.zeros(6)
        if after is not None:
            if k not in errors:
                errors[k] = se3_log(se3_inverse(motions[k + 1]) @ se3_inverse(pose) @ after)
            share = errors[k] * (each.stamp_ns - stamp_of[k]) / (stamp_of[k + 1] - stamp_of[k])
        stamps.append(each.stamp_ns)
        made.append(pose @ each.place_T_body @ se3_exp(share))
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(made).reshape(-1, 4, 4))
