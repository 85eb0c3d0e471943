"""The framesets that motion is measured from: the previous one, or keyframes that stay while enough is in view."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from graphvio.arrays import Int
from graphvio.config.stages import MotionConfig
from graphvio.frontend.observations import Correspondences
from graphvio.frontend.refinement import Refined
from graphvio.frontend.tracks import PairFrame, common_rows

_FEWEST_POINTS = 20


class References:
    """Each pair's reference frame, and whether it still serves."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._frames: dict[int, PairFrame] = {}

    @property
    def stamps_ns(self) -> frozenset[int]:
        """Stamps of the framesets that later motions will be measured from."""
        return frozenset(frame.stamp_ns for frame in self._frames.values())

    def of(self, pair: int) -> PairFrame | None:
        """A pair's reference frame, or None."""
        return self._frames.get(pair)

    def replace(self, frames: Mapping[int, PairFrame]) -> None:
        """These frames are their pairs' references from here on."""
        self._frames.update(frames)

    def clear(self) -> None:
        """Forget all."""
        self._frames.clear()

    def forget(self, pair: int) -> None:
        """Forget a pair's reference."""
        self._frames.pop(pair, None)

    def shared(self, frames: Mapping[int, PairFrame]) -> dict[int, PairFrame]:
        """Reference frames of one instant: of several, those with most tracks in view."""
        groups: dict[int, dict[int, PairFrame]] = {}
        for j in frames:
            if j in self._frames:
                groups.setdefault(self._frames[j].stamp_ns, {})[j] = self._frames[j]
        if len(groups) < 2:
            return next(iter(groups.values()), {})

        def in_view(stamp_ns: int) -> int:
            return sum(len(common_rows(frame.ids, frames[j].ids)[0]) for j, frame in groups[stamp_ns].items())

        return groups[max(groups, key=lambda stamp_ns: (in_view(stamp_ns), stamp_ns))]

    def are_spent(
        self, frames: Mapping[int, PairFrame], correspondences: Correspondences, refined: Refined, contradicted: bool
    ) -> bool:
        """Whether the next motions had better be measured from these frames.

        A pair that the motion does not explain at all, such as one with a crowd in front of it, does not end the
        keyframe of the others.

        Args:
            frames: the newest of each pair.
            correspondences: of them with the references.
            refined: the motion.
            contradicted: whether more than one motion is seen. Who is right is soonest told by many short motions.
        """
        if self._config.reference == "previous":
            return True
        if contradicted:
            return True
        if any(j not in correspondences.rows for j in frames):
            return True  # a pair that came back takes part again from the next frameset on
        pair, overlap = correspondences.observations.pair, self._config.keyframe_overlap
        explained = {int(j) for j in np.flatnonzero(np.bincount(pair[refined.inlier]))}
        support, offered = int(refined.inlier.sum()), sum(correspondences.candidates[j] for j in explained)
        if support < overlap * offered or support < _FEWEST_POINTS:
            return True
        seen = correspondences.identities(frames, refined.inlier)
        if self._share_of_near_points({j: seen[j] for j in explained}) < 0.5 * overlap:
            return True
        # One pair's keyframe may be spent long before all points together are few.
        for j, frame in frames.items():
            usable = refined.inlier[pair == j] if j in explained else pair == j
            if usable.sum() < 0.5 * overlap * frame.has_depth.sum():
                return True
        return False

    def _share_of_near_points(self, seen: Mapping[int, Int]) -> float:
        """Share of the references' near points that are among those still seen, pair -> identities: far ones stay in
        view for long, but tell no translation."""
        offered = still = 0
        for j, ids in seen.items():
            near = self._frames[j].constrains_translation(self._config.pixel_sigma_px)
            offered += int(near.sum())
            still += int(near[common_rows(self._frames[j].ids, ids)[0]].sum())
        return still / offered if offered else 1.0
